"""Effects that vary from flight to flight: found where they vary, not reported elsewhere, and
passed to training.
"""

from dataclasses import replace

import numpy as np
from numpy.random import default_rng
from numpy.testing import assert_allclose
from pytest import approx, mark
from scipy.special import logsumexp

from tests.synthetic_diagnosis import EFFECTS as MADE_UP
from tests.synthetic_diagnosis import (
    SyntheticModel,
    alter_windows,
    explain_without_laws,
    push_window,
)
from visthrow.config.effects import catalogue, random_effects
from visthrow.diagnose.apply.saved_diagnosis import SavedDiagnosis
from visthrow.diagnose.likelihood.evidence import Priors
from visthrow.diagnose.likelihood.marginal import Statistics
from visthrow.diagnose.select import result, verdicts
from visthrow.diagnose.select.candidates import (
    DAY,
    FLIGHT,
    NOTHING,
    Candidate,
    Scatter,
    estimate_shares,
    integrate_shares,
    list_shared,
    random_shares,
    relinearise_per_flight,
)
from visthrow.diagnose.select.occam import Linear, window

NAMES = ("release_lag", "payload_drag", "wind_x", "wind_y", "wind_z")
EFFECTS = tuple(catalogue()[name] for name in NAMES)
PRIORS = Priors.of(EFFECTS, ("pos_w", "quat_wb", "payload_pos_w"))
LEAST = 4.0


def choose(statistics, effects=EFFECTS, priors=PRIORS, least=LEAST):
    """Return the best set of candidates, and the deviations of its random shares in their unit."""
    offered = list_shared(effects) + random_shares(effects, priors, statistics)
    linear = Linear(statistics, priors, offered, lambda s: sum(least + c.penalty for c in s))
    near = window(linear, {NOTHING})
    best = max(near, key=near.get)
    sizes = {
        c.name: size * c.deviations[0] * priors.floor[c.columns[0]]
        for c, size in linear.shares(best)[0].items()
    }
    return best, sizes


def test_shares_that_change_one_column_keep_their_deviations():
    """Of two that concern the same effect, the later one's prior was taken for both."""
    statistics = flights(default_rng(0), release_lag=0.02)
    narrow, wide = (
        Candidate(f"lag_{sd}", (0, 1), FLIGHT, deviations=(sd, sd)) for sd in (0.01, 10.0)
    )
    alone = Linear(statistics, PRIORS, [narrow], lambda _: 0.0)
    both = Linear(statistics, PRIORS, [narrow, wide], lambda _: 0.0)
    theta = np.zeros(len(NAMES))
    (expected,) = alone._promises(FLIGHT, [narrow], theta)
    narrow_promise, wide_promise = both._promises(FLIGHT, [narrow, wide], theta)
    assert narrow_promise == approx(expected)
    assert wide_promise > narrow_promise + 1.0


def flights(rng, count=10, **deviation):
    """Statistics of flights in which effects are drawn anew with these deviations, in their units;
    common sizes below floors.
    """
    K, F = len(NAMES), np.arange(count)
    mix = rng.normal(size=(count, K, K)) * 0.3 + np.eye(K)
    information = 4.0 * np.einsum("fij,fkj->fik", mix, mix)
    spread = np.array([deviation.get(name, 0.0) for name in NAMES]) / PRIORS.floor
    theta = rng.normal(size=(count, K)) * spread + rng.uniform(-0.5, 0.5, K)
    noise = np.einsum("fij,fj->fi", np.linalg.cholesky(information), rng.normal(size=(count, K)))
    score = np.einsum("fij,fj->fi", information, theta) + noise
    return Statistics(F, information, score, np.zeros(count), np.full(count, 500), np.zeros(K))


def campaign(rng, days, by_day, by_flight):
    """Flights of some days, three a day, whose release lag is drawn anew each day and each flight
    with these deviations.
    """
    statistics, floor = flights(rng, 3 * days, release_lag=by_flight), PRIORS.floor[0]
    offsets = np.repeat(rng.normal(size=days) * by_day / floor, 3)
    score = statistics.score + statistics.information[:, :, 0] * offsets[:, None]
    return replace(statistics, score=score, days=np.repeat(np.arange(days), 3))


def find_day_groups(rng, *deviations) -> set[str]:
    """Return the groups with a random share of the release's lag."""
    statistics = campaign(rng, 5, *deviations)
    return {c.group for c in choose(statistics)[0] if c.name == "lag_jitter"}


def test_what_is_drawn_anew_each_day_drifts():
    rng = default_rng(8)
    worlds = [find_day_groups(rng, 0.012, 0.0) for _ in range(12)]
    assert np.mean([w == {DAY} for w in worlds]) > 0.7
    assert not any(find_day_groups(rng, 0.0, 0.0) for _ in range(20))


def test_a_drift_is_reported_with_its_size_and_its_days():
    drift = Scatter(
        *("lag_jitter", "The lag varies", "", ("release_lag",), "s", "release", 0.1, 0.001, ""),
        found=True,
        size=0.01,
        low=0.005,
        high=0.02,
        nats=7.0,
        flights=5,
        by=DAY,
    )
    assert drift.sentence == (
        "drifts, a value for each day. The lag varies: lag_jitter = 0.01 s (95 %: 0.005 to 0.02),"
        " 7 nats from 5 days."
    )


def share(j, group, size):
    """Random shares of one effect, with their deviation in its floors."""
    return {Candidate(group, (j,), group, deviations=(1.0,)): size}


def test_a_mean_is_as_certain_as_its_number_of_days():
    """Three flights of a day give no more information on the days' common size than one does."""
    statistics = campaign(default_rng(10), 5, 0.012, 0.0)
    by_flight, by_day = (integrate_shares(statistics, share(0, who, 6.0)) for who in (FLIGHT, DAY))
    assert len(by_day.flights) == 5
    sd = [1.0 / np.sqrt(s.information.sum(0)[0, 0]) for s in (by_flight, by_day)]
    assert_allclose(sd, 6.0 / np.sqrt([15.0, 5.0]), rtol=0.02)


def test_shares_of_days_come_before_those_of_flights():
    statistics = campaign(default_rng(11), 5, 0.0, 0.0)
    moved = np.repeat([4.0, -4.0, 2.0, -2.0, 0.0], 3) + np.tile([1.0, 0.0, -1.0], 5)
    statistics = replace(statistics, score=moved[:, None] * statistics.information[:, :, 0])
    shares = estimate_shares(
        statistics, np.zeros(len(NAMES)), share(0, FLIGHT, 1.0) | share(0, DAY, 10.0)
    )
    assert_allclose(shares[:, 0], moved, atol=0.5)
    assert np.all(shares[:, 1:] == 0.0)


def test_deviations_are_found_with_their_size():
    rng = default_rng(5)
    worlds = [choose(flights(rng, release_lag=0.012))[1] for _ in range(15)]
    assert np.mean(["lag_jitter" in w for w in worlds]) > 0.9
    assert not any("gust" in w for w in worlds)
    assert abs(np.median([w.get("lag_jitter", 0.0) for w in worlds]) - 0.012) < 0.003
    gusts = [choose(flights(rng, wind_x=0.25, wind_y=0.25, wind_z=0.25))[1] for _ in range(25)]
    assert np.mean(["gust" in w for w in gusts]) > 0.9
    assert abs(np.median([w.get("gust", 0.0) for w in gusts]) - 0.25) < 0.08


def sizes_of(rows, theta, covariance):
    """Sizes and covariance of a flight to come, by a diagnosis as it is written."""
    report = {"scatter": rows, "theta": theta, "covariance": covariance}
    return SavedDiagnosis(report, "the diagnosis").sizes


def test_training_draws_what_varies():
    varies = {"name": "lag_jitter", "found": True, "size": 0.01, "of": ["release_lag"]}
    theta, covariance = sizes_of([varies], {"rope_length": 0.01}, [[1e-8]])
    assert theta == {"rope_length": 0.01, "release_lag": 0.0}
    assert_allclose(covariance, np.diag([1e-8, 1e-4]))
    varies["mean"] = {"release_lag": 0.005}
    theta, covariance = sizes_of([varies], {}, [])
    assert theta == {"release_lag": 0.005}
    theta, covariance = sizes_of([varies], {"release_lag": 0.02}, [[1e-6]])
    assert theta == {"release_lag": 0.02}
    assert_allclose(covariance, [[1.01e-4]])


def test_what_varies_by_flight_and_by_day_varies_by_both_in_training():
    rows = [
        {"name": f"by_{by}", "found": True, "size": size, "of": ["release_lag"]}
        for by, size in (("flight", 0.01), ("day", 0.02))
    ]
    covariance = sizes_of(rows, {}, [])[1]
    assert_allclose(covariance, [[5e-4]])


DELAYED = tuple(replace(e, name="cmd_delay") if i == 4 else e for i, e in enumerate(MADE_UP))
FLOOR = DELAYED[4].floor


def draw_flights(sizes, **options) -> SyntheticModel:
    """Return flights each of which has its own size of one effect, in floors."""
    return alter_windows(
        lambda m, w: push_window(m, w, cmd_delay=sizes[w.flight]),
        effects=DELAYED,
        throws=len(sizes) - 1,
        **options,
    )


def delay_jitter(diagnosis):
    return next(s for s in diagnosis.scatter if s.name == "cmd_jitter")


def test_what_single_flights_differ_by_is_integrated_out():
    statistics, K, j, size = flights(default_rng(3), count=1), len(NAMES), 2, 1.7
    left = integrate_shares(statistics, share(j, FLIGHT, size))
    information = statistics.information[0]
    score = statistics.score[0]
    theta = default_rng(4).normal(size=K)

    def misfit(x):
        shifted = theta + np.eye(K)[j] * x[:, None]
        return -2.0 * shifted @ score + np.einsum("xi,ij,xj->x", shifted, information, shifted)

    x = np.linspace(-12.0 * size, 12.0 * size, 20001)
    exponents = -0.5 * (misfit(x) + (x / size) ** 2)
    step = (x[1] - x[0]) / np.sqrt(2.0 * np.pi) / size
    whole = statistics.square[0] - 2.0 * (logsumexp(exponents) + np.log(step))
    integrated = left.square[0] - 2.0 * theta @ left.score[0] + theta @ left.information[0] @ theta
    assert_allclose(integrated, whole, rtol=1e-9)


# Less than the spread from flight to flight, and more.
@mark.parametrize(("seed", "deviation"), [(1, 4.0), (2, 9.0)])
def test_an_effect_that_varies_about_a_mean_is_named_and_varies(seed, deviation):
    sizes = 14.0 + deviation * default_rng(seed).permutation(np.linspace(-1.7, 1.7, 16))
    diagnosis = explain_without_laws(draw_flights(sizes, seed=seed))
    assert diagnosis.overall == result.KNOWN
    assert diagnosis.named == ("cmd_delay",)
    finding, varies = diagnosis["cmd_delay"], delay_jitter(diagnosis)
    assert finding.low < 14.0 * FLOOR < finding.high
    assert (
        finding.sd > deviation * FLOOR / np.sqrt(16) * 0.8
    )  # no mean is known better than its flights scatter
    assert varies.found
    assert varies.low < deviation * FLOOR < varies.high


def test_an_effect_that_varies_about_nothing_is_not_named():
    sizes = 6.0 * default_rng(5).permutation(np.linspace(-1.7, 1.7, 12))
    diagnosis = explain_without_laws(draw_flights(sizes, seed=5))
    assert not diagnosis.theta
    assert delay_jitter(diagnosis).found
    mean = delay_jitter(diagnosis).mean["cmd_delay"]
    assert abs(mean - sizes.mean() * FLOOR) < 3.0 * 6.0 * FLOOR / np.sqrt(12)
    assert mean != 0.0
    assert diagnosis.expected == {"cmd_delay": mean}


BENT = 0.1
"""Growth of a release's response per floor of earliness, relative to its derivative."""
TRUTH = 0.012
"""Deviation of the release's lag [s]: 6 floors."""
INFORMATION = 30.0


def answer(lag):
    """Response to a release late by some floors, relative to its derivative."""
    return lag + BENT * lag * np.maximum(-lag, 0.0)


def world(seed: int):
    """Statistics of flights about no lag, and the same flights simulated with another."""
    rng, K, count = np.random.default_rng(seed), len(NAMES), 12
    lags = rng.normal(size=count) * TRUTH / PRIORS.floor[0]
    measured = answer(lags) + rng.normal(size=count) / np.sqrt(INFORMATION)
    information = np.tile(np.eye(K), (count, 1, 1))
    information[:, 0, 0] = INFORMATION
    score = np.zeros((count, K))
    score[:, 0] = INFORMATION * measured
    statistics = Statistics(
        np.arange(count),
        information,
        score,
        INFORMATION * measured**2,
        np.full(count, 500),
        np.zeros(K),
    )

    def again(theta):
        left = measured - answer(theta[0])
        simulated = replace(
            statistics,
            square=INFORMATION * left**2,
            score=INFORMATION * left[:, None] * np.eye(1, K),
            theta=theta,
        )
        return simulated if abs(theta[0]) < 40.0 else None

    return statistics, again


EFFECT = next(v for v in random_effects() if v.name == "lag_jitter")


def jitter(statistics, again):
    if again is not None:
        statistics = relinearise_per_flight(statistics, np.zeros(len(NAMES)), PRIORS, 0, again)
    offered = list_shared(EFFECTS) + random_shares(EFFECTS, PRIORS, statistics, ())
    share = next(c for c in offered if c.name == "lag_jitter")
    linear = Linear(statistics, PRIORS, offered, lambda _: 0.0)
    return verdicts.share_verdict(linear, share, frozenset(offered[:1]), {}, EFFECT, LEAST)


def test_flights_far_apart_are_judged_by_simulations_where_they_lie():
    worlds = [world(seed) for seed in range(40)]
    with_it = [jitter(*w) for w in worlds]
    without = [jitter(statistics, None) for statistics, _ in worlds]
    assert all(s.found for s in with_it)
    inside, outside = (
        np.mean([s.low <= TRUTH <= s.high for s in sizes]) for sizes in (with_it, without)
    )
    assert inside > 0.85, inside  # 95 %, less three deviations of 40 draws
    assert outside < 0.7, (
        outside
    )  # the derivatives alone take early releases for still earlier ones
    assert abs(np.median([s.size for s in with_it]) / TRUTH - 1.0) < 0.15
    assert np.median([s.size for s in without]) > 1.15 * TRUTH


def test_a_simulation_that_fails_everywhere_leaves_the_derivatives():
    statistics, _ = world(0)
    assert jitter(statistics, lambda theta: None) == jitter(statistics, None)

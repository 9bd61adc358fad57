"""What varies from flight to flight: found where it does, silent where it does not, and handed on
to training.
"""

from dataclasses import replace

import numpy as np
from numpy.random import default_rng
from numpy.testing import assert_allclose

from visthrow.config.effects import catalogue
from visthrow.diagnose.extend import patch
from visthrow.diagnose.likelihood.evidence import Priors
from visthrow.diagnose.likelihood.marginal import Statistics
from visthrow.diagnose.select.candidates import NOTHING, random_shares, shared
from visthrow.diagnose.select.occam import Linear, window
from visthrow.diagnose.select.scatter import DAY, FLIGHT, Varies, freed, own_shares

NAMES = ("release_lag", "payload_drag", "wind_x", "wind_y", "wind_z")
EFFECTS = tuple(catalogue()[name] for name in NAMES)
PRIORS = Priors.of(EFFECTS, ("pos_w", "quat_wb", "payload_pos_w"))
LEAST = 4.0


def chosen_of(statistics, days=()):
    """Return the best set of candidates, and the deviations of its random shares in their unit."""
    offered = shared(EFFECTS) + random_shares(EFFECTS, PRIORS, statistics, days)
    linear = Linear(statistics, PRIORS, offered, lambda s: sum(LEAST + c.penalty for c in s), days)
    near = window(linear, {NOTHING})
    best = max(near, key=near.get)
    sizes = {
        c.name: size * c.deviations[0] * PRIORS.floor[c.columns[0]]
        for c, size in linear.shares(best)[0].items()
    }
    return best, sizes


def flights(rng, count=10, **deviation):
    """Statistics of flights in which effects are drawn anew with these deviations, in their units;
    common sizes below floors.
    """
    K, F = len(NAMES), np.arange(count)
    mix = rng.normal(size=(count, K, K)) * 0.3 + np.eye(K)
    information = 4.0 * np.einsum("fij,fkj->fik", mix, mix)
    own = np.array([deviation.get(name, 0.0) for name in NAMES]) / PRIORS.floor
    theta = rng.normal(size=(count, K)) * own + rng.uniform(-0.5, 0.5, K)
    noise = np.einsum("fij,fj->fi", np.linalg.cholesky(information), rng.normal(size=(count, K)))
    score = np.einsum("fij,fj->fi", information, theta) + noise
    return Statistics(F, information, score, np.zeros(count), np.full(count, 500), np.zeros(K))


def campaign(rng, days, by_day, by_flight):
    """Flights of some days, three a day, whose release lag is drawn anew each day and each flight
    with these deviations.
    """
    found, floor = flights(rng, 3 * days, release_lag=by_flight), PRIORS.floor[0]
    own = np.repeat(rng.normal(size=days) * by_day / floor, 3)
    return (
        replace(found, score=found.score + found.information[:, :, 0] * own[:, None]),
        np.repeat(np.arange(days), 3).tolist(),
    )


def on_days(rng, *deviations) -> set[str]:
    """Return who has a share of the release's lag."""
    statistics, days = campaign(rng, 5, *deviations)
    return {c.group for c in chosen_of(statistics, days)[0] if c.name == "lag_jitter"}


def test_what_is_drawn_anew_each_day_drifts():
    rng = default_rng(8)
    worlds = [on_days(rng, 0.012, 0.0) for _ in range(12)]
    assert np.mean([w == {DAY} for w in worlds]) > 0.7
    assert not any(on_days(rng, 0.0, 0.0) for _ in range(20))


def test_a_mean_is_as_sure_as_there_are_days():
    """Three flights of a day tell no more of what all days share than one does."""
    statistics, days = campaign(default_rng(10), 5, 0.012, 0.0)
    by_flight, by_day = (
        freed(statistics, Varies(days, {(0, FLIGHT): 6.0})),
        freed(statistics, Varies(days, {(0, DAY): 6.0})),
    )
    assert len(by_day.flights) == 5
    sd = [1.0 / np.sqrt(s.information.sum(0)[0, 0]) for s in (by_flight, by_day)]
    assert_allclose(sd, 6.0 / np.sqrt([15.0, 5.0]), rtol=0.02)


def test_shares_of_days_come_before_those_of_flights():
    statistics, days = campaign(default_rng(11), 5, 0.0, 0.0)
    moved = np.repeat([4.0, -4.0, 2.0, -2.0, 0.0], 3) + np.tile([1.0, 0.0, -1.0], 5)
    statistics = replace(statistics, score=moved[:, None] * statistics.information[:, :, 0])
    shares = own_shares(
        statistics, np.zeros(len(NAMES)), Varies(days, {(0, FLIGHT): 1.0, (0, DAY): 10.0})
    )
    assert_allclose(shares[:, 0], moved, atol=0.5)
    assert np.all(shares[:, 1:] == 0.0)


def test_deviations_are_found_with_their_size():
    rng = default_rng(5)
    worlds = [chosen_of(flights(rng, release_lag=0.012))[1] for _ in range(15)]
    assert np.mean(["lag_jitter" in w for w in worlds]) > 0.9
    assert not any("gust" in w for w in worlds)
    assert abs(np.median([w.get("lag_jitter", 0.0) for w in worlds]) - 0.012) < 0.003
    gusts = [chosen_of(flights(rng, wind_x=0.25, wind_y=0.25, wind_z=0.25))[1] for _ in range(25)]
    assert np.mean(["gust" in w for w in gusts]) > 0.9
    assert abs(np.median([w.get("gust", 0.0) for w in gusts]) - 0.25) < 0.08


def test_training_draws_what_varies():
    varies = {"name": "lag_jitter", "found": True, "size": 0.01, "of": ["release_lag"]}
    report = {"scatter": [varies]}
    theta, covariance = patch.with_scatter({"rope_length": 0.01}, [[1e-8]], report)
    assert theta == {"rope_length": 0.01, "release_lag": 0.0}
    assert_allclose(covariance, np.diag([1e-8, 1e-4]))
    varies["mean"] = {"release_lag": 0.005}
    theta, covariance = patch.with_scatter({}, [], report)
    assert theta == {"release_lag": 0.005}
    theta, covariance = patch.with_scatter({"release_lag": 0.02}, [[1e-6]], report)
    assert theta == {"release_lag": 0.02}
    assert_allclose(covariance, [[1.01e-4]])

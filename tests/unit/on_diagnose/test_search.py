"""The search on flights whose truth is known: names, sizes, classes, events, copies; and the need
for each guard.
"""

from dataclasses import replace

import numpy as np
from numpy.random import default_rng
from pytest import approx, mark, raises

from tests.synthetic_diagnosis import (
    EFFECTS,
    SyntheticModel,
    alter_windows,
    explain_without_laws,
    push_window,
    selector_of,
)
from tests.unit.on_diagnose.test_scatter import choose
from visthrow.common.errors import DiagnoseError
from visthrow.diagnose.likelihood import evidence
from visthrow.diagnose.likelihood.evidence import Priors
from visthrow.diagnose.likelihood.marginal import Statistics
from visthrow.diagnose.likelihood.noise_levels import ENOUGH_NATS
from visthrow.diagnose.select import diagnose_flights, held_out, result


def sizes(model, diagnosis) -> dict[str, float]:
    floor = {e.name: e.floor for e in model.effects}
    return {name: value / floor[name] for name, value in diagnosis.theta.items()}


def test_nothing_is_found_where_nothing_is():
    diagnosis = diagnose_flights.explain(SyntheticModel())
    assert diagnosis.overall == result.NO_EFFECT
    assert not diagnosis.theta
    assert not diagnosis.events
    assert {f.verdict for f in diagnosis.findings} <= {result.BOUNDED, result.NOT_IDENTIFIABLE}
    assert len(diagnosis.findings) == len(EFFECTS)


@mark.parametrize("sign", [1.0, -1.0])
def test_one_effect_is_named_with_its_size_and_interval(sign):
    model = SyntheticModel(truth={"effect_03": 10.0 * sign}, curvature=0.2, seed=4)
    diagnosis = explain_without_laws(model)
    assert diagnosis.overall == result.KNOWN
    finding = diagnosis["effect_03"]
    assert finding.verdict == result.FOUND
    assert finding.low < 10.0 * sign * finding.floor < finding.high
    assert abs(sizes(model, diagnosis)["effect_03"] - 10.0 * sign) < 1.0  # a floor
    assert diagnosis.named == ("effect_03",)
    assert "cause 3" in finding.sentence
    assert finding.nats > diagnosis.threshold
    assert "np." not in repr(diagnosis)


TRIPLE = {"effect_03": 12.0, "effect_04": -9.0, "effect_02": 15.0}


@mark.parametrize("curvature", [0.0, 2.0])
def test_three_effects_are_named_also_where_bends_would_fake_one(curvature):
    """A bend of 2 at 30 floors is taken for more than a third of each size."""
    model = SyntheticModel(truth=TRIPLE, seed=1, curvature=curvature)
    diagnosis = explain_without_laws(model)
    assert set(diagnosis.named) == set(TRIPLE)
    for name, size in sizes(model, diagnosis).items():
        assert abs(size - TRIPLE[name]) < 1.5


def hiding(share: float, **options) -> SyntheticModel:
    """Flights in which effect 7 undoes effect 3, of the same size, but for its ``own`` share."""

    def change(model, window):
        columns = window.effects.copy()
        columns[:, 7] = share * columns[:, 7] - columns[:, 3]
        return push_window(model, replace(window, effects=columns), effect_03=14.0, effect_07=14.0)

    return alter_windows(change, seed=3, **options)


@mark.parametrize("beside", [{}, {"effect_04": 10.0}])
def test_two_effects_that_hide_each_other_are_named_together(beside):
    """Neither brings a single nat alone, nor does what looks like both."""
    diagnosis = explain_without_laws(hiding(0.15, truth=beside))
    assert set(diagnosis.named) == {"effect_03", "effect_07", *beside}
    for name in ("effect_03", "effect_07"):
        assert diagnosis[name].low < 14.0 * diagnosis[name].floor < diagnosis[name].high
    last = diagnosis.steps[-1]
    assert last.nats == last.refitted[last.named] > ENOUGH_NATS
    assert last.named in list(last.screened)[:3]


def test_effects_that_do_the_same_are_a_class_with_their_known_combination():
    model = SyntheticModel(
        truth={"effect_03": 12.0}, same={"effect_07": ("effect_03", 0.5)}, seed=2
    )
    diagnosis = explain_without_laws(model)
    group = [f for f in diagnosis.findings if f.verdict == result.CLASS]
    assert {f.name for f in group} == {"effect_03", "effect_07"}
    assert all(set(f.partners) == {"effect_03", "effect_07"} - {f.name} for f in group)
    assert len(diagnosis.theta) == 1
    assert diagnosis["effect_03"].estimate == approx(12.0 * EFFECTS[3].floor, rel=0.1)
    assert diagnosis["effect_07"].estimate == approx(24.0 * EFFECTS[7].floor, rel=0.15)
    assert "effect_03 + 0.5 N/(N) effect_07 = 0.04" in diagnosis["effect_03"].joint
    assert diagnosis["effect_03"].manoeuvres


def test_a_cause_is_a_candidate_where_a_set_without_it_is_nearly_as_likely():
    """Its evidence exceeds the threshold by 1.2 nats: odds of three to one."""
    truth = {"effect_03": 12.0, "effect_05": 3.3}
    diagnosis = explain_without_laws(SyntheticModel(truth=truth, seed=5, throws=8, free=2))
    assert diagnosis["effect_05"].nats > diagnosis.threshold
    assert [set(names) for names, _ in diagnosis.sets] == [{*truth}, {"effect_03"}]
    assert diagnosis["effect_05"].verdict == result.CANDIDATE
    assert diagnosis["effect_03"].verdict == result.FOUND
    assert diagnosis.named == ("effect_03",)
    odds = np.exp(-diagnosis.sets[1][1])
    assert f"(odds {odds:.2g})" in diagnosis["effect_05"].sentence


def test_two_causes_are_classes_with_one_that_stands_in_for_both():
    """Effect 8 acts as effects 3 and 4 together, but for a seventh of what it does by itself."""

    def change(model, window):
        floor = [e.floor for e in model.effects]
        columns = window.effects.copy()
        both = floor[3] * columns[:, 3] + floor[4] * columns[:, 4]
        columns[:, 8] = both / floor[8] + 0.132 * columns[:, 8]
        return push_window(model, replace(window, effects=columns), effect_03=20.0, effect_04=20.0)

    diagnosis = explain_without_laws(alter_windows(change, seed=3))
    assert [set(names) for names, _ in diagnosis.sets] == [
        {"effect_03", "effect_04"},
        {"effect_08"},
    ]
    group = {f.name: f.partners for f in diagnosis.findings if f.verdict == result.CLASS}
    assert {*group} == {"effect_03", "effect_04", "effect_08"}
    assert group["effect_03"] == group["effect_04"] == ("effect_08",)


def test_a_missing_channel_makes_effects_unobservable_and_names_it():
    model = SyntheticModel(truth={"effect_03": 12.0}, seed=2)
    model.effects = tuple(
        replace(e, channels=("battery_voltage",)) if e.name == "effect_05" else e for e in EFFECTS
    )
    diagnosis = explain_without_laws(model)
    assert diagnosis["effect_05"].verdict == result.UNOBSERVABLE
    assert diagnosis["effect_05"].missing == ("battery_voltage",)
    assert diagnosis.named == ("effect_03",)


def test_what_happened_in_one_flight_is_an_event_and_no_cause():
    model = alter_windows(
        lambda m, w: push_window(m, w, effect_03=40.0) if w.flight == 4 else w, throws=9
    )
    diagnosis = explain_without_laws(model)
    assert not diagnosis.theta
    assert diagnosis.events == (4,)
    assert [set(names) for names, _ in diagnosis.sets] == [{"effect_03 in flight 4"}]


@mark.parametrize(("force", "events"), [(0.006, ()), (0.2, (4,))])
def test_a_rough_window_is_an_event_where_it_moves_more_than_a_landing(force, events):
    """Without gusts, forces that move a body by a millimetre stand out from the noise."""

    def stirred(model, window):
        if (window.flight, window.phase) != (4, "throw"):
            return window
        along = (window.latent_block == 0) & (window.latent_axis == 0)
        push = force * np.sin(2.0 * np.pi * np.linspace(0.0, 1.0, np.count_nonzero(along)))
        return replace(window, residual=window.residual + window.latent[:, along] @ push)

    model = alter_windows(stirred, seed=3, throws=9, gust=0.0, rate=200)
    assert explain_without_laws(model).events == events


def test_signs_that_change_from_flight_to_flight_are_reported_as_what_varies():
    model = alter_windows(
        lambda m, w: push_window(m, w, effect_03=15.0 * (-1) ** w.flight), throws=9
    )
    diagnosis = explain_without_laws(model)
    assert not diagnosis.theta
    assert [(s.name, s.of) for s in diagnosis.scatter if s.found] == [
        ("effect_03_by_flight", ("effect_03",))
    ]
    assert diagnosis.overall == result.KNOWN


def test_flights_that_differ_each_for_itself_leave_nothing_to_vary():
    sizes = (20.0, 0.0, 26.0, 0.0, 0.0, 20.0)
    model = alter_windows(lambda m, w: push_window(m, w, effect_03=sizes[w.flight]), throws=5)
    diagnosis = diagnose_flights.explain(model, laws=False)
    assert diagnosis.events == (0, 2, 5)
    assert diagnosis.overall == result.KNOWN
    assert "effect_03 in flight 0 and effect_03 in flight 2" in diagnosis.reasons[0]
    assert not [s for s in diagnosis.scatter if s.found]


def best_set(sizes) -> set[str]:
    """Return the names of the best set for flights, each with its own size of one effect."""
    priors = replace(_priors(1), slab=np.full(1, 20.0))
    information = np.full((len(sizes), 1, 1), 4.0)  # information: half a floor's deviation each
    none = np.zeros(len(sizes))
    statistics = Statistics(
        np.arange(len(sizes)), information, 4.0 * np.array(sizes)[:, None], none, none, np.zeros(1)
    )
    effects = [replace(EFFECTS[3], prior_sd=20.0, floor=1.0)]
    best, _ = choose(statistics, effects=effects, priors=priors, least=5.0)
    return {c.name for c in best}


@mark.parametrize(
    ("sizes", "expected"),
    [
        ([9.5, 10.5, 9.0, 10.5, 10.0, 9.5, 10.5, 10.0], {"effect_03"}),
        ([9.0, -11.0, 8.0, -12.0, 10.0, -9.5, 10.5, -10.0], {"effect_03_by_flight"}),
        ([26.0, 34.0, 28.0, 32.0, 25.0, 35.0, 29.0, 31.0], {"effect_03", "effect_03_by_flight"}),
        ([0.0, 0.0, 0.0, 25.0, 0.0, 0.0, 0.0, 0.0], {"effect_03 in flight 3"}),
        ([23.0, 13.0], {"effect_03_by_flight"}),
        ([10.0, 10.5], {"effect_03"}),
    ],
)
def test_what_flights_share_and_what_each_has_for_itself_are_weighed_alike(sizes, expected):
    """Also of two flights: two scales are two scales."""
    assert best_set(sizes) == expected


def test_gusts_are_no_causes():
    assert not explain_without_laws(SyntheticModel(gust=2.0, seed=7)).theta


def test_causes_at_their_floors_are_not_named():
    signs = default_rng(3).choice([-1.0, 1.0], len(EFFECTS))
    truth = {e.name: sign for e, sign in zip(EFFECTS, signs)}
    model = SyntheticModel(truth=truth, seed=3, gust=0.3, noise=0.5)
    assert not explain_without_laws(model).theta


def test_commands_of_other_flights_are_inconsistent_data():
    """Poses that have nothing to do with the commands leave forces of the order of the thrust."""
    diagnosis = diagnose_flights.explain(SyntheticModel(gust=80.0))
    assert diagnosis.overall == result.INCONSISTENT
    assert not diagnosis.theta


def test_a_simulation_that_fails_is_out_of_domain():
    failing = alter_windows(lambda m, w: replace(w, residual=np.full_like(w.residual, np.nan)))
    diagnosis = diagnose_flights.explain(failing)
    assert diagnosis.overall == result.OUT_OF_DOMAIN
    assert not diagnosis.theta
    assert len(diagnosis.findings) == 12


def test_a_few_windows_that_fail_are_left_out_and_counted():
    some = alter_windows(
        lambda m, w: replace(w, residual=w.residual * np.nan) if w.flight == 5 else w,
        truth={"effect_03": 10.0},
    )
    diagnosis = explain_without_laws(some)
    assert diagnosis.named == ("effect_03",)
    windows = some.windows({})
    failed = sum(w.flight == 5 for w in windows)
    assert diagnosis.reasons[-1].startswith(f"{failed} of {len(windows)} windows are left out")


def test_an_estimate_stays_within_its_physical_bounds():
    model = SyntheticModel(truth={"effect_03": 12.0}, seed=2)
    floor = EFFECTS[3].floor
    model.effects = tuple(
        replace(e, bounds=(-5 * floor, 8 * floor)) if e.name == "effect_03" else e for e in EFFECTS
    )
    diagnosis = explain_without_laws(model)
    assert all(
        f.low >= -5 * floor - 1e-12 and f.high <= 8 * floor + 1e-12
        for f in diagnosis.findings
        if f.name == "effect_03"
    )
    assert abs(diagnosis.theta.get("effect_03", 0.0)) <= 8 * floor + 1e-12
    # it pushes on against its bound: the true cause has another equation
    assert diagnosis.overall == result.UNKNOWN


def test_an_interval_that_shrinks_onto_a_bound_is_reported_in_words():
    model = SyntheticModel(truth={"effect_03": -5.0}, seed=2)
    model.effects = tuple(
        replace(e, bounds=(-0.0, 1.0), unit="1") if e.name == "effect_03" else e for e in EFFECTS
    )
    finding = explain_without_laws(model)["effect_03"]
    assert finding.verdict == result.BOUNDED
    assert (finding.low, finding.high) == (0.0, 0.0)
    assert (
        finding.sentence
        == "effect_03: on its bound of 0; these flights would need less than is possible."
    )


def test_no_window_is_an_error_that_says_so():
    empty = SyntheticModel()
    empty._windows = []
    with raises(DiagnoseError, match="no stretch of flight"):
        diagnose_flights.explain(empty)


def test_catalogues_that_contradict_themselves_are_refused():
    twice = (*EFFECTS, EFFECTS[0])
    with raises(DiagnoseError, match="share a name: effect_00"):
        Priors.of(twice, ("pos_w", "payload_pos_w"))
    with raises(ValueError, match=r"floor is 0\.0; expected above 0"):
        replace(EFFECTS[0], floor=0.0)


def _priors(count: int) -> Priors:
    return Priors(
        np.ones(count),
        np.full(count, 10.0),
        np.full(count, -np.inf),
        np.full(count, np.inf),
        np.ones(count, bool),
    )


def test_evidence_is_the_integral():
    """One effect: closed form against the sum over its sizes, bounds and floor included."""
    information, score = np.array([[0.3]]), np.array([1.7])
    one = np.ones(1)
    priors = Priors(one, 6.0 * one, -one, 9.0 * one, one > 0.0)
    for active, sd, low, high in ([], evidence.SPIKE, -6.0, 6.0), ([0], 6.0, -1.0, 9.0):
        x = np.linspace(low, high, 200_001)
        prior = np.exp(-0.5 * (x / sd) ** 2)
        weight = prior * np.exp(1.7 * x - 0.15 * x**2)
        expected = np.log(np.trapezoid(weight, x) / np.trapezoid(prior, x))
        posterior = evidence.Posterior(information, score, priors)
        assert posterior.log_evidence(active) == approx(expected, abs=1e-6)


@mark.parametrize("active", [[], [0], [1, 2]])
def test_gains_are_differences_of_the_evidence(active):
    count = 5
    priors = _priors(count)
    information = _information(count)
    score = information @ np.arange(count)
    posterior = evidence.Posterior(information, score, priors)
    singles = posterior.additions(active)
    pairs = posterior.pair_additions(active)
    before = posterior.log_evidence(active)
    for i, j in np.ndindex(count, count):
        names = {i, j} - set(active)
        expected = posterior.log_evidence([*active, *names]) - before
        assert pairs[i, j] == approx(expected if len(names) == 2 else -np.inf)
        if i == j:
            assert singles[i] == approx(expected if names else -np.inf)


@mark.filterwarnings("error")
@mark.parametrize("active", [[], [0]])
@mark.parametrize("seed", range(20, 60, 10))
def test_gains_are_numbers_where_information_differs_by_ten_orders(active, seed):
    rng = default_rng(seed)
    slopes = rng.standard_normal((2, 4)) * 10.0 ** rng.uniform(0.0, 5.0, 4)
    information = slopes.T @ slopes
    one = np.ones(4)
    priors = Priors(one, 20.0 * one, -50.0 * one, 50.0 * one, one > 0.0)
    posterior = evidence.Posterior(information, information @ (300.0 * one), priors)
    for gains in (posterior.additions, posterior.pair_additions):
        assert not np.isnan(gains(active)).any()


def test_threshold_rises_with_the_number_of_candidates_and_holds_in_null_worlds():
    rng = default_rng(0)
    few, many = (_threshold(count) for count in (4, 400))
    assert few < many
    information, priors, least = _information(40), _priors(40), _threshold(40)
    draws = evidence.null_draws(information, 2000, rng)
    best = evidence.Posterior(information, draws, priors).additions(()).max(1)
    assert np.mean(best > least) < 0.012  # half a per cent, with the scatter of two finite samples


def _information(count: int) -> np.ndarray:
    root = default_rng(count).normal(size=(count, 3 * count))
    return root @ root.T / 50.0


def _threshold(count: int) -> float:
    information = _information(count)[None]
    one = np.zeros((1, count))
    return evidence.threshold(
        Statistics(np.arange(1), information, one, one[:, 0], one[:, 0], one[0]),
        _priors(count),
        default_rng(1),
    )


def test_a_window_that_no_force_explains_is_left_out():
    rng = default_rng(0)

    def spoil(model, window):
        if window is not model._windows[3]:
            return window
        return replace(
            window,
            residual=window.residual + 10.0 * window.sigma * rng.standard_normal(len(window.sigma)),
        )

    model = alter_windows(spoil, truth={"effect_03": 10.0}, seed=4)
    diagnosis = explain_without_laws(model)
    assert diagnosis.windows == len(model.windows({})) - 1
    assert tuple(diagnosis.theta) == ("effect_03",)


def test_a_set_that_was_the_best_before_stays_possible():
    model = SyntheticModel(truth={"effect_06": 15.0}, seed=4)
    for w in model._windows:  # hardly distinguishable from it
        w.effects[:, 8] = w.effects[:, 6] + 0.03 * w.effects[:, 3]
    selector = selector_of(model)
    twin = frozenset(c for c in selector.candidates if c.name == "effect_08")
    selector.run(twin)
    assert [step.named for step in selector.steps] == ["effect_06"]
    assert {c.name for trial, _ in selector.window for c in trial.chosen} == {
        "effect_06",
        "effect_08",
    }


def test_a_name_of_which_the_true_cause_leaves_nothing_is_dropped(monkeypatch):
    """Derivatives from where a name stands in for the true cause may promise nothing but both
    together, which may not be named.
    """
    model = SyntheticModel(truth={"effect_06": 15.0}, seed=4)
    for w in model._windows:
        w.effects[:, 8] = w.effects[:, 6] + w.effects[:, 3]
    selector = selector_of(model)
    by_name = {c.name: c for c in selector.candidates}
    stand_in = frozenset({by_name["effect_08"]})
    true = frozenset({by_name["effect_06"]})
    (begin,) = selector._try(selector.nominal, [stand_in])
    selector._go(begin)
    monkeypatch.setattr(selector, "_list_sets", lambda: {stand_in | true: 40.0})
    assert selector._move()
    assert selector.best.chosen == true


def test_what_gusts_held_goes_over_to_the_sizes(monkeypatch):
    """A drag in one throw alone, five times its usual size: sizes fitted once, under gusts that
    hold it, stay a fifth too small.

    Where one flight alone shows it, no held-out flight can confirm it: that is not required here.
    """
    monkeypatch.setattr(held_out, "judge", lambda diagnosis: diagnosis)
    model = SyntheticModel(throws=1, free=2, law="speed", law_size=0.0, seed=4)
    model.effects = (EFFECTS[0], replace(EFFECTS[1], floor=1e-3, prior_sd=4e-3), *EFFECTS[2:])
    model.law_size = 1.0
    for w in model._windows:
        w.effects[:, 1] = w.latent @ model._law(w.knots) if w.phase == "throw" else 0.0
        w.residual[:] += 0.02 * w.effects[:, 1]
    diagnosis = explain_without_laws(model)
    assert diagnosis.named == ("effect_01",)
    assert diagnosis["effect_01"].estimate == approx(0.02, abs=1e-3)

"""Laws outside the catalogue: terms with units, found and distinguished from names; tables where no
formula fits.
"""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose
from pytest import approx, mark
from scipy.spatial.transform import Rotation

from tests.synthetic_diagnosis import (
    EFFECTS,
    SyntheticModel,
    catalogue,
    explain_without_laws,
    linearise_flights,
)
from visthrow.common.rotations import rotate
from visthrow.diagnose.likelihood.evidence import Posterior, Priors
from visthrow.diagnose.likelihood.marginal import with_latent_effects
from visthrow.diagnose.models import law_terms as laws
from visthrow.diagnose.models.model_interface import LATENT_BLOCKS
from visthrow.diagnose.reporting.blackbox import ForceTable, table_of, tabulate_unexplained, train
from visthrow.diagnose.select import diagnose_flights, result, terms, verdicts
from visthrow.diagnose.select.candidates import ALL
from visthrow.diagnose.select.excess import acts_on
from visthrow.diagnose.select.point import candidate
from visthrow.diagnose.select.selection import Selector, Trial

IN_THE_BODY = ("vehicle torque", laws.JOINT)
# of a hidden force after a table learnt from a dozen throws, in a throw that it has not seen: a
# table is no formula
LEFT = 0.7
KNOTS = (
    "time",
    "pos_w",
    "vel_w",
    "quat_wb",
    "rate_b",
    "thrust",
    "payload_pos_w",
    "payload_vel_w",
    "cable_dir_w",
    "tension",
    "mount_b",
)


def table(terms_: list, knots: dict) -> np.ndarray:
    return np.stack([term.read(laws.KnotValues(knots)) for term in terms_], axis=-1)


def turn_world(knots: dict, turn: Rotation) -> dict:
    """The same flight in a turned world."""
    vectors = ("pos_w", "vel_w", "payload_pos_w", "payload_vel_w", "cable_dir_w")
    quats = (turn * Rotation.from_quat(knots["quat_wb"])).as_quat()
    return knots | {name: turn.apply(knots[name]) for name in vectors} | {"quat_wb": quats}


def random_knots() -> dict:
    rng = default_rng(0)
    unit = lambda v: v / norm(v, axis=1, keepdims=True)  # noqa: E731
    k = 6
    draw = partial(rng.normal, size=(k, 3))
    return {
        "time": np.arange(k) * 0.1,
        "pos_w": draw() + [0, 0, 3],
        "vel_w": draw(),
        "quat_wb": unit(rng.normal(size=(k, 4))),
        "rate_b": draw(),
        "thrust": rng.uniform(1, 4, k),
        "payload_pos_w": draw(),
        "payload_vel_w": draw(),
        "cable_dir_w": unit(draw()),
        "tension": rng.uniform(0, 1, k),
        "mount_b": np.tile([0.01, 0.0, -0.02], (k, 1)),
    }


@mark.parametrize("block", laws.BLOCKS)
def test_terms_turn_with_the_world(block):
    """Frame-covariant: forces turn with the world about the vertical, torques in the body do not
    notice.
    """
    knots, about = random_knots(), Rotation.from_euler("z", 0.7)
    turn = np.eye(3) if block in IN_THE_BODY else about.as_matrix()
    every = laws.terms_of(block, KNOTS)
    assert len(every) > 300
    values = table(every, knots)
    together = laws.table(every, laws.KnotValues(knots))
    assert_allclose(together, values, atol=1e-12 * np.abs(values).max())
    again = table(every, turn_world(knots, about))
    assert_allclose(again, np.einsum("ij,kjt->kit", turn, values), atol=1e-9 * np.abs(values).max())


def test_a_torque_in_the_joint_acts_on_both_sides():
    """No force is left over, and no moment but the one about the rope, which a rope without
    stiffness does not take.
    """
    knots = random_knots()
    terms = laws.terms_of(laws.JOINT, KNOTS)[:5]
    torque_b = table(terms, knots)
    loads = laws.loads(laws.JOINT, laws.KnotValues(knots), torque_b)
    assert tuple(sorted(loads)) == tuple(sorted(LATENT_BLOCKS))
    assert_allclose(loads["vehicle force"], -loads["payload force"])
    away = knots["payload_pos_w"] - knots["pos_w"]
    along = away - rotate(knots["quat_wb"], knots["mount_b"])
    along /= norm(along, axis=1, keepdims=True)
    for i in range(len(terms)):
        on_vehicle = rotate(knots["quat_wb"], loads["vehicle torque"][:, :, i])
        about_it = on_vehicle + np.cross(away, loads["payload force"][:, :, i])
        twist = (
            np.einsum("ki,ki->k", rotate(knots["quat_wb"], torque_b[:, :, i]), along)[:, None]
            * along
        )
        assert_allclose(about_it, twist, atol=1e-12 * np.abs(away).max() ** 3)


@mark.parametrize(
    ("term", "unit", "formula"),
    [
        (laws.Term("vehicle force", ("speed",), "vel"), "kg m^-1", "F = c |v| v"),
        (
            laws.Term("vehicle force", ("thrust", "speed_across_squared"), "body_z"),
            "m^-2 s^2",
            "F = c T v_xy² e_z",
        ),
        (laws.Term("payload force", (), "vertical_cross_vel"), "kg s^-1", "F_p = c (z x v_p)"),
        (laws.Term("vehicle torque", ("thrust",), "axis_cross_vel"), "s", "M = c T (e_z x v)"),
        (laws.Term("vehicle force", ("thrust",), "body_z"), "1", "F = c T e_z"),
        (laws.Term(laws.JOINT, ("joint_rate",), "joint_rate"), "kg m^2", "M_j = c |Ω| Ω"),
        (laws.Term(laws.JOINT, ("tension",), "friction"), "m", "M_j = c S Ω/|Ω|"),
    ],
)
def test_units_and_formulas(term, unit, formula):
    assert term.unit == unit
    assert term.formula == formula


def test_a_law_beside_a_known_cause_leaves_the_cause_its_name():
    model = SyntheticModel(law="swirl", law_size=0.01, truth={"effect_03": 12.0}, seed=3)
    diagnosis = diagnose_flights.explain(model)
    assert diagnosis.overall == result.UNKNOWN
    assert diagnosis.block == "payload force"
    assert diagnosis.named == ("effect_03",)
    assert diagnosis["effect_03"].low < 12.0 * EFFECTS[3].floor < diagnosis["effect_03"].high
    first = diagnosis.laws[
        0
    ]  # the screen prefers S (z x v_p); joined by the right term it is worth nothing
    assert first.formula == "F_p = c (z x v_p)"
    assert abs(first.coefficient - 0.01) < 2.0 * first.sd
    formulas = [law.formula for law in diagnosis.laws]
    assert len(set(formulas)) == len(formulas)


class Pushed(SyntheticModel):
    """A vehicle with an external force along the vertical."""

    def _law(self, motion: dict[str, np.ndarray]) -> np.ndarray:
        force = np.zeros((2, 3, len(motion["time"])))
        force[0, 2] = self.law_size * self._push(motion)
        return force.ravel()


class PassedBy(Pushed):
    """Flights below another vehicle, which pushes down for a moment: no law of the state."""

    def _push(self, motion):
        moment, width = self._rng.uniform(0.0, 1.0), self._rng.uniform(0.1, 0.3)
        size = self._rng.uniform(0.3, 1.0)
        since = motion["time"] - motion["time"][0] - moment
        return -size * np.exp(-0.5 * (since / width) ** 2)


def test_a_law_that_other_flights_do_not_repeat_is_not_printed():
    diagnosis = diagnose_flights.explain(PassedBy(law="passing", law_size=0.4, seed=3))
    assert diagnosis.overall == result.UNKNOWN
    (reason,) = [r for r in diagnosis.reasons if "held-out ones do not repeat it" in r]
    flight = int(reason.partition("; flight ")[2].split()[0])
    assert flight in diagnosis.work.after.plain.flights
    assert "fly more like that one" in reason
    assert not any(" = c " in reason for reason in diagnosis.reasons)
    assert not diagnosis.laws
    assert not diagnosis.explanations


def with_a_name_for_the_law(most: float) -> SyntheticModel:
    """A hidden drag of 0.02, and an effect of the very same form that is unusual beyond 0.005 and
    cannot exceed ``most``.
    """
    model = SyntheticModel(law="speed", law_size=0.02, seed=3)
    model.effects = (
        EFFECTS[0],
        replace(EFFECTS[1], floor=1e-3, prior_sd=3e-3, bounds=(-0.1, most)),
        *EFFECTS[2:],
    )
    for w, moved in zip(model._windows, model.by_law):
        w.effects[:, 1] = moved / model.law_size
    return model


def test_a_law_takes_no_name_away_that_says_the_same():
    """The name is far larger than usual and close to its bound, which costs it nats that the
    nameless term does not pay.
    """
    diagnosis = diagnose_flights.explain(with_a_name_for_the_law(0.0198))
    assert diagnosis.overall == result.KNOWN
    assert diagnosis.named == ("effect_01",)
    assert diagnosis["effect_01"].estimate == approx(0.02, abs=1e-3)


def test_a_name_that_would_have_to_exceed_its_bound_stays_none():
    diagnosis = diagnose_flights.explain(with_a_name_for_the_law(0.01))
    assert diagnosis.overall == result.UNKNOWN
    assert not diagnosis.named


class Sinking(Pushed):
    """A push wherever the vehicle sinks faster than 0.3 m/s: no product of factors."""

    def _push(self, motion):
        return motion["vel_w"][:, 2] < -0.3


class LinearDrag(Pushed):
    """Drag of the same motion."""

    def _push(self, motion):
        return -motion["vel_w"][:, 2]


@mark.parametrize(("kind", "size"), [(Sinking, 0.1), (LinearDrag, 0.05)])
def test_a_name_of_another_form_than_the_truth_is_withdrawn(kind, size):
    """Drag explains a part of a push that begins at a speed; what it leaves follows that speed."""
    model = kind(law="along", law_size=size, seed=3)
    drag = LinearDrag(law="along", law_size=1.0, seed=3).by_law
    model.effects = (EFFECTS[0], replace(EFFECTS[1], prior_sd=0.05), *EFFECTS[2:])
    for w, moved in zip(model._windows, drag):
        w.effects[:, 1] = moved
    diagnosis = diagnose_flights.explain(model)
    if kind is LinearDrag:
        assert diagnosis.overall == result.KNOWN
        assert diagnosis.named == ("effect_01",)
        return
    assert (diagnosis.overall, diagnosis.block) == (result.UNKNOWN, "vehicle force")
    assert not diagnosis.named
    assert diagnosis["effect_01"].verdict == result.NOT_IDENTIFIABLE
    assert "F = f(v_z)" in diagnosis.reasons[0]


def test_of_misshapen_blocks_the_one_with_most_evidence_is_reported(monkeypatch):
    """The first by name was, however little the names leave in it."""
    curves = {"payload force": (9.0, "F_p = f(v)"), "vehicle force": (90.0, "F = f(v_z)")}
    selection = SimpleNamespace(
        problem=SimpleNamespace(effects=EFFECTS),
        best=SimpleNamespace(point=None, columns=[1, 3]),
        nominal=None,
        laws=True,
        threshold=5.0,
    )
    monkeypatch.setattr(verdicts, "_list_by_block", lambda _: {block: [1] for block in curves})
    monkeypatch.setattr(terms, "strongest_forces", lambda _: dict.fromkeys(curves, 1.0))
    monkeypatch.setattr(terms, "best_curves", lambda *_: curves)
    monkeypatch.setattr(verdicts, "_parts_of", lambda *_: {1})
    _, block, reasons, _ = verdicts._misshapen(selection, [])
    assert block == "vehicle force"
    assert "F = f(v_z), with some function f, explains 90 nats" in reasons[0]


DRAG = laws.Term("vehicle force", ("speed",), "vel")


def select_beside_law(
    model: SyntheticModel, active: list[int], *active_terms: laws.Term
) -> Selector:
    """A selection that holds some names and laws."""
    point = linearise_flights(model)
    if active_terms:
        (point,) = terms.extend([point], [terms.as_effect(term, 0.1, 7.0) for term in active_terms])
    columns = [*active, *range(len(model.effects), len(point.theta))]
    selector = Selector(point, 4.0)
    chosen = frozenset(c for c in selector.candidates if c.group == ALL and c.columns[0] in columns)
    selector.best = Trial(chosen, candidate(point, columns))
    return selector


@mark.parametrize("block", ["vehicle force", "payload force"])
def test_all_terms_at_once_say_what_each_says_as_an_effect(block, monkeypatch):
    """Information and score of a column that the windows' inner products were given, and of no
    further simulation. Windows are shared out among threads.
    """
    monkeypatch.setattr("visthrow.diagnose.likelihood.threads.cores", lambda: 2)
    at = select_beside_law(
        SyntheticModel(effects=catalogue(4), law="speed", law_size=0.2, throws=4), [1]
    )
    best = at.best.point
    grams = [with_latent_effects(gram) for gram in best.grams]
    parts = terms.Integrals(grams, best.noise).statistics(grams, best.theta)
    of = terms.Survey(best, parts, []).screen(block)
    for i in (0, 7, len(of.terms) // 2, len(of.terms) - 1):
        (point,) = terms.extend([at.best.point], [terms.as_effect(of.terms[i], 1.0, 0.0)])
        scale = point.problem.priors.floor[-1]
        assert point.information[-1, -1] == approx(scale**2 * of.information[i, 0, 0], rel=1e-6)
        assert point.posterior.score[-1] == approx(
            scale * of.score[i, 0], rel=1e-5, abs=1e-9 * scale * np.sqrt(of.information[i, 0, 0])
        )
        cross, most = scale * of.cross, scale * np.abs(of.cross).max()
        assert_allclose(point.information[-1, :-1], cross[i, 0], rtol=1e-5, atol=1e-9 * most)


def test_names_in_the_block_of_a_law_are_withdrawn_and_others_stay():
    """A term on the law's body may be part of its form; a force on the payload is not."""
    truth = {"effect_03": 15.0, "effect_06": 15.0}
    at = select_beside_law(
        SyntheticModel(law="speed", law_size=0.02, truth=truth, seed=3),
        [3, 6],
        DRAG,
    )
    assert acts_on(at.best.point, at.names) == ["vehicle force", "payload force"]
    assert verdicts._law(at, [])[3] == {3}


def test_names_that_differ_by_a_force_in_the_block_of_a_law_are_withdrawn():
    """A force on the payload and its twin that pushes the vehicle as well: a force on the vehicle
    distinguishes them.
    """
    model = SyntheticModel(law="speed", law_size=0.02, seed=3)
    for w in model._windows:
        w.effects[:, 8] = w.effects[:, 6] + 0.2 * w.effects[:, 3]
    at = select_beside_law(model, [6, 8], DRAG)
    assert acts_on(at.best.point, at.names) == ["payload force"] * 2
    assert [acts_on(at.best.point, [j], free_effects=[14 - j])[0] for j in at.names] == [
        "vehicle force"
    ] * 2
    assert verdicts._law(at, [])[3] == {6, 8}


def test_a_law_of_the_vehicle_may_turn_it_as_well():
    """Rotors whose thrust grows with the speed also turn the vehicle harder, which looks like
    another gain of its rates.
    """
    vehicle = {"vehicle force", "vehicle torque"}
    assert terms.acts_in(["vehicle force"]) == terms.acts_in(["vehicle torque"]) == vehicle
    assert terms.acts_in(["payload force"]) == {"payload force"}
    assert terms.acts_in([laws.JOINT]) == set(LATENT_BLOCKS)


def test_what_was_named_for_a_withdrawn_name_alone_goes_with_it():
    model = SyntheticModel(law="speed", law_size=0.02, truth={"effect_03": 15.0}, seed=3)
    assert verdicts._law(select_beside_law(model, [3, 6], DRAG), [])[3] == {3, 6}


def test_the_table_takes_up_what_no_name_explains():
    """Weights from some flights predict the hidden drag in a flight that they have not seen."""
    model = SyntheticModel(law="speed", law_size=0.02, seed=3, throws=12)
    point = explain_without_laws(model).work.before
    table = table_of(point, default_rng(0))
    flights = [w.flight for w in point.windows]
    trained = train(point, table, flights)
    weights = trained.weights(trained.statistics.flights != 5)
    index = next(i for i, w in enumerate(point.windows) if w.flight == 5 and w.phase == "throw")
    window = point.windows[index]
    predicted = (table.columns(window) @ weights)[: 3 * 11].reshape(3, 11).T
    velocity = window.knots["vel_w"]
    truth = -0.02 * norm(velocity, axis=1)[:, None] * velocity
    assert norm(predicted - truth) < LEFT * norm(truth)
    data = tabulate_unexplained(point, 0)
    again = ForceTable(
        *(np.array(data[k]) for k in ("mean", "deviation", "centres")), tuple(data["weights"])
    )
    speeds = np.column_stack((velocity, window.knots["rate_b"], window.knots["thrust"]))
    drag = again.radial(speeds) @ np.array(data["weights"]["vehicle force"]).T
    assert norm(drag - truth) < LEFT * norm(truth)


def test_nats_of_a_term_beside_a_name_and_its_size_are_those_of_two_numbers():
    """A term and a name of known information, against the maxima of their likelihoods."""
    information, score = np.array([[4.0, 2.0], [2.0, 9.0]]), np.array([2.0, 6.0])
    term = terms.as_effect(laws.Term("payload force", (), "vel"), 100.0, 0.0)
    effects = (replace(catalogue(1)[0], prior_sd=1.0, floor=1.0), term)
    priors = Priors.of(effects, ("pos_w", "payload_pos_w"))
    problem = SimpleNamespace(priors=priors, effects=effects)
    point = SimpleNamespace(problem=problem, posterior=Posterior(information, score, priors))
    both, name = 0.5 * score @ np.linalg.solve(information, score), 0.5 * score[0] ** 2 / 4.0
    screened = terms.Screen(
        (), np.ones(1), information[1:, 1:, None], score[1:, None], information[1:, None]
    )
    known = replace(priors, **{n: getattr(priors, n)[:1] for n in ("floor", "slab", "low", "high")})
    posterior = Posterior(information[:1, :1], score[:1], known)
    beside = SimpleNamespace(posterior=posterior, windows=())
    screened.cross = screened.cross[:, :, :1]
    (nats,) = terms.Survey(beside, [], []).unsaid(screened, [0])
    assert nats == approx(both - name, rel=1e-3)
    (law,) = terms.laws(point, [0, 1], 5.0)
    covariance = np.linalg.inv(information + np.diag(priors.slab**-2.0))
    assert law.sd == approx(term.floor * covariance[1, 1] ** 0.5)
    assert law.covariance == approx((law.sd**2,))

"""Laws outside the catalogue: terms with units, found and told from names; tables where no formula is asked for."""

from dataclasses import replace

import numpy as np
import pytest

from tests.synthetic_diagnosis import SyntheticModel, catalogue
from visthrow.diagnose import grammar, result, search
from visthrow.diagnose.blackbox import Table, table_of, train, unexplained
from visthrow.diagnose.model import LATENT_BLOCKS

EFFECTS = catalogue(12)
LEFT = 0.7  # of a hidden force after a table learnt from a dozen throws, in a throw that it has not seen: a table is no formula
KNOTS = (
    "time", "pos_w", "vel_w", "quat_wb", "rate_b", "thrust", "payload_pos_w", "payload_vel_w", "cable_dir_w", "tension",
)  # fmt: skip


def turned(knots: dict, angle: float) -> dict:
    """The same flight in a world turned about the vertical."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    half = np.array([0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)])
    out = dict(knots)
    for name in ("pos_w", "vel_w", "payload_pos_w", "payload_vel_w", "cable_dir_w"):
        out[name] = knots[name] @ turn.T
    x, y, z, w = knots["quat_wb"].T
    a, b = half[2], half[3]
    out["quat_wb"] = np.column_stack((b * x - a * y, b * y + a * x, b * z + a * w, b * w - a * z))
    return out


def random_knots(seed: int = 0) -> dict:
    rng = np.random.default_rng(seed)
    unit = lambda v: v / np.linalg.norm(v, axis=1, keepdims=True)  # noqa: E731
    k = 6
    return {
        "time": np.arange(k) * 0.1, "pos_w": rng.normal(size=(k, 3)) + [0, 0, 3], "vel_w": rng.normal(size=(k, 3)),
        "quat_wb": unit(rng.normal(size=(k, 4))), "rate_b": rng.normal(size=(k, 3)), "thrust": rng.uniform(1, 4, k),
        "payload_pos_w": rng.normal(size=(k, 3)), "payload_vel_w": rng.normal(size=(k, 3)),
        "cable_dir_w": unit(rng.normal(size=(k, 3))), "tension": rng.uniform(0, 1, k),
    }  # fmt: skip


@pytest.mark.parametrize("block", LATENT_BLOCKS)
def test_terms_turn_with_the_world(block):
    """Frame-covariant: forces turn with the world about the vertical, torques in the body do not notice."""
    knots, angle = random_knots(), 0.7
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) if block != "vehicle torque" else np.eye(3)
    terms = grammar.terms(block, KNOTS)
    assert len(terms) > 300
    values = grammar.table_of(terms, knots)
    again = grammar.table_of(terms, turned(knots, angle))
    np.testing.assert_allclose(again, np.einsum("ij,kjt->kit", turn, values), atol=1e-9 * np.abs(values).max())


def test_the_table_of_terms_holds_each_term():
    knots = random_knots()
    terms = grammar.terms("payload force", KNOTS)
    values = grammar.table_of(terms, knots)
    for i in (0, 17, len(terms) - 1):
        np.testing.assert_allclose(values[:, :, i], terms[i].values(knots))


@pytest.mark.parametrize(("term", "unit", "formula"), [
    (grammar.Term("vehicle force", ("speed",), "vel"), "kg m^-1", "F = c |v| v"),
    (grammar.Term("vehicle force", ("thrust", "speed_across_squared"), "body_z"), "m^-2 s^2", "F = c T v_xy² e_z"),
    (grammar.Term("payload force", (), "vertical_cross_vel"), "kg s^-1", "F_p = c (z x v_p)"),
    (grammar.Term("vehicle torque", ("thrust",), "axis_cross_vel"), "s", "M = c T (e_z x v)"),
    (grammar.Term("vehicle force", ("thrust",), "body_z"), "1", "F = c T e_z"),
])  # fmt: skip
def test_units_and_formulas(term, unit, formula):
    assert term.unit == unit
    assert term.formula == formula


def test_terms_that_lack_their_knots_are_not_made():
    for term in grammar.terms("vehicle force", ("time", "vel_w")):
        assert term.vector in ("world_z", "vel")
        assert set(term.factors) <= {"speed"}


@pytest.mark.parametrize(("law", "size", "formula"), [
    ("speed", -0.01, "F = c |v| v"), pytest.param("swirl", 0.01, "F_p = c (z x v_p)", marks=pytest.mark.slow),
    pytest.param("thrust", 0.012, "F = c T v_xy² e_z", marks=pytest.mark.slow),
])  # fmt: skip
def test_hidden_laws_are_written_down(law, size, formula):
    model = SyntheticModel(effects=EFFECTS, law=law, law_size=abs(size), seed=3)
    diagnosis = search.explain(model)
    assert diagnosis.overall == result.UNKNOWN
    assert not diagnosis.theta
    first = diagnosis.laws[0]
    assert diagnosis.block == first.block
    assert formula in [term.formula for term in diagnosis.laws[:3]]
    own = next(term for term in diagnosis.laws if term.formula == formula)
    assert own.coefficient == pytest.approx(size, rel=0.1)
    assert own.interval[0] < own.coefficient < own.interval[1]


def test_a_law_beside_a_known_cause_leaves_the_cause_its_name():
    model = SyntheticModel(effects=EFFECTS, law="swirl", law_size=0.01, truth={"effect_03": 12.0}, seed=3)
    diagnosis = search.explain(model)
    assert diagnosis.overall == result.UNKNOWN
    assert diagnosis.block == "payload force"
    assert diagnosis.named == ("effect_03",)
    assert diagnosis["effect_03"].low < 12.0 * EFFECTS[3].floor < diagnosis["effect_03"].high
    first = diagnosis.laws[0]  # the screen prefers S (z x v_p); joined by the right term it is worth nothing
    assert first.formula == "F_p = c (z x v_p)"
    assert first.interval[0] < 0.01 < first.interval[1]
    formulas = [law.formula for law in diagnosis.laws]
    assert len(set(formulas)) == len(formulas)


def with_a_name_for_the_law(most: float) -> SyntheticModel:
    """A hidden drag of 0.02, and an effect of the very same form that is unusual beyond 0.005 and cannot exceed ``most``."""
    model = SyntheticModel(effects=EFFECTS, law="speed", law_size=0.02, seed=3)
    model.effects = (EFFECTS[0], replace(EFFECTS[1], floor=1e-3, prior_sd=3e-3, bounds=(-0.1, most)), *EFFECTS[2:])
    for w in model._windows:
        w.effects[:, 1] = w.latent @ model._law(w.knots) / model.law_size
    return model


def test_a_law_takes_no_name_away_that_says_the_same():
    """The name is far larger than usual and close to its bound, which costs it nats that the nameless term does not pay."""
    diagnosis = search.explain(with_a_name_for_the_law(0.0198))
    assert diagnosis.overall == result.KNOWN
    assert diagnosis.named == ("effect_01",)
    assert diagnosis["effect_01"].estimate == pytest.approx(0.02, abs=1e-3)


def test_a_name_that_would_have_to_exceed_its_bound_stays_none():
    diagnosis = search.explain(with_a_name_for_the_law(0.01))
    assert diagnosis.overall == result.UNKNOWN
    assert not diagnosis.named


def test_known_causes_and_gusts_are_no_laws():
    diagnosis = search.explain(SyntheticModel(effects=EFFECTS, truth={"effect_03": 12.0}, gust=2.0, seed=5))
    assert diagnosis.overall == result.KNOWN
    assert not diagnosis.laws


def test_the_table_takes_up_what_no_name_explains():
    """Weights from some flights predict the hidden drag in a flight that they have not seen."""
    model = SyntheticModel(effects=EFFECTS, law="speed", law_size=0.02, seed=3, throws=12)
    point = search.explain(model, laws=False).work.before
    table = table_of(point, np.random.default_rng(0))
    flights = [w.flight for w in point.windows]
    trained = train(point, table, flights)
    weights = trained.weights(trained.groups != 5)
    index = next(i for i, w in enumerate(point.windows) if w.flight == 5 and w.phase == "throw")
    window = point.windows[index]
    asked = (table.columns(window) @ weights)[: 3 * 11].reshape(3, 11).T
    velocity = window.knots["vel_w"]
    truth = -0.02 * np.linalg.norm(velocity, axis=1)[:, None] * velocity
    assert np.linalg.norm(asked - truth) < LEFT * np.linalg.norm(truth)
    data = unexplained(point, 0)
    again = Table(*(np.array(data[k]) for k in ("mean", "deviation", "centres")), tuple(data["weights"]))
    speeds = np.column_stack((velocity, window.knots["rate_b"], window.knots["thrust"]))
    drag = again.radial(speeds) @ np.array(data["weights"]["vehicle force"]).T
    assert np.linalg.norm(drag - truth) < LEFT * np.linalg.norm(truth)

"""Laws in the models of setups: reported where an independent generator hid one, written into the
setup, and better on held-out flights.
"""

import json
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.linalg import norm
from pytest import approx, mark, raises
from scipy.spatial.transform import Rotation

from bench.diagnose import foreign, small
from bench.diagnose.flown import ball_log, fly
from sim.params import LawParams
from tests.commands import run_command
from tests.places import DATA
from tests.unit.on_diagnose.test_models import BALL, FLYER
from visthrow.common.errors import LogError
from visthrow.diagnose.inputs import setup as setups
from visthrow.diagnose.likelihood.grammar import TermEffect, forces
from visthrow.diagnose.models.ball import BallModel
from visthrow.diagnose.models.law_terms import term_of
from visthrow.diagnose.models.model_interface import Window
from visthrow.diagnose.models.numeric import NumericModel
from visthrow.diagnose.models.quadrotor.flyer import FlyerModel
from visthrow.diagnose.models.quadrotor.flyer_params import TorqueParams
from visthrow.diagnose.select import diagnose_flights
from visthrow.logs.flightlog import Channel, FlightLog

TURNING = replace(
    FLYER, torque=TorqueParams((2e-5, 2e-5, 3e-5), 0.03, 0.03, 0.006, (1.0, -1.0, -1.0, 1.0))
)


def fly_slung() -> NumericModel:
    """A quadrotor with a ball on a cable."""
    world = foreign.draw_world(0)[2]
    return FlyerModel(
        [foreign.fly_lissajous(world, np.random.default_rng(0), 4.0)],
        foreign.describe_vehicle("crazyflie"),
    )


def fly_turning() -> NumericModel:
    """A quadrotor whose rates are simulated."""
    log = fly(4.0, drag=0.02)
    time, quat = log["quat_wb"].samples()
    turned = Rotation.from_quat(quat)
    rates = (turned[:-1].inv() * turned[1:]).as_rotvec() / np.diff(time)[:, None]
    return FlyerModel(
        [FlightLog({**log.channels, "rate_b": Channel(time[:-1], rates, "rad/s", "body")})], TURNING
    )


MODELS = {
    "ball": lambda: BallModel([ball_log(drag=0.04, spin=(0.0, 0.0, 0.3), seed=1)], BALL),
    "flyer": fly_turning,
    "slung": fly_slung,
    "pendulum": lambda: small.model_of("pendulum", small.logs_of("pendulum", "", 3, 1)),
    "trim": lambda: small.model_of("trim", small.logs_of("trim", "", 3, 1)),
}
ACTING = [
    ("ball", LawParams("payload force", ("payload_speed",), "vertical_cross_vel", 0.01)),
    ("flyer", LawParams("vehicle force", ("speed",), "axis_cross_vel", 1e-3)),
    ("flyer", LawParams("vehicle force", ("thrust_rate",), "body_z", 1e-4)),
    ("flyer", LawParams("vehicle torque", (), "rate", -1e-6)),
    ("slung", LawParams("payload force", ("tension",), "swing_vel", -1e-2)),
    ("slung", LawParams("vehicle force", ("cable_under_rotors",), "rate_cross_vel", 1e-3)),
    ("pendulum", LawParams("payload force", ("tension",), "payload_vel", -1e-3)),
    ("pendulum", LawParams("payload force", ("payload_speed",), "sideways", 1e-2)),
    ("trim", LawParams("vehicle force", ("inverse_height",), "world_z", 0.02)),
    ("trim", LawParams("vehicle torque", ("speed",), "body_y", 0.02)),
]


@cache
def load_undisturbed(kind: str) -> tuple[NumericModel, list[Window]]:
    """Return a model and its windows without any effect."""
    model = MODELS[kind]()
    return model, model.windows({})


@mark.parametrize(("kind", "law"), ACTING)
def test_a_law_in_the_simulation_does_what_its_column_says(kind, law):
    """Two computations agree: forces at the knots through the latents' derivatives, and the law in
    every step.

    The kind's other laws stand beside it with a coefficient of 0, so that one kernel serves all.
    """
    model, windows = load_undisturbed(kind)
    of_kind = [other for its, other in ACTING if its == kind]
    laws = [other if other is law else replace(other, coefficient=0.0) for other in of_kind]
    term = term_of(law)
    effect = TermEffect(
        term.formula, "", "", "", law.block, (-1.0, 1.0), 1.0, 1.0, (), "", term=term
    )
    residuals = model.with_laws(laws).residuals({})
    column, change = [], []
    for window, residual in zip(windows, residuals):
        basis = np.linalg.qr(window.nuisance)[0]  # initial states are fitted in both
        basis_columns = np.column_stack(
            [
                window.latent @ forces(window, [effect])[:, 0] * law.coefficient,
                window.residual - residual,
            ]
        )
        basis_columns = (basis_columns - basis @ (basis.T @ basis_columns)) / window.sigma[:, None]
        column.append(basis_columns[:, 0])
        change.append(basis_columns[:, 1])
    column, change = np.concatenate(column), np.concatenate(change)
    assert norm(column) > 0.1
    slope = column @ change / (column @ column)
    assert slope == approx(1.0, abs=0.1)
    assert norm(change - slope * column) < 0.25 * norm(column)


@mark.parametrize("kind", list(small.WORLDS))
def test_nothing_hidden_is_no_effect(kind):
    diagnosis = diagnose_flights.explain(small.model_of(kind, small.logs_of(kind, "", 1)))
    assert diagnosis.overall == "NO EFFECT"
    assert not diagnosis.laws


def test_what_cannot_act_is_refused():
    torque, pull = (
        LawParams("vehicle torque", (), "rate", 1e-6),
        LawParams("payload force", ("tension",), "payload_vel", 0.1),
    )
    with raises(LogError, match="M = c ω cannot act here: this model has no vehicle torque"):
        FlyerModel([fly(4.0)], FLYER).extend({}, [torque])
    with raises(LogError, match="this model has no tension"):
        MODELS["ball"]().extend({}, [pull])
    with raises(ValueError, match="no factor 'tensoin'; did you mean 'tension'"):
        replace(pull, factors=("tensoin",))


def test_an_unknown_of_a_model_without_laws_says_so(tmp_path, monkeypatch, printed):
    monkeypatch.chdir(tmp_path)
    tests = DATA / "real" / "motor_prop_stand" / "all_tests.csv.gz"
    output = printed(f"diagnose explain {tests}:a1_* --config motor_stand --no-report")
    assert "UNKNOWN" in output
    assert f"no law outside the catalogue is looked for: {setups.MODELS['stand'].lawless}" in output


@mark.parametrize("kind", ["imu", "stand"])
def test_models_without_laws_say_why(kind, tmp_path, capsys):
    law = {
        "formula": "F = c z",
        "block": "vehicle force",
        "factors": [],
        "vector": "world_z",
        "coefficient": 1.0,
        "sd": 0.1,
    }
    given = {
        "model": kind,
        "config": "motor_stand",
        "theta": {},
        "covariance": [],
        "findings": [],
        "explanations": [[law]],
    }
    (tmp_path / "diagnosis.json").write_text(json.dumps(given))
    out = tmp_path / "extended.toml"
    assert run_command(f"diagnose apply {tmp_path}/diagnosis.json --laws 1 --out {out}") == 2
    error = capsys.readouterr().err
    assert f"no law can act in the model '{kind}'" in error
    assert setups.MODELS[kind].lawless in error
    assert not out.exists()

"""The models of examples against independent physics: scipy's integrator, closed forms, recovery of
planted parameters; and on published recorded data.
"""

import re

import numpy as np
from numpy.random import default_rng
from pytest import approx, mark, raises
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from examples.gimbal.gimbal_model import SLUNG_LOAD, GimbalModel, GimbalParams
from examples.pendulum.swing_model import ENCODER, PendulumModel, PendulumParams
from examples.trim.trim_model import E8, TrimModel
from tests.flightlogs import log_at
from tests.places import DATA
from tests.unit.on_diagnose.test_models import assert_near, estimate
from visthrow.common.errors import LogError
from visthrow.diagnose.inputs import setup as setups
from visthrow.diagnose.reporting.explain_cli import write_report
from visthrow.diagnose.select.diagnose_flights import explain
from visthrow.diagnose.select.result import FOUND, IN_PART, KNOWN, NAMED, NO_EFFECT
from visthrow.logs.flightlog import FlightLog
from visthrow.logs.readers import table_to_log

G = 9.81
REAL = DATA / "real"
SWING = PendulumParams(G, 0.2, 0.0, 0.0, 0.0, 0.0, 2.0, 0.01, 2)


def swing_log(length, viscous, coulomb, quadratic, offset) -> FlightLog:
    def slope(_, state):
        angle, rate = state
        friction = viscous * rate + coulomb * np.tanh(rate / 0.02) + quadratic * abs(rate) * rate
        return [rate, -G / length * np.sin(angle) - friction]

    time = np.arange(0.0, 12.0, 0.005)
    angle = solve_ivp(
        slope, (0, 12.0), [1.2, 0.0], t_eval=time, max_step=0.005, rtol=1e-9, atol=1e-10
    ).y[0]
    return log_at(time, angle=angle + offset + default_rng(1).normal(0, 2e-4, len(time)))


def test_frictions_are_distinguished():
    log = swing_log(0.21, viscous=0.05, coulomb=0.1, quadratic=0.02, offset=0.01)
    truth = {
        "pendulum_length": 0.01,
        "viscous_friction": 0.05,
        "coulomb_friction": 0.1,
        "quadratic_drag": 0.02,
        "encoder_offset": 0.01,
    }
    estimates = estimate(PendulumModel([log], SWING), [*truth])
    assert all(assert_near(estimates, name, size) for name, size in truth.items()), estimates
    assert estimates["pendulum_length"][0] == approx(0.01, rel=0.02)


GIMBAL = GimbalParams(
    (0.0, 0.0, -0.1), 0.02, (-90.0, 0.0, -90.0), 0.0, 0.01, 0.02, False, 4.0, 1, 1.0
)


def gimbal_logs(tilt, focal, delay) -> list[FlightLog]:
    """A payload that swings below a vehicle that looks down; the marker by a chain of rotations
    of scipy's.
    """
    rng = default_rng(2)
    time = np.arange(0, 20, 1 / 30)

    def look(t):
        turn = Rotation.from_euler(
            "ZYX",
            np.column_stack([0.3 * np.sin(0.4 * t), 0.1 * np.sin(t), 0.12 * np.cos(1.3 * t)]),
        )
        gap = np.column_stack(
            [0.5 * np.sin(1.8 * t), 0.4 * np.cos(1.7 * t), -3.0 + 0.1 * np.sin(t)]
        )
        gimbal = Rotation.from_euler("XY", [0.05, np.pi / 2])
        local = gimbal.inv().apply(turn.inv().apply(gap) - [0, 0, -0.1]) - [0.02, 0, 0]
        return turn, gap, np.column_stack([-local[:, 1], -local[:, 2], local[:, 0]])

    turn, gap, _ = look(time)
    point = Rotation.from_rotvec(tilt).apply(look(time - delay)[2]) * [focal, focal, 1.0]
    gimbal = np.tile([0.05, np.pi / 2], (len(time), 1))
    log = log_at(
        time,
        pos_w=np.tile([0, 0, 4.0], (len(time), 1)),
        quat_wb=turn.as_quat(),
        payload_pos_w=gap + [0, 0, 4],
        marker_pos_c=point + rng.normal(0, 0.005, point.shape),
        gimbal=gimbal,
    )
    return [log]


def test_tilt_delay_and_focal_length_are_found():
    model = GimbalModel(gimbal_logs((0.02, -0.015, 0.01), 0.97, 0.06), GIMBAL)
    truth = {
        "camera_tilt_x": 0.02,
        "camera_tilt_y": -0.015,
        "camera_tilt_z": 0.01,
        "camera_delay": 0.06,
        "focal_scale": -0.03,
    }
    estimates = estimate(model, [*truth])
    assert all(abs(estimates[name][0] - value) < 0.003 for name, value in truth.items())


SWUNG = REAL / "pendulum_single" / "single_pendulum_id.csv.gz"
CUT = REAL / "crazypad_faults" / "cut_propeller_M3_2.5mm_2.5mm_42mm__E8_log00.csv.gz"
TAPED = REAL / "crazypad_faults" / "tape_on_propeller_M3__E8_log00.csv.gz"
CAMERA_BAG = DATA / "slungload_camera" / "rosbag_16.csv.gz"


def named_in(diagnosis) -> set[str]:
    return {f.name for f in diagnosis.findings if f.verdict in NAMED}


def error_of(model, theta) -> float:
    return float(np.sqrt(np.mean(np.concatenate(model.residuals(theta)) ** 2)))


@mark.slow
def test_pendulum_has_three_frictions():
    model = PendulumModel(setups.read_logs([SWUNG], "pendulum_encoder"), ENCODER)
    diagnosis = explain(model)
    assert diagnosis.overall == IN_PART  # what is left is a hundred times the encoder's noise
    assert {"pendulum_length", "coulomb_friction", "quadratic_drag"} <= named_in(diagnosis)
    assert diagnosis["pendulum_length"].estimate == approx(-0.0167, abs=3e-4)
    assert diagnosis["encoder_scale"].verdict != FOUND  # a spring at the joint does the same
    assert error_of(model, diagnosis.theta) < 0.1 * error_of(model, {})


def test_a_cut_propeller_is_found_and_tape_is_not():
    diagnosis = explain(TrimModel(setups.read_logs([CUT], "crazypad"), E8))
    assert diagnosis.overall == KNOWN
    assert "motor_rl" in named_in(diagnosis)
    assert diagnosis["motor_rl"].estimate == approx(-0.15, abs=0.04)
    assert set(diagnosis.theta) <= {"motor_rl", "added_rl"}
    diagnosis = explain(TrimModel(setups.read_logs([TAPED], "crazypad"), E8))
    assert diagnosis.overall == NO_EFFECT
    assert not named_in(diagnosis)


@mark.slow
def test_means_are_held_out_and_have_a_page(tmp_path, capsys):
    """Windows of one sample without a state at their start: the motor that is named predicts the
    parts that were left out.
    """
    logs = setups.read_logs([CUT], "crazypad")
    model = TrimModel(logs, E8)
    write_report(tmp_path, explain(model), model, logs, seed=0, limits=False)
    output = capsys.readouterr().out
    assert re.search(r"held-out error of motor_wanted: 0.066\d? -> 0.02\d+, [56]\d % less", output)
    assert "nan" not in output
    assert (tmp_path / "report.html").is_file()


def test_the_camera_sees_the_load_nearer_the_axis():
    paths = sorted((DATA / "slungload_camera").glob("*.gz"))
    model = GimbalModel(setups.read_logs(paths, "slungload_camera"), SLUNG_LOAD)
    diagnosis = explain(model)
    named = named_in(diagnosis)
    assert "focal_scale" in named
    # -0.11 in these pieces, -0.13 in the whole bags
    assert diagnosis["focal_scale"].estimate == approx(-0.12, abs=0.025)
    assert named & {"camera_tilt_x", "marker_rot_y"}
    assert named & {"camera_tilt_y", "marker_rot_x"}
    assert error_of(model, diagnosis.theta) < 0.6 * error_of(model, {})


def swung(columns: dict) -> PendulumModel:
    mapping = setups.load("pendulum_encoder").table
    return PendulumModel(table_to_log.logs_of(columns, mapping, "a table"), ENCODER)


def filmed(columns: dict) -> GimbalModel:
    mapping = setups.load("slungload_camera").table
    return GimbalModel(table_to_log.logs_of(columns, mapping, "a table"), SLUNG_LOAD)


@mark.parametrize(
    ("model", "path", "change", "words"),
    [
        (swung, SWUNG, lambda t: {"theta_rad": np.nan * t["theta_rad"]}, "missing .* angle"),
        (swung, SWUNG, lambda t: {"theta_rad": np.degrees(t["theta_rad"])}, "degrees, or another"),
        (
            filmed,
            CAMERA_BAG,
            lambda t: {"l_px": np.nan * t["l_px"]},
            "missing everywhere: payload_pos_w",
        ),
        (
            filmed,
            CAMERA_BAG,
            lambda t: {"d_px": t["d_py"], "d_py": t["d_px"]},
            "other axes, another unit, or another marker",
        ),
    ],
)
def test_spoiled_channels_are_refused(model, path, change, words):
    columns = table_to_log.read_table(path)
    assert model(columns).stretches  # as it is, it can be looked at
    with raises(LogError, match=words):
        model(columns | change(columns))

"""A diagnosis written into a configuration, which training and the next diagnosis read."""

import json
from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
from pytest import approx, fixture, mark, raises

from sim.params import LawParams
from tests.commands import run_command
from tests.configs import load_experiment
from tests.unit.on_diagnose.test_models import ball_log
from tests.unit.on_sim.test_firmware import SETTINGS
from visthrow import config
from visthrow.common.errors import ConfigError, LogError
from visthrow.config.effects import catalogue
from visthrow.diagnose.apply import patch
from visthrow.diagnose.inputs import setup as setups
from visthrow.task import DiagnosedParams, Experiment, draw_plants, plant_of

THETA = {
    "thrust_gain": 0.03,
    "mass_quad": 0.006,
    "rope_length": -0.004,
    "wind_x": 0.2,
    "frame_tilt_x": 0.01,
}
COVARIANCE = np.diag([0.01, 0.002, 0.0005, 0.02, 0.001]) ** 2
COVARIANCE[0, 1] = COVARIANCE[1, 0] = 0.99 * 0.01 * 0.002


def shipped() -> Experiment:
    return load_experiment("state")


@fixture
def diagnosis(tmp_path):
    """A diagnosis as explain writes it; a function that changes entries."""

    def write(**changes):
        value = {
            "plant": "state",
            "theta": THETA,
            "covariance": COVARIANCE.tolist(),
            "overall": "KNOWN",
            "flights": 12,
            "gain": {
                "channels": [{"channel": "pos_w", "before": 2.0, "after": 1.0}],
                "nats_per_sample": 0.4,
            },
            "summary": ["KNOWN: rope_length.", "12 flights"],
        }
        path = tmp_path / "diagnosis.json"
        path.write_text(json.dumps(value | changes))
        return str(path)

    return write


def test_apply_writes_what_training_reads(diagnosis, tmp_path, capsys):
    out = tmp_path / "mine.toml"
    scatter = [
        {"name": "lag_jitter", "found": True, "size": 0.01, "unit": "s", "of": ["release_lag"]}
    ]
    given = diagnosis(scatter=scatter)
    assert run_command(f"diagnose apply {given} --out {out} --plants 8") == 0
    capsys.readouterr()
    after, before = load_experiment(out), shipped()
    assert_allclose(after.vehicle.thrust.gain, 1.03)
    assert after.vehicle.body.mass == approx(before.vehicle.body.mass + 0.006)
    assert after.rope.length == approx(before.rope.length - 0.004)
    assert after.air.wind_w == (0.2, 0.0, 0.0)
    assert after.sensing.frame_tilt == (0.01, 0.0, 0.0)
    assert after.diagnosed.effects == (
        "thrust_gain",
        "mass_quad",
        "rope_length",
        "wind_x",
        "release_lag",
    )  # no tilted frame
    assert_allclose(np.array(after.diagnosed.covariance)[:4, :4], COVARIANCE[:4, :4])
    lags = [
        plant.release.lag for plant in draw_plants(after, 0)
    ]  # what varies from throw to throw does so in training
    assert np.std(lags) == approx(0.01, rel=0.5)
    assert len(set(lags)) == 8
    assert after.vehicle.motor == before.vehicle.motor
    assert after.ppo == before.ppo
    text = out.read_text()
    assert 'base = "train/state.toml"' in text
    assert "# KNOWN: rope_length.\n# 12 flights\n" in text
    for line in text.splitlines():
        assert " = " not in line or "#" in line or line.startswith("base"), line


def test_the_charge_of_the_flights_is_not_written_to_the_vehicle(diagnosis, tmp_path, printed):
    out = tmp_path / "mine.toml"
    theta = {"battery_charge": 0.04, "thrust_gain": 0.03}
    path = diagnosis(theta=theta, covariance=[[1e-4, 9e-5], [9e-5, 4e-4]])
    output = printed(f"diagnose apply {path} --out {out}")
    assert "Not written: battery_charge" in output
    assert "Not written: battery_charge" in out.read_text()
    after = load_experiment(out)
    assert after.vehicle.battery == shipped().vehicle.battery
    assert after.diagnosed.effects == ("thrust_gain",)
    assert after.diagnosed.covariance == ((4e-4,),)
    assert_allclose(after.vehicle.thrust.gain, 1.03)
    alone = diagnosis(theta={"battery_charge": 0.04}, covariance=[[1e-4]])
    output = printed(f"diagnose apply {alone} --out {tmp_path}/none.toml")
    assert "Not written: battery_charge" in output
    assert "the configuration is unchanged" in output
    assert not (tmp_path / "none.toml").exists()


def test_sizes_count_from_the_model_that_was_diagnosed(diagnosis, tmp_path, refused):
    """The plant and overrides of the diagnosis are written, not the shipped ones; for another plant
    nothing is written.
    """
    quick, out = tmp_path / "quick.toml", tmp_path / "mended.toml"
    quick.write_text('base = "train/state.toml"\n[release]\nlag = 0.08\n')
    sizes = {
        "theta": {"release_lag": 0.03},
        "covariance": [[1e-6]],
        "overrides": ["rope.length=0.5"],
    }
    for plant, option, message in (
        (str(quick), "--plant state", "do not count from state"),
        (None, "", "names no plant"),
    ):
        report = diagnosis(plant=plant, **sizes)
        refused(f"diagnose apply {report} {option} --out {out}", message=message)
    assert not out.exists()
    assert run_command(f"diagnose apply {diagnosis(plant=str(quick), **sizes)} --out {out}") == 0
    after = load_experiment(out)
    assert (after.release.lag, after.rope.length) == approx((0.11, 0.5))


def test_a_law_is_written_as_a_block(diagnosis, tmp_path, refused, printed):
    law = {
        "formula": "F_p = c (z x v_p)",
        "block": "payload force",
        "factors": ["speed"],
        "vector": "vertical_cross_vel",
        "coefficient": 0.02,
        "sd": 0.001,
        "unit": "kg m^-1",
        "nats": 40.0,
    }
    out = tmp_path / "law.toml"
    command = (
        f"diagnose apply {diagnosis(theta={}, covariance=[], explanations=[[law]])} --out {out}"
    )
    assert "vertical_cross_vel" in printed(f"{command} --laws 1")
    assert load_experiment(out).laws == (
        LawParams("payload force", ("speed",), "vertical_cross_vel", 0.02),
    )
    refused(
        f"{command} --laws 2", message="asks for number 2 of its laws; expected a number up to 1"
    )
    assert "--laws 1 writes it" in printed(command)
    path = diagnosis(theta={}, covariance=[], explanations=[[law | {"factors": ["sped"]}]])
    command = f"diagnose apply {path} --out {tmp_path / 'other.toml'} --laws 1"
    refused(command, message="no factor 'sped'; did you mean 'speed'?")


def test_a_formula_without_a_coefficient_is_no_law_to_write(diagnosis, tmp_path, refused):
    reason = "F = f(|v|) v, with any function f, explains 40 nats"
    path = diagnosis(theta={}, covariance=[], overall="UNKNOWN", reasons=[reason])
    command = f"diagnose apply {path} --out {tmp_path / 'law.toml'} --laws 1"
    refused(command, message="it holds none")
    refused(command, message=reason)


def test_every_effect_can_be_written():
    before = shipped()
    setting = patch.generalise(patch.Setting(plant_of(before), camera=before.camera))
    for name, e in catalogue().items():
        if name != "step_error" and e.applies(setting):  # whose step is the replay's
            theta = {name: 1.0 if e.switch else e.floor}
            content = patch.text("train/state.toml", before, theta, [[1e-12]], 1, ["test"])
            after = config.loads(Experiment, content)
            assert after != before, name
            assert patch.extend(before, theta).vehicle == after.vehicle, name


def test_draws_keep_what_is_pinned_together():
    before = shipped()
    loose = DiagnosedParams(
        ("thrust_gain", "mass_quad"), tuple(map(tuple, COVARIANCE[:2, :2])), 400
    )
    plants = draw_plants(replace(before, diagnosed=loose), 1)
    gain = np.array([p.vehicle.thrust.gain[0] for p in plants]) - 1.0
    mass = np.array([p.vehicle.body.mass for p in plants]) - before.vehicle.body.mass
    assert np.std(gain) == approx(0.01, rel=0.15)
    assert np.corrcoef(gain, mass)[0, 1] > 0.97
    assert draw_plants(before, 1) == [plant_of(before)]
    assert draw_plants(replace(before, diagnosed=loose), 1) == plants


def test_draws_that_share_a_number_keep_to_its_bounds_together():
    before = shipped()
    spread = before.vehicle.aero.drag_z
    loose = DiagnosedParams(
        ("rotor_drag_z", "rotor_drag"), ((spread**2, 0.0), (0.0, 4.0 * spread**2)), 50
    )
    plants = draw_plants(replace(before, diagnosed=loose), 1)
    drags = [plant.vehicle.aero.drag_z for plant in plants]
    assert min(drags) == approx(0.0, abs=1e-15)
    assert max(drags) > spread


@mark.parametrize(
    ("changes", "message"),
    [
        ({"theta": {"no_such": 1.0}, "covariance": [[1.0]]}, "not effects of the throw: no_such"),
        ({"covariance": [[1.0]]}, "expected 25"),
        ({"theta": None}, "not a diagnosis"),
        (
            {"gain": {"channels": [{"channel": "pos_w", "before": 1.0, "after": 1.5}]}},
            "do not confirm this",
        ),
        ({"model": "flyer"}, "a diagnosis of the model 'flyer'"),
        ({"theta": {"thrust_curve": -0.481}, "covariance": [[1e-3]]}, "from -0.0004 to 0.0004"),
        (
            {
                "theta": {"thrust_curve": -1e-4},
                "covariance": [[1e-9]],
                "findings": [{"name": "thrust_curve", "unit": "1"}],
            },
            "thrust_curve in '1'; the throw's thrust_curve is in 'N s/rad'",
        ),
    ],
)
def test_mistakes_are_reported(diagnosis, changes, message, tmp_path, refused):
    out = tmp_path / "x.toml"
    refused(f"diagnose apply {diagnosis(**changes)} --out {out}", message=message)
    assert not out.exists()


def test_nothing_named_writes_nothing(diagnosis, tmp_path, printed):
    nothing = diagnosis(theta={}, covariance=[])
    assert "nothing to write" in printed(f"diagnose apply {nothing} --out {tmp_path}/x.toml")


BALL = {
    "model": "ball",
    "theta": {"ball_drag": 0.03},
    "covariance": [[1e-8]],
    "findings": [{"name": "ball_drag", "unit": "1/m"}],
}


def test_other_models_have_extended_setups(diagnosis, tmp_path):
    """The next diagnosis and the next extension of the setup count sizes from there, too."""
    out, again = tmp_path / "once.toml", tmp_path / "twice.toml"
    of_ball = diagnosis(**BALL, config="jugglebot")
    assert run_command(f"diagnose apply {of_ball} --out {out}") == 0
    assert run_command(f"diagnose apply {diagnosis(**BALL)} --config {out} --out {again}") == 0
    assert setups.load(out).effects == {"ball_drag": 0.03}
    assert setups.load(again).effects == approx({"ball_drag": 0.06})
    varies = {"found": True, "name": "drag", "of": ["ball_drag"], "size": 0.01}
    varies |= {"unit": "1/m", "mean": {"ball_drag": 0.02}}  # whose mean is no finding
    report = diagnosis(
        **BALL | {"theta": {}, "covariance": []}, config="jugglebot", scatter=[varies]
    )
    assert run_command(f"diagnose apply {report} --out {again}") == 0
    assert setups.load(again).effects == {"ball_drag": 0.02}
    assert "+0.02 +- 0.01 1/m" in again.read_text()
    logs = [ball_log(drag=0.03, seed=1)]
    plain, extended = (setups.model_of(setups.load(name), logs) for name in ("jugglebot", out))
    assert_allclose(extended.residuals({})[0], plain.residuals({"ball_drag": 0.03})[0], atol=1e-9)
    assert extended.effects[0].bounds[0] == approx(plain.effects[0].bounds[0] - 0.03)


def test_what_does_not_belong_to_a_setup_is_refused(diagnosis, tmp_path, refused):
    out = tmp_path / "x.toml"
    refused(
        f"diagnose apply {diagnosis(**BALL)} --config motor_stand --out {out}",
        message="of the model 'ball'; the model of diagnose/motor_stand.toml is stand",
    )
    out.write_text('base = "diagnose/jugglebot.toml"\n[effects]\nball_drag = 0.4\n')
    for theta, unit, name, message in (
        (
            {"ball_drag": 9.0},
            "1/m",
            "jugglebot",
            "ball_drag = 9 1/m; expected from 0 to 0.5 in the ball",
        ),
        ({"ball_drag": 0.2}, "1/m", str(out), "ball_drag = 0.6 1/m; expected from"),
        (
            {"ball_drag": 0.1},
            "N",
            "jugglebot",
            "ball_drag in 'N'; the ball's ball_drag is in '1/m'",
        ),
        ({"thrust": 1.0}, "N", "jugglebot", "not effects of the ball: thrust"),
    ):
        report = diagnosis(
            **{**BALL, "theta": theta, "findings": [{"name": next(iter(theta)), "unit": unit}]}
        )
        refused(
            f"diagnose apply {report} --config {name} --out {tmp_path}/none.toml", message=message
        )
        assert not (tmp_path / "none.toml").exists()
    at_bound = diagnosis(**{**BALL, "theta": {"ball_drag": 0.1 + 1e-12}})
    assert run_command(f"diagnose apply {at_bound} --config {out} --out {tmp_path}/bound.toml") == 0
    setups.model_of(setups.load(tmp_path / "bound.toml"), [ball_log(seed=1)])
    for entry, message in (
        ("ball_drag = 9.0", "ball_drag = 9 1/m; expected from"),
        ("thrust = 1.0", "no effect 'thrust'"),
    ):
        out.write_text(f'base = "diagnose/jugglebot.toml"\n[effects]\n{entry}\n')
        with raises(LogError, match=message):
            setups.model_of(setups.load(out), [ball_log(seed=1)])


def test_a_broken_covariance_is_refused():
    with raises(ConfigError, match="one row and one column"):
        DiagnosedParams(("rope_length",), ((1.0, 2.0),), 2)
    bad = DiagnosedParams(("rope_length", "mass_quad"), ((1e-6, 1e-5), (1e-5, 1e-6)), 4)
    with raises(ConfigError, match="not a covariance"):
        draw_plants(replace(shipped(), diagnosed=bad), 0)


def test_a_blackbox_gives_its_firmwares_rate_controller(tmp_path, refused):
    """The header's settings become the block, the delay is the given one, and unsupported settings
    are named.
    """
    log, out = tmp_path / "LOG00001.BFL", tmp_path / "firmware.toml"
    header = SETTINGS | {
        "Firmware revision": "Betaflight 4.6.0",
        "tpa_rate": "65",
        "Field I name": "loopIteration,time",
        "Field I signed": "0,0",
        "Field I predictor": "0,0",
        "Field I encoding": "1,1",
        "Field P predictor": "6,2",
        "Field P encoding": "9,0",
    }
    text = "H Product:Blackbox flight data recorder by Nicholas Sherlock\nH Data version:2\n"
    log.write_bytes(
        (text + "".join(f"H {name}:{value}\n" for name, value in header.items())).encode()
        + b"I\x00\x05"
    )
    command = f"diagnose apply {log} --plant vision --out {out}"
    refused(command, message="--hover")
    assert run_command(f"{command} --hover 0.3645 --delay 0.003") == 0
    after = load_experiment(out)
    assert after.vehicle.controller.kind == "motor_mixing"
    assert after.vehicle.controller.p_gain[0] == approx(0.01748, rel=1e-3)
    assert after.vehicle.queue.delay == 0.003
    assert "# Not in the block: tpa_rate 65" in out.read_text()

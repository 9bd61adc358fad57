"""What closes the loop, but for flights and trainings: recording, extending, counting what was won back."""

import json

import numpy as np
import pytest

from visthrow import config
from visthrow.diagnose import loop
from visthrow.errors import DiagnoseError
from visthrow.flightlog import Channel, FlightLog
from visthrow.task import Experiment


def throws(error: float, failed: int = 0) -> dict:
    """A hundred throws of about this error, some of which did not land."""
    spread = 1.0 + 0.1 * np.cos(np.arange(100))
    return {"error": list(error * spread), "success": [i >= failed for i in range(100)], "duration": [1.0] * 100}


def test_share_won_back_by_hand():
    """From 0.10 m, of which 0.08 m are the effect's, to 0.04 m: 0.06 of 0.08."""
    found = loop.recovered({"before": throws(0.10), "after": throws(0.04), "oracle": throws(0.02)})
    assert found["share"] == pytest.approx(0.75, abs=1e-9)
    assert found["low"] < 0.75 < found["high"] < 0.8


def test_throws_that_did_not_land_do_not_count():
    part = throws(0.1, failed=40)
    part["error"][:40] = [np.inf] * 40
    assert len(loop.landed(part)) == 60
    none = throws(0.1, failed=100)
    assert np.isnan(loop.recovered({"before": none, "after": throws(0.1), "oracle": throws(0.1)})["share"])


def test_an_experiment_is_extended_by_plant_effects_alone():
    nominal = config.load(Experiment, config.find("train", "state"))
    changed = loop.extended(nominal, {"motor_tau": 0.01, "rope_length": -0.02, "frame_tilt_x": 0.01})
    assert changed.vehicle.motor.time_constant == pytest.approx(nominal.vehicle.motor.time_constant + 0.01)
    assert changed.rope.length == pytest.approx(nominal.rope.length - 0.02)
    assert changed.task == nominal.task
    with pytest.raises(DiagnoseError, match="motor_tua"):
        loop.extended(nominal, {"motor_tua": 0.01})


def test_a_hall_records_poses_with_its_noise_and_nothing_true():
    time = np.arange(0.0, 40.0, 0.02)
    level = np.tile([0.0, 0.0, 0.0, 1.0], (len(time), 1))
    place = np.zeros((len(time), 3))
    channels = {
        "pos_w": Channel(time, place, "m", "world"), "payload_pos_w": Channel(time, place, "m", "world"),
        "quat_wb": Channel(time, level, "1", "world"), "vel_w": Channel(time, place, "m/s", "world"),
        "command": Channel(time, np.tile([2.7, 0.0, 0.0, 0.0], (len(time), 1)), "N, rad/s", "body"),
        "release_command": Channel(time, np.zeros(len(time)), "1"),
    }  # fmt: skip
    meta = {"times": {"policy_start": 2.0, "landing": 38.0, "end": 40.0}, "policy": "state", "plant": "reference"}
    seen = loop.recorded_in_a_hall(FlightLog(channels, meta), np.random.default_rng(0))
    assert set(seen.channels) == {"pos_w", "payload_pos_w", "quat_wb", "command", "release_command"}
    assert seen["pos_w"].time[0] >= 2.0 - loop.BEFORE
    assert seen["payload_pos_w"].time[-1] <= 38.0 < seen["pos_w"].time[-1]
    for name in ("pos_w", "payload_pos_w"):
        assert seen[name].values.std() == pytest.approx(loop.NOISE[name], rel=0.05)
    assert 2.0 * seen["quat_wb"].values[:, :3].std() == pytest.approx(loop.NOISE["quat_wb"], rel=0.05)


def test_finished_loops_are_shown_and_others_refused(tmp_path):
    record = {
        "hidden": {"motor_tau": 0.02}, "named": {"motor_tau": 0.019},
        "throws": {"before": throws(0.10), "after": throws(0.04), "oracle": throws(0.02)},
        "recovered": {"share": 0.75, "low": 0.7, "high": 0.8},
    }  # fmt: skip
    (tmp_path / loop.RECORD).write_text(json.dumps(record))
    assert "| 75 % [70, 80] |" in loop.table(loop.read([tmp_path]))
    with pytest.raises(DiagnoseError, match=r"no record\.json"):
        loop.read([tmp_path / "elsewhere"])

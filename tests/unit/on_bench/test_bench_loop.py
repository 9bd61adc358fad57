"""What closes the loop, but for flights and trainings: recording, extending, counting what was won
back.
"""

import numpy as np
import pytest

from bench import ablations, loop
from visthrow import config
from visthrow.diagnose.throw import recorded_flight as recorded
from visthrow.logs.flightlog import Channel, FlightLog
from visthrow.task import Experiment
from visthrow.throws.loading import load_policy


def throws(error: float, failed: int = 0) -> dict:
    """A hundred throws of about this error, some of which did not land."""
    spread = 1.0 + 0.1 * np.cos(np.arange(100))
    return {
        "error": list(error * spread),
        "success": [i >= failed for i in range(100)],
        "duration": [1.0] * 100,
    }


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
    assert np.isnan(
        loop.recovered({"before": none, "after": throws(0.1), "oracle": throws(0.1)})["share"]
    )


ABLATIONS = {
    "no_aerodynamics": "aerodynamics",
    "no_motor_lag": "motor_lag",
    "rigid_cable": "rope_flexible",
    "simple_controller": "controller_kind",
}


@pytest.mark.parametrize(("base", "effect"), ABLATIONS.items())
def test_a_model_that_lacks_a_block_becomes_the_whole_one_by_its_effect(base, effect):
    """What is hidden from an ablated model is the paper's plant, to the last number."""
    whole, ablated = (
        config.load(Experiment, config.find("train", name)) for name in ("state", f"state_{base}")
    )
    assert ablated != whole
    found = loop.extended(ablated, {effect: 1.0})
    assert (found.vehicle, found.rope, found.task) == (whole.vehicle, whole.rope, whole.task)


def test_poses_are_recorded_with_the_noise_of_motion_capture_and_nothing_true():
    time = np.arange(0.0, 40.0, 0.02)
    level = np.tile([0.0, 0.0, 0.0, 1.0], (len(time), 1))
    place = np.zeros((len(time), 3))
    channels = {
        "pos_w": Channel(time, place, "m", "world"),
        "payload_pos_w": Channel(time, place, "m", "world"),
        "quat_wb": Channel(time, level, "1", "world"),
        "vel_w": Channel(time, place, "m/s", "world"),
        "command": Channel(time, np.tile([2.7, 0.0, 0.0, 0.0], (len(time), 1)), "N, rad/s", "body"),
        "release_command": Channel(time, np.zeros(len(time)), "1"),
    }
    meta = {
        "times": {"policy_start": 2.0, "landing": 38.0, "end": 40.0},
        "policy": "state",
        "plant": "reference",
    }
    seen = loop.recorded(FlightLog(channels, meta), np.random.default_rng(0))
    assert set(seen.channels) == {"pos_w", "payload_pos_w", "quat_wb", "command", "release_command"}
    assert seen["pos_w"].time[0] >= 2.0 - loop.BEFORE
    assert seen["payload_pos_w"].time[-1] <= 38.0 < seen["pos_w"].time[-1]
    for name in ("pos_w", "payload_pos_w"):
        assert seen[name].values.std() == pytest.approx(loop.NOISE[name], rel=0.05)
    assert 2.0 * seen["quat_wb"].values[:, :3].std() == pytest.approx(
        loop.NOISE["quat_wb"], rel=0.05
    )


def test_throws_side_by_side_come_down_at_their_goals():
    """Each of a batch flies to its own goal, asks for its own release, and is logged as
    one flight.
    """
    goals = np.array([[1.4, 0.0, 0.0], [0.0, -1.2, 0.0]])
    logs = ablations.throws(load_policy("state"), "hybrid", goals, 0)
    for goal, log in zip(goals, logs):
        begin, landing = log.meta["times"]["policy_start"], log["landing"]
        assert np.linalg.norm(landing.values[0, :2] - goal[:2]) < 0.1
        asked = log["release_command"].values > 0.5
        assert begin < log["release_command"].time[asked][0] < landing.time[0]
        apart = np.linalg.norm(log["pos_w"].values - log["payload_pos_w"].values, axis=1)
        assert np.ptp(apart[log["pos_w"].time < begin]) < 0.01  # hangs still
        seen = loop.recorded(log, np.random.default_rng(0))
        assert "landing" not in seen
        assert recorded.record_of(seen, 0).latch == pytest.approx(
            log["release_command"].time[asked][0]
        )
    assert np.linalg.norm(logs[0]["landing"].values - logs[1]["landing"].values) > 1.0

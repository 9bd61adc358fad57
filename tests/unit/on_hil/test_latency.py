"""Percentiles a stage, the report and its picture."""

import cv2
import numpy as np
from numpy.random import default_rng
from pytest import approx, mark

from hil.control.recording.latency import STAGES, Stage, Stages, draw, table
from hil.control.tick.runner import Runner
from hil.poses.pose import PAYLOAD, VEHICLE, Pose
from tests.hil_flight import Spy, params, simple_policy

BIN = 0.011
"""Relative width of a bin and a little: what a percentile may be off."""


def test_percentiles_of_many_times():
    rng = default_rng(0)
    times = np.exp(rng.normal(np.log(3e-4), 0.8, 20_000))
    stage = Stage()
    for t in times:
        stage.add(float(t))
    for share in (0.5, 0.95, 0.99):
        assert stage.percentile(share) == approx(np.quantile(times, share), rel=BIN)
    summary = stage.summary()
    assert summary["max_ms"] == approx(1e3 * times.max(), rel=1e-12)
    assert summary["count"] == 20_000


def test_nothing_zero_and_very_long_times():
    assert Stage().summary() == {}
    stage = Stage()
    for t in (0.0, -1.0, 1e9):
        stage.add(t)
    assert stage.counts.sum() == 3
    assert stage.summary()["max_ms"] == 1e12


def test_report_and_picture(tmp_path):
    stages, rng, names = Stages(), default_rng(0), ["poll", "observation", "total"]
    for _ in range(500):
        stages.add(dict(zip(names, rng.gamma(4.0, 1e-4, 3).tolist())))
    lines = table(stages.summary())
    assert [line.split()[0] for line in lines[1:]] == names
    assert STAGES["observation"] in lines[2]
    clock = "transport, arrival, late, ack: by the run's clock, at 0.2 of real time"
    assert clock in table(stages.summary(), 0.2)[0]
    assert "clock" not in lines[0]
    draw(tmp_path / "latency.png", stages, "a run")
    assert np.ptp(cv2.imread(str(tmp_path / "latency.png"))) > 200
    draw(tmp_path / "empty.png", Stages(), "nothing flown")


def watch(*overrides: str, late: float) -> Runner:
    """A runner that has taken poses of a vehicle at 1 m/s along x, ``late`` after they held."""
    given = ("delay.compensate=true", "delay.source=0.0", *overrides)
    runner = Runner(params(*given), simple_policy(), Spy())
    for i in range(40):
        time = 0.01 * i
        level = (0.0, 0.0, 0.0, 1.0)
        runner.estimator.take_poses(
            [
                Pose(time, time + late, VEHICLE, (time, 0.0, 1.333), level, measured=time),
                Pose(time, time + late, PAYLOAD, (time, 0.0, 0.95), level, measured=time),
            ]
        )
    return runner


@mark.parametrize("command", [0.0, 0.02])
def test_a_state_stands_for_when_the_command_acts_less_the_age_of_training(command):
    """By the time from measurement to arrival of each pose, and the delay of the command."""
    late = 0.03
    runner = watch(f"delay.command={command}", late=late)
    now = 0.39 + late
    estimate = runner.estimator.estimate(now)
    trained = runner.trained_age
    assert estimate.vehicle.pos[0] == approx(now - trained + command, abs=1e-6)
    assert estimate.shown_age == approx(min(late, trained))


def test_a_detector_receives_the_payloads_distance_while_it_hangs():
    runner = watch(late=0.0)
    hint = runner.estimator.hint(0.39)
    assert hint.ball_distance == approx((0.5 * runner.hang, 1.4 * runner.hang))
    runner.latch.at = 0.39
    assert runner.estimator.hint(0.39).ball_distance is None

"""Replays of runs are exact, even of runs with faults."""

import math
from dataclasses import replace

import numpy as np
from numpy.random import default_rng
from pytest import mark

from hil.control.recording.playback import replay
from hil.control.recording.record import lines
from hil.poses.pose import Pose
from tests.hil_flight import TICK
from tests.hil_runs import record_run, save_policy
from tests.loopback.wire import QUICK


def patchy(rng: np.random.Generator):
    """Poses that are lost, doubled, late, spoiled; for a while none at all."""
    late: list[Pose] = []

    def spoil(time: float, poses: list[Pose]) -> list[Pose]:
        out = late + [p for p in poses if rng.random() > 0.05]
        late.clear()
        if rng.random() < 0.1 and out:
            late.append(replace(out.pop(), arrival=time + TICK))
        if rng.random() < 0.02 and out:
            out.append(replace(out[-1], pos=(math.nan, 0.0, 0.0)))
        if rng.random() < 0.02 and out:
            out.append(out[-1])
        return [] if 0.5 < time % 1.5 < 0.56 else out

    return spoil


RUNS = {
    "drop-outs": {"poses": patchy(default_rng(1)), "seconds": 3.0},
    "mocap gone": {"poses": lambda t, poses: poses if t < 0.9 else [], "seconds": 2.0},
    "late ticks": {"late": lambda t: 0.03 * (math.sin(40.0 * t) > 0.9), "seconds": 2.0},
    "disk full": {"recording": lambda t: t < 0.9, "seconds": 2.0},
}


@mark.parametrize("name", RUNS)
def test_any_run_replays_bit_for_bit(name, tmp_path):
    folder = tmp_path / "run"
    record_run(folder, "policy=vision", "observe=true", *QUICK, **RUNS[name])
    replayed = replay(folder)
    assert replayed["differences"] == []
    assert replayed["actions"] > 30


def test_a_run_whose_policy_failed_replays(tmp_path):
    """A policy that puts out nothing but 1: the fence ends it; the run is killed, and its folder
    read as it is.
    """
    record_run(
        tmp_path / "a",
        save_policy(tmp_path, (1.0, 1.0, -1.0, 1.0, -1.0)),
        *QUICK,
        seconds=3.0,
        close=False,
    )
    replayed = replay(tmp_path / "a")
    assert replayed["differences"] == []
    assert "fence" in list(lines(tmp_path / "a" / "ticks.jsonl"))[-1]["reason"]

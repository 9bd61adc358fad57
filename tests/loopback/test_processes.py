"""Runner and fake as two processes in real time: SIGTERM, and whole throws with each kind.

`bench.faults` injects every other fault in the same way; `test_autopilot_faults`, `test_endings`
and `test_mocap_faults` do so in lock step.
"""

import os
import signal
from pathlib import Path

import numpy as np
from pytest import mark

from bench.processes import Pair
from hil.control.recording.playback import replay
from tests.commands import set_words
from tests.hil_flight import NEVER
from tests.loopback.wire import QUICK

FAKE = ("--seconds", "60", "--after", "1.5")
"""Time for which a fake flies at most, and for which it waits for its run [s]."""

ACTIONS = 10
"""Ticks of a throw before it is disturbed."""

ONE_THROW, MOST_LATE = 0.25, 100
"""Landing error of a single throw [m], and periods of the fake that may be late: late commands, all
of them.
"""

FEW_MISSED = 3
"""Ticks of a run that may be missed where its throw is to land in its place."""

SPEEDS = (1.0, 0.5, 0.25)
"""Of both processes' clocks: the next one is flown where the machine was too busy for the one
before; the last one counts as it is.
"""


def end_in_throw(folder: Path):
    """Return what tells a run to end once its policy has acted for some ticks."""
    ticks, signalled = folder / "ticks.jsonl", []

    def watch(process: int) -> None:
        flown = ticks.is_file() and ticks.read_text().count('"action": [') >= ACTIONS
        if flown and not signalled:
            os.kill(process, signal.SIGTERM)
            signalled.append(process)

    return watch


def test_sigterm_in_mid_throw(tmp_path):
    """The signal of systemd, `timeout` and a shutdown. Signed."""
    NEVER.save(tmp_path / "never.npz")
    key = tmp_path / "key"
    key.write_text("a phrase that both know\n")
    key.chmod(0o600)
    sign = ("--sign", str(key))
    settings = (*QUICK, "states.throw=30.0", "states.abort=1.0", f"policy={tmp_path}/never.npz")
    plant = ("--plant", "tests.level:make")
    pair = Pair((*sign, *set_words(settings)), (*sign, *plant, *FAKE))
    summary, report = pair.fly(tmp_path / "run", end_in_throw(tmp_path / "run"))
    assert summary["aborted"]
    assert summary["reason"] == "the process received SIGTERM"
    assert (report["breaches"], report["releases"]) == ([], 0)
    assert "mode 9" in [text for _, text in report["events"]]


@mark.slow
@mark.parametrize("policy", ["state", "vision"])
@mark.parametrize("kind", ["ardupilot", "px4", "betaflight"])
def test_a_throw_with_each_kind(tmp_path, kind, policy):
    """In real time where the machine keeps up, with the simulator's vehicle and the shipped
    policies.
    """
    for speed in SPEEDS:
        folder = tmp_path / f"run-{speed:g}"
        run = set_words((f"policy={policy}", "states.abort=0.5"))
        clock = ("--speed", str(speed))
        pair = Pair((*run, *clock), ("--policy", policy, *FAKE, *clock), kind=kind)
        summary, report = pair.fly(folder)
        if report["late_periods"] <= MOST_LATE and summary["missed"] <= FEW_MISSED:
            break
    assert report["landing_w"] is not None, summary["reason"]
    assert (report["breaches"], report["releases"]) == ([], 1)
    assert (summary["latches"], summary["errors"]) == (1, [])
    autopilot = summary["autopilot"]
    assert (autopilot["backend"], autopilot["parameters"]["problems"]) == (kind, [])
    assert autopilot["release"]["state"] == "accepted"
    assert replay(folder)["differences"] == []
    # A fake that is late has a clock that stands still and then hurries.
    assert autopilot["clocks"]["foreign_stamps"] == 0 or kind == "betaflight"
    assert np.hypot(report["landing_w"][0] - 2.0, report["landing_w"][1]) < ONE_THROW

"""Folders of runs for tests: the vehicle of `tests.hil_flight`, recorded tick by tick as the
command records them.
"""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

from hil.control.recording.record import TICKS, RunRecorder, lines
from hil.control.tick.runner import Runner, TickRecord
from tests.hil_flight import HOVER, Spy, fly, params, simple_policy
from visthrow.onboard.policy import Policy, find_policy

AT_ONCE = (HOVER, 0.0, 0.0, 0.0, 1.0)
"""Of a policy that hovers and releases at once: the payload falls straight down."""


def save_policy(folder: Path, action=AT_ONCE) -> str:
    """File of a policy with a constant action, as an override of a config."""
    path = folder / "always.npz"
    simple_policy(action, "vision").save(path)
    return f'policy="{path}"'


def copy_run(run: Path, folder: Path, change: Callable[[list[dict]], None]) -> Path:
    """Copy a run's folder and change its ticks."""
    shutil.copytree(run, folder, dirs_exist_ok=True)
    ticks = list(lines(run / TICKS))
    change(ticks)
    (folder / TICKS).write_text("".join(json.dumps(tick) + "\n" for tick in ticks))
    return folder


def record_run(
    folder: Path, *overrides: str, seconds: float = 8.0, close: bool = True, **spoiled
) -> list[TickRecord]:
    """Fly and record; see `tests.hil_flight.fly` for what can be spoiled.

    Without ``close`` the run ends as if killed.
    """
    settings = params(*overrides)
    runner = Runner(settings, Policy.load(find_policy(settings.policy)), Spy())
    recorder, decisions = RunRecorder(folder, settings), []
    tick = runner.tick

    def keep(time, poses, status, words, recording=True):
        decision = tick(time, poses, status, words, recording)
        times = {"late": 1e-4, "poll": 2e-4, **runner.spent}
        recorder.tick(len(decisions), poses, status, words, recording, decision, times)
        decisions.append(decision)
        return decision

    runner.tick = keep
    fly(runner, seconds, **spoiled)
    if close:
        recorder.close({**runner.summary(), "ticks": len(decisions)})
    else:
        recorder.close({})
        (folder / "summary.json").unlink()
    return decisions

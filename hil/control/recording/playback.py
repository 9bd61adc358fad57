"""Playback of a recorded run, tick by tick, with the runner's decisions and estimates.

The replay, the flight logs and the viewer all use it, so that they show exactly what was flown."""

import argparse
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.control.recording.record import SUMMARY, load_run, open_folder, pack
from hil.control.state_machine import OperatorInput, State, TickRecord
from hil.control.tick.runner import Runner
from hil.links.backends.base import DryRun, Status
from hil.params import HilParams
from hil.poses.body_track import BodyState
from hil.poses.detection import Detection
from hil.poses.pose import VEHICLE, Pose, Vector
from visthrow.onboard.calibration import Calibration
from visthrow.onboard.policy import Policy


@dataclass
class Sample:
    """An accepted pose in our frames, with the velocities estimated from it."""

    body: str
    pose: Pose  # stamp on the source's clock, with its steps removed
    vel_w: Vector  # [m/s]
    rate_b: Vector  # [rad/s]
    # of the measurement on the runner's clock [s]; None until it is computed from the whole run
    time: float | None = None


@dataclass
class Tick:
    """One tick of a run: its recorded line, its decision, and the poses accepted in it."""

    line: dict[str, Any]
    decision: TickRecord
    samples: list[Sample]
    ages: dict[str, float]  # of each body's last pose [s]
    attached: bool  # whether the payload hangs on the vehicle: until the release's lag is over
    goal_w: Vector | None


class Playback:
    """Feeds recorded ticks to a ``runner`` of their config and policy."""

    def __init__(self, params: HilParams, policy: Policy):
        """Start before the first tick; see `hil.control.recording.record.load_run` for both."""
        self.params = params
        self.runner = Runner(params, policy, DryRun())
        self.runner.estimator.watcher = lambda body, track: self._samples.append(
            Sample(body, *track.sample())
        )
        self._samples: list[Sample] = []

    def feed(self, line: dict[str, Any]) -> Tick:
        """Run one recorded tick, as of `hil.control.recording.record.with_poses`."""
        self._samples = []
        runner = self.runner
        time = line["time"]
        detection = line.get("detection", line.get("seen"))  # older runs call it "seen"
        if detection is not None:
            runner.estimator.take_detections([Detection.of(detection)])
        calibration = line.get("calibration")
        if isinstance(calibration, dict):
            calibration = Calibration.of(calibration)
        runner.commander.calibration = calibration
        runner.agreed = line.get("agreed")
        decision = runner.tick(
            time,
            line["poses"],
            Status(*line["status"]),
            OperatorInput(*line["words"]),
            line["recording"],
        )
        ages = {name: track.gate.age(time) for name, track in runner.tracks.items()}
        return Tick(
            line,
            decision,
            self._samples,
            ages,
            not runner.latch.has_separated(time),
            runner.estimator.goal_w,
        )


# values that a replay must reproduce bit for bit
COMPARED = ("state", "command", "action", "observation", "keypoints", "valid", "release")


def replay(folder: str | Path) -> dict[str, Any]:
    """Run the recorded poses, statuses and operator commands through the runner again. Raises
    `RunError`: not the folder of a run.

    Returns the number of ticks and actions compared, the differences (tick, name, recorded value,
    value now), and what is missing of the recording, or None; ``story``: where it went wrong, in a
    sentence."""
    params, policy, ticks = load_run(folder)
    playback = Playback(params, policy)
    flown: list[tuple[TickRecord, BodyState | None]] = []
    differences: list[tuple[int, str, Any, Any]] = []
    for line in ticks:
        decision = playback.feed(line).decision
        flown.append((decision, playback.runner.tracks[VEHICLE].state(decision.time)))
        for name in COMPARED:
            was = line[name]
            value = getattr(decision, name)
            value = list(value) if isinstance(value, tuple) else value
            if was != value:
                differences.append((line["n"], name, was, value))
    cut = _describe_missing(folder, len(ticks))
    return {
        "ticks": len(ticks),
        "actions": sum(decision.action is not None for decision, _ in flown),
        "differences": differences,
        "cut": cut,
        "story": sentence(flown, cut),
    }


def _describe_missing(folder: str | Path, ticks: int) -> str | None:
    """Return a text on what is missing in a recording; None if it is complete."""
    try:
        flown = json.loads((Path(folder) / SUMMARY).read_text(encoding="utf-8"))["ticks"]
    except OSError:
        return (
            "no summary: the run was killed, or its disk was full; how many ticks it flew on is not"
            " known"
        )
    except (ValueError, KeyError, TypeError) as error:
        return f"{SUMMARY} does not say how many ticks there were: {error!r}"
    return None if ticks == flown else f"{flown - ticks} of {flown} ticks are missing"


def sentence(flown: list[tuple[TickRecord, BodyState | None]], cut: str | None) -> str:
    """Return a sentence on where a run went wrong, from its decisions, the vehicle's state at
    each, and what is missing in the recording.
    """
    if not flown:
        return "Whether it went wrong is not known: no tick is recorded."
    states = [decision.state for decision, _ in flown]
    aborted = State.ABORT in states
    turn = states.index(State.ABORT) if aborted else len(states) - 1
    decision, vehicle = flown[turn]
    if not aborted and not cut:
        return f"It did not go wrong: it ended in {decision.state} ({decision.reason})."
    why = decision.reason if aborted else "the recording ends"
    before = states[max(turn - aborted, 0)]
    begin = turn
    while begin and states[begin - 1] == before:
        begin -= 1
    where = "had not been seen"
    if vehicle is not None:
        place = ", ".join(f"{x:.2f}" for x in vehicle.pos)
        speed = math.hypot(*vehicle.vel)
        where = f"was at ({place}) m with {speed:.1f} m/s, its pose {1e3 * vehicle.age:.0f} ms old"
    return (
        f"It went wrong {decision.time - flown[begin][0].time:.2f} s into '{before}': {why}; the"
        f" vehicle {where}."
    )


def compare_run(args: argparse.Namespace) -> int:
    """Replay a recorded run and compare (``visthrow hil replay``); return 1 if anything differs
    or the recording is incomplete, else 0.
    """
    with open_folder(args.folder) as folder:
        comparison = replay(folder)
    differences = comparison["differences"]
    for n, name, was, value in differences[:10]:
        print(f"tick {n}: {name} was {was}, is {value}")
    same = f"{len(differences)} DIFFERENCES" if differences else "all bit for bit the same"
    print(f"{comparison['ticks']} ticks, {comparison['actions']} actions of the policy: {same}")
    if comparison["cut"]:
        print(f"CUT: {comparison['cut']}")
        if Path(args.folder).is_dir():
            print(f"{pack(args.folder)}  what there is of the run, in one file")
    print(comparison["story"])
    return 1 if differences or comparison["cut"] else 0

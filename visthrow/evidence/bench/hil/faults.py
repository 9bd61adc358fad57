"""What the runner does when something fails, and after how long: each fault over UDP between two processes, in real time."""

import argparse
import os
import resource
import signal
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import torch

from visthrow.common.errors import VisthrowError, suggest
from visthrow.evidence.bench.hil.figures import json_lines
from visthrow.evidence.bench.hil.processes import ENDED, Pair, own_cores
from visthrow.evidence.bench.hil.soak import STILL, never_releasing
from visthrow.evidence.bench.hil.throws import side_by_side
from visthrow.evidence.bench.records import Report, Table
from visthrow.onboard.actions import hover_action

MOCAP, AUTOPILOT, OWN = "Motion capture", "The autopilot", "The runner itself"

START = 2.5
"""When a fault begins [s]."""

LENGTHS = {MOCAP: 1.2, AUTOPILOT: 4.0, OWN: 2.5}
"""How long it is watched [s]: a heartbeat may be missing for three."""

LATENCY = 0.01
"""Of the fake's motion capture, from a measurement to its arrival [s]."""

BEFORE = ("idle", "check", "ready", "armed")
"""States of a run before its first throw."""

HUGE = 3e38
"""Nearly the largest of float32."""

FULL = 2_000
"""Bytes that a file may still grow by where the disk is full: a few ticks."""

QUICK = {"states.check_hold": 0.2, "states.armed_least": 0.1, "states.quiet": 0.1, "states.abort": 0.5, "states.throw": 60.0}
ODOMETRY = (
    'source.senders=[{ body = "vehicle", message = "ODOMETRY", system = 1, component = 1 }, '
    '{ body = "payload", message = "ODOMETRY", system = 1, component = 25 }]'
)
"""The message that carries a reset counter."""


Act = Callable[[Path, int, float], None]
"""Does something to a run, given its folder, its process and the speed of its clock."""


@dataclass(frozen=True)
class Case:
    """One fault, and how it is made to happen.

    Attributes:
        text: what happens. group: of the table. policy: of `POLICIES`.
        run: settings of the run. fake: arguments of the fake.
        act: done to the run's process in mid throw. since: what times count from: `START` on the
        vehicle's clock ("fault"), the deed ("act"), or the run's latch or first tick in a state.
        refused: whether the run does not even start.
    """

    text: str
    group: str
    policy: str = "never"
    run: tuple[str, ...] = ()
    fake: tuple[str, ...] = ()
    act: Act | None = None
    since: str = "fault"
    refused: bool = False


def _pause(seconds: float) -> Act:
    def act(folder: Path, pid: int, speed: float) -> None:
        os.kill(pid, signal.SIGSTOP)
        time.sleep(seconds / speed)
        os.kill(pid, signal.SIGCONT)

    return act


def _signal(number: int) -> Act:
    return lambda folder, pid, speed: os.kill(pid, number)


def _fill_disk(folder: Path, pid: int, speed: float) -> None:
    room = max(path.stat().st_size for path in folder.iterdir()) + FULL
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (room, room))


def _option(*settings: str) -> tuple[str, ...]:
    return tuple(word for setting in settings for word in ("--option", setting))


def _mocap(name: str, text: str) -> Case:
    odometry = name == "reset"
    more = _option("pose_message=ODOMETRY") if odometry else ()
    fake = (*_option(f"mocap_fault={name}", f"fault_time={START}"), *more)
    return Case(text, MOCAP, run=(ODOMETRY,) if odometry else (), fake=fake)


HERE = ("goal_w=[0.0, 0.0, 0.0]",)
"""A payload that is let go in the hover falls on the target."""


def _answer(answer: str, text: str) -> Case:
    return Case(text, AUTOPILOT, "at once", HERE, ("--answer", answer), since="latch")


CASES = {
    "silent": Case("the autopilot falls silent", AUTOPILOT, fake=_option(f"silent_after={START}")),
    "taken": Case("the pilot takes the vehicle into another mode", AUTOPILOT, fake=_option(f"taken_after={START}")),
    "not-armed": Case("it is not armed, nor is the runner to arm it", AUTOPILOT, run=("states.idle=1.5",),
                      fake=_option("armed=false"), since="idle"),
    "no-arming": Case("it refuses to arm", AUTOPILOT, run=("ardupilot.arm=true",),
                      fake=_option("armed=false", "arming=false"), since="ready"),
    "stuck": _answer("stuck", "the release is acknowledged, and nothing moves"),
    "in-progress": _answer("in-progress", "the release stays IN_PROGRESS for ever"),
    "no-answer": _answer("silent", "the release is not answered"),
    "denied": _answer("denied", "the release is denied"),
    "slow-mechanism": Case("the mechanism is slower than the one trained with, 0.15 s", AUTOPILOT,
                           run=("ardupilot.mechanism_lag=0.15",), refused=True),
    "no-numbers": Case("the policy puts out no numbers", OWN, "no numbers", since="throw"),
    "limits": Case("the policy puts out all that it may, thrust and rates", OWN, "limits", since="throw"),
    "late": Case("a tick is 0.15 s late", OWN, act=_pause(0.15), since="act"),
    "very-late": Case("a tick is 0.8 s late", OWN, act=_pause(0.8), since="act"),
    "disk-full": Case("the disk is full", OWN, act=_fill_disk, since="act"),
    "ctrl-c": Case("Ctrl-C", OWN, act=_signal(signal.SIGINT), since="act"),
    "killed": Case("the runner is killed (SIGKILL)", OWN, act=_signal(signal.SIGKILL), since="act"),
}  # fmt: skip


def known_cases() -> dict[str, Case]:
    """All faults by name."""
    mocap = import_module("hil.fakes.mocap_faults").FAULTS  # the onboard side is not imported by name: it must not need this one
    return {**{name: _mocap(name, text) for name, (text, _) in mocap.items()}, **CASES}


def policies(folder: Path) -> dict[str, Path]:
    """Write the policies of the cases, of the shipped state policy's contract; files by name."""
    from visthrow.onboard.policy import Policy, find_policy

    contract = Policy.load(find_policy("state")).contract
    vehicle, hanging = contract["vehicle"]["body"]["mass"], contract["rope"]["payload_mass"] + contract["rope"]["rope_mass"]
    hover = hover_action(9.81 * (vehicle + hanging), contract["action"]["max_thrust"])[0]
    same = {"at once": (hover, 0.0, 0.0, 0.0, 1.0), "limits": (1.0, 1.0, -1.0, 1.0, -1.0)}
    made = {"never": never_releasing("state", folder / "never.npz")}
    wide = contract["observation"]["dimension"]
    for name, action in same.items():
        made[name] = folder / f"{name.replace(' ', '-')}.npz"
        Policy((torch.zeros(len(action), wide),), (torch.tensor(action),), "relu", contract).save(made[name])
    # Of finite weights, as the loader asks for, and without a finite output: infinity less infinity.
    weights = torch.zeros(2, wide), torch.tensor([[10.0, -10.0]] * contract["action"]["dimension"])
    biases = torch.full((2,), HUGE), torch.zeros(contract["action"]["dimension"])
    made["no numbers"] = folder / "no-numbers.npz"
    Policy(weights, biases, "relu", contract).save(made["no numbers"])
    return made


class Deed:
    """Does something to the run's process, `START` after its first pose; the times are of the run's clock [s]."""

    def __init__(self, act: Act, folder: Path, speed: float) -> None:
        """Wait to be called; see `Pair.fly`."""
        self._act, self._folder, self._speed, self.at = act, folder, speed, float("nan")
        self._thread: threading.Thread | None = None

    def __call__(self, pid: int) -> None:
        """The run is there."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._wait, args=(pid,), daemon=True)
            self._thread.start()

    def _wait(self, pid: int) -> None:
        poses, end = self._folder / "poses.jsonl", time.monotonic() + ENDED
        while not (poses.is_file() and poses.stat().st_size) and time.monotonic() < end:
            time.sleep(0.01)
        time.sleep(START / self._speed)
        self.at = time.monotonic() * self._speed
        self._act(self._folder, pid, self._speed)


def faults(args: argparse.Namespace) -> Report:
    """Inject each fault in turn.

    Raises:
        VisthrowError: an unknown name, no process at all, or a speed out of range.
    """
    if not (args.jobs >= 1 and 0.05 <= args.speed <= 1.0):
        raise VisthrowError(f"--jobs {args.jobs}, --speed {args.speed}; expected 1 or more, and 0.05 to 1")
    cases = known_cases()
    for name in args.faults:
        if name not in cases:
            raise VisthrowError(f"fault '{name}'; {suggest(name, cases)}")
    rows: dict[str, list[tuple[str, ...]]] = {}
    figures = {}
    with tempfile.TemporaryDirectory() as folder:
        made = policies(Path(folder))

        def inject(name: str, cores: tuple[int | None, int | None]) -> tuple[str, dict[str, Any]]:
            return name, _one(cases[name], made[cases[name].policy], Path(folder) / name, cores, args.speed)

        names = [name for name in cases if name in (args.faults or cases)]
        done = dict(_announced(side_by_side(inject, names, own_cores(args.jobs))))
        for name in names:
            case, found = cases[name], done[name]
            figures[name] = found
            row = (name, case.text, _told(found["states"]), _told(found["events"]) or "-")
            counts = tuple(str(found[key]) for key in ("missed", "commands", "releases")) + (str(len(found["breaches"])),)
            rows.setdefault(case.group, []).append((*row, *counts))
    notes = (
        f"each fault begins in mid throw, {START:g} s after the first pose, of a policy that never releases, but where the "
        "release itself is what fails; times count from the first pose that the fault spoiled, from when it happened, from "
        "the latch, or from the first tick of the throw",
        "a breach is a command that is not finite or beyond the limits of training, or a release that was not armed, was outside "
        "of the fence or came twice, as seen by the vehicle",
    )
    if args.speed < 1.0:
        notes += (f"both clocks ran at {args.speed:g} of real time, and all times are theirs",)
    header = ("fault", "what happens", "what the runner did", "what the vehicle did", "missed ticks", "commands", "releases",
              "breaches")  # fmt: skip
    tables = tuple(Table(f"{group}, over UDP", header, tuple(lines)) for group, lines in rows.items())
    return Report("hil", "What the runner does when something fails", tables, notes, figures)


def _announced(found: Iterator[tuple[str, dict[str, Any]]]) -> Iterator[tuple[str, dict[str, Any]]]:
    for name, values in found:
        print(f"{name}: {_told(values['states'])}", file=sys.stderr, flush=True)
        yield name, values


def _told(steps: list[dict[str, Any]]) -> str:
    return "; ".join(f"{s['what']} after {s['after']:.2f} s" for s in steps) or "-"


def _one(
    case: Case, policy: Path, folder: Path, cores: tuple[int | None, int | None], speed: float
) -> dict[str, Any]:  # fmt: skip
    length, clock = LENGTHS[case.group], ("--speed", str(speed))
    run = ["--config", "fake", *clock, "--set", f'policy="{policy}"']
    for setting in (*(f"{key}={value}" for key, value in QUICK.items()), *case.run):
        run += ["--set", setting]
    fake = (*STILL, *clock, "--seconds", str(START + length), *case.fake)
    deed = None if case.act is None else Deed(case.act, folder, speed)
    try:
        summary, report = Pair(tuple(run), fake, *cores).fly(folder, deed, alone=True)
    except VisthrowError as error:
        if not case.refused:
            raise
        said = str(error).strip().splitlines()[0].removeprefix("the run did not start: visthrow: error: ")
        return {"began_in": None, "states": [{"what": f"refused: {said}", "after": 0.0}], "events": [], "missed": 0, "commands": 0,
                "releases": 0, "breaches": []}  # fmt: skip
    ticks = json_lines(folder / "ticks.jsonl")
    offset = _offset(folder)
    begin = _begin(case, summary, ticks, offset, deed)
    last = START + length - 0.1 + offset  # then the fake goes, which is none of these
    began_in = before = next((tick["state"] for tick in reversed(ticks) if tick["time"] < begin), None)
    states = []
    for tick in ticks:
        if begin <= tick["time"] < last and tick["state"] != before:
            before = tick["state"]
            states.append({"what": f"{before} ({tick['reason']})", "after": tick["time"] - begin})
    events = [{"what": text, "after": at + offset - LATENCY - begin} for at, text in report["events"]]
    return {
        "began_in": began_in, "states": states, "events": [event for event in events if event["after"] > -0.02],
        "missed": summary.get("missed", "?"), "commands": report["commands"], "releases": report["releases"],
        "breaches": report["breaches"],
    }  # fmt: skip


def _offset(folder: Path) -> float:
    """From the vehicle's clock at a measurement to the run's at the arrival of its pose [s]."""
    rows = [row for row in json_lines(folder / "poses.jsonl") if row[3] == "vehicle"]
    return statistics.median(row[2] - row[1] for row in rows if row[1] < START)


def _begin(case: Case, summary: dict, ticks: list[dict], offset: float, deed: Deed | None) -> float:
    """When the times of a case begin, on the run's clock [s]."""
    if case.since == "act":
        return deed.at
    if case.since == "fault":
        return START + offset - (0.0 if case.group == MOCAP else LATENCY)
    if case.since == "latch":
        return summary["latch_times"][0]
    if case.since == "throw":  # which may end in the tick that it begins in
        return next(tick["time"] for tick in ticks if tick["state"] not in BEFORE)
    return next(tick["time"] for tick in ticks if tick["state"] == case.since)

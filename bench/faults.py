"""The runner's reactions to faults, and their delays: each fault over UDP between two processes, in
real time.
"""

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
from pathlib import Path
from typing import Any

import torch

from bench.figures import json_lines
from bench.processes import CONFIGS, ENDED, Pair, assign_cores, side_by_side
from bench.report import Report, Table
from bench.soak import STILL, never_releasing
from tests.mocap_faults import FAULTS
from visthrow.common.errors import VisthrowError, suggest
from visthrow.onboard.actions import hover_action
from visthrow.onboard.hover import GRAVITY

MOCAP = "Motion capture"
AUTOPILOT = "The autopilot"
RUNNER = "The runner itself"

START = 2.5
"""When a fault begins [s]."""

STARTS = 6.0
"""Time for which a fake that starts first waits for its run [s]."""

ENOUGH = 6.0
"""Time of a run that ends in its throw [s]: the fake's start, and the states before a throw."""

LENGTHS = {MOCAP: 1.2, AUTOPILOT: 4.0, RUNNER: 2.5}
"""Time of observation after a fault [s]: a heartbeat may be missing for three."""

LATENCY = 0.01
"""Of the fake's motion capture, from a measurement to its arrival [s]."""

BEFORE = ("idle", "check", "ready", "armed")
"""States of a run before its first throw."""

HUGE = 3e38
"""Nearly the largest of float32."""

FULL = 2_000
"""Bytes that a file may still grow by where the disk is full: a few ticks."""

QUICK = {
    "states.check_hold": 0.2,
    "states.armed_least": 0.1,
    "states.quiet": 0.1,
    "states.abort": 0.5,
    "states.throw": 60.0,
}
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
        run: settings of the run. fake: arguments of the fake. spoiled: name and time of a fault of
            its motion capture.
        act: done to the run's process in mid-throw. since: what times count from: `START` on the
        vehicle's clock ("fault"), the deed ("act"), or the run's latch or first tick in a state.
        refused: whether the run does not even start. ends: whether it is a way for the run to end,
            and so flown with any kind.
    """

    text: str
    group: str
    policy: str = "never"
    run: tuple[str, ...] = ()
    fake: tuple[str, ...] = ()
    spoiled: tuple[str, ...] = ()
    act: Act | None = None
    since: str = "fault"
    refused: bool = False
    ends: bool = False


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
    return Case(
        text, MOCAP, run=(ODOMETRY,) if odometry else (), fake=more, spoiled=(name, str(START))
    )


HERE = ("goal_w=[0.0, 0.0, 0.0]",)
"""A payload that is let go in the hover falls on the target."""


def _answer(answer: str, text: str) -> Case:
    return Case(text, AUTOPILOT, "at once", HERE, ("--answer", answer), since="latch")


ENDS = {
    "ctrl-c": ("Ctrl-C", signal.SIGINT),
    "sigterm": ("SIGTERM (systemd, timeout, shutdown)", signal.SIGTERM),
    "sighup": ("SIGHUP (ssh is gone, the terminal closed)", signal.SIGHUP),
    "killed": ("the runner is killed (SIGKILL)", signal.SIGKILL),
}
"""Ways to end a run from outside, and their signals."""

HOVERS = ("states.armed_least=9.0",)
"""Armed it hovers, until its time for that is over."""


def _make_ending(text: str, number: int, run: tuple[str, ...] = ()) -> Case:
    return Case(text, RUNNER, run=run, act=_signal(number), since="act", ends=True)


def _twice(folder: Path, pid: int, speed: float) -> None:
    os.kill(pid, signal.SIGINT)
    time.sleep(0.2 / speed)
    os.kill(pid, signal.SIGINT)


CASES = {
    "silent": Case("the autopilot falls silent", AUTOPILOT, fake=_option(f"silent_after={START}")),
    "taken": Case(
        "the pilot takes the vehicle into another mode",
        AUTOPILOT,
        fake=_option(f"taken_after={START}"),
    ),
    "not-armed": Case(
        "it is not armed, nor is the runner to arm it",
        AUTOPILOT,
        run=("states.idle=1.5",),
        fake=_option("armed=false"),
        since="idle",
    ),
    "no-arming": Case(
        "it refuses to arm",
        AUTOPILOT,
        run=("ardupilot.arm=true",),
        fake=_option("armed=false", "arming=false"),
        since="ready",
    ),
    "stuck": _answer("stuck", "the release is acknowledged, and nothing moves"),
    "in-progress": _answer("in-progress", "the release stays IN_PROGRESS for ever"),
    "no-answer": _answer("silent", "the release is not answered"),
    "denied": _answer("denied", "the release is denied"),
    "slow-mechanism": Case(
        "the mechanism is slower than the one trained with, 0.15 s",
        AUTOPILOT,
        run=("ardupilot.mechanism_lag=0.15",),
        refused=True,
    ),
    "no-numbers": Case("the policy puts out no numbers", RUNNER, "no numbers", since="throw"),
    "limits": Case(
        "the policy puts out all that it may, thrust and rates", RUNNER, "limits", since="throw"
    ),
    "late": Case("a tick is 0.15 s late", RUNNER, act=_pause(0.15), since="act"),
    "very-late": Case("a tick is 0.8 s late", RUNNER, act=_pause(0.8), since="act"),
    "disk-full": Case("the disk is full", RUNNER, act=_fill_disk, since="act"),
    **{name: _make_ending(text, number) for name, (text, number) in ENDS.items()},
    **{
        f"{name}-in-hover": _make_ending(f"{text}, in hover", number, HOVERS)
        for name, (text, number) in ENDS.items()
    },
    "ctrl-c-twice": Case("Ctrl-C twice", RUNNER, act=_twice, since="act", ends=True),
    "time-over": Case("the time of --seconds is over", RUNNER, since="time", ends=True),
}


def list_cases() -> dict[str, Case]:
    """Return the faults by name."""
    return {**{name: _mocap(name, text) for name, (text, _) in FAULTS.items()}, **CASES}


def policies(folder: Path) -> dict[str, Path]:
    """Write the policies of the cases, of the shipped state policy's contract; files by name."""
    from visthrow.onboard.policy import Policy, find_policy

    shipped = Policy.load(find_policy("state"))
    contract = shipped.contract
    hover = hover_action(GRAVITY * shipped.total_mass, contract["action"]["max_thrust"])[0]
    same = {"at once": (hover, 0.0, 0.0, 0.0, 1.0), "limits": (1.0, 1.0, -1.0, 1.0, -1.0)}
    made = {"never": never_releasing("state", folder / "never.npz")}
    wide = contract["observation"]["dimension"]
    for name, action in same.items():
        made[name] = folder / f"{name.replace(' ', '-')}.npz"
        Policy((torch.zeros(len(action), wide),), (torch.tensor(action),), "relu", contract).save(
            made[name]
        )
    # Of finite weights, as the loader asks for, and without a finite output: infinity less
    # infinity.
    weights = torch.zeros(2, wide), torch.tensor([[10.0, -10.0]] * contract["action"]["dimension"])
    biases = torch.full((2,), HUGE), torch.zeros(contract["action"]["dimension"])
    made["no numbers"] = folder / "no-numbers.npz"
    Policy(weights, biases, "relu", contract).save(made["no numbers"])
    return made


class Deed:
    """Does something to the run's process, `START` after its first pose; the times are of the run's
    clock [s].
    """

    def __init__(self, act: Act, folder: Path, speed: float) -> None:
        """Wait to be called; see `Pair.fly`."""
        self._act = act
        self._folder = folder
        self._speed = speed
        self.at = float("nan")
        self._thread: threading.Thread | None = None

    def __call__(self, pid: int) -> None:
        """The run is ready."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._wait, args=(pid,), daemon=True)
            self._thread.start()

    def _wait(self, pid: int) -> None:
        ticks = self._folder / "ticks.jsonl"
        end = time.monotonic() + ENDED
        while not (ticks.is_file() and b'"poses": [[' in ticks.read_bytes()) and (
            time.monotonic() < end
        ):
            time.sleep(0.01)
        time.sleep(START / self._speed)
        self.at = time.monotonic() * self._speed
        self._act(self._folder, pid, self._speed)


def faults(args: argparse.Namespace) -> Report:
    """Inject each fault in turn.

    Raises:
        VisthrowError: an unknown name, no process at all, or a speed out of range.
    """
    if args.kind not in CONFIGS:
        raise VisthrowError(f"--kind {args.kind}; {suggest(args.kind, CONFIGS)}")
    if not (args.jobs >= 1 and 0.05 <= args.speed <= 1.0):
        raise VisthrowError(
            f"--jobs {args.jobs}, --speed {args.speed}; expected 1 or more, and 0.05 to 1"
        )
    cases = list_cases()
    for name in args.faults:
        if name not in cases:
            raise VisthrowError(f"fault '{name}'; {suggest(name, cases)}")
    rows: dict[str, list[tuple[str, ...]]] = {}
    figures = {}
    with tempfile.TemporaryDirectory() as folder:
        made = policies(Path(folder))

        def inject(name: str, cores: tuple[int | None, int | None]) -> tuple[str, dict[str, Any]]:
            return name, _one(
                cases[name],
                made[cases[name].policy],
                Path(folder) / name,
                cores,
                args.speed,
                args.kind,
            )

        flown = {name for name in cases if args.kind == "ardupilot" or cases[name].ends}
        odd = [name for name in args.faults if name not in flown]
        if odd:
            raise VisthrowError(
                f"--kind {args.kind} with {', '.join(odd)}; expected {', '.join(sorted(flown))}"
            )
        names = [name for name in cases if name in (args.faults or flown)]
        done = dict(_announce(side_by_side(inject, names, assign_cores(args.jobs))))
        for name in names:
            case = cases[name]
            result = done[name]
            figures[name] = result
            row = (
                name,
                case.text,
                _describe_steps(result["states"]),
                _describe_steps(result["events"]) or "-",
            )
            counts = tuple(str(result[key]) for key in ("missed", "commands", "releases")) + (
                str(len(result["breaches"])),
            )
            rows.setdefault(case.group, []).append((*row, *counts))
    notes = (
        (
            f"each fault begins in mid-throw, {START:g} s after the first pose, with a policy that"
            " never releases, unless the release itself fails; times count from the first pose"
            " that the fault affects, from the fault's action, from the latch, or from the first"
            " tick of the throw"
        ),
        (
            "a breach is a command that is not finite or beyond the limits of training, or a"
            " release that was not armed, was outside of the fence or was sent twice, as received"
            " by the vehicle"
        ),
    )
    if args.speed < 1.0:
        notes += (f"both clocks ran at {args.speed:g} of real time, and all times are theirs",)
    header = (
        "fault",
        "what happens",
        "what the runner did",
        "what the vehicle did",
        "missed ticks",
        "commands",
        "releases",
        "breaches",
    )
    tables = tuple(
        Table(f"{group}, over UDP", header, tuple(lines)) for group, lines in rows.items()
    )
    return Report("hil", "What the runner does when something fails", tables, notes, figures)


def _announce(
    results: Iterator[tuple[str, dict[str, Any]]],
) -> Iterator[tuple[str, dict[str, Any]]]:
    for name, values in results:
        print(f"{name}: {_describe_steps(values['states'])}", file=sys.stderr, flush=True)
        yield name, values


def _describe_steps(steps: list[dict[str, Any]]) -> str:
    return "; ".join(f"{s['what']} after {s['after']:.2f} s" for s in steps) or "-"


def _one(
    case: Case,
    policy: Path,
    folder: Path,
    cores: tuple[int | None, int | None],
    speed: float,
    kind: str,
) -> dict[str, Any]:
    length = LENGTHS[case.group]
    clock = ("--speed", str(speed))
    run = [*clock, "--set", f'policy="{policy}"']
    for setting in (*(f"{key}={value}" for key, value in QUICK.items()), *case.run):
        run += ["--set", setting]
    early = STARTS if kind == "betaflight" else 0.0  # its fake is there first
    fake = (*STILL, *clock, "--seconds", str(early + START + length), *case.fake)
    if case.since == "time":
        run += ["--seconds", str(ENOUGH)]
    deed = None if case.act is None else Deed(case.act, folder, speed)
    try:
        summary, report = Pair(tuple(run), fake, *cores, kind=kind, spoiled=case.spoiled).fly(
            folder, deed, alone=True
        )
    except VisthrowError as error:
        if not case.refused:
            raise
        reason = (
            str(error)
            .strip()
            .splitlines()[0]
            .removeprefix("the run did not start: visthrow: error: ")
        )
        return {
            "began_in": None,
            "states": [{"what": f"refused: {reason}", "after": 0.0}],
            "events": [],
            "missed": 0,
            "commands": 0,
            "releases": 0,
            "breaches": [],
        }
    ticks = json_lines(folder / "ticks.jsonl")
    offset = _offset(ticks)
    begin = _begin(case, summary, ticks, offset, deed)
    last = early + START + length - 0.1 + offset  # then the fake ends, which is not counted
    began_in = before = next(
        (tick["state"] for tick in reversed(ticks) if tick["time"] < begin), None
    )
    states = []
    for tick in ticks:
        if begin <= tick["time"] < last and tick["state"] != before:
            before = tick["state"]
            states.append({"what": f"{before} ({tick['reason']})", "after": tick["time"] - begin})
    events = [
        {"what": text, "after": at + offset - LATENCY - begin} for at, text in report["events"]
    ]
    return {
        "began_in": began_in,
        "states": states,
        "events": [event for event in events if event["after"] > -0.02],
        "missed": summary.get("missed", "?"),
        "summary": bool(summary),
        "commands": report["commands"],
        "releases": report["releases"],
        "breaches": report["breaches"],
    }


def _offset(ticks: list[dict]) -> float:
    """From the vehicle's clock at a measurement to the run's at the arrival of its pose [s]."""
    rows = [row for tick in ticks for row in tick["poses"] if row[2] == "vehicle"]
    return statistics.median(row[1] - row[0] for row in rows if row[0] < rows[0][0] + START)


def _begin(case: Case, summary: dict, ticks: list[dict], offset: float, deed: Deed | None) -> float:
    """When the times of a case begin, on the run's clock [s]."""
    if case.since == "act":
        return deed.at
    if case.since == "time":
        return next(tick["time"] for tick in ticks if tick["words"][2])
    if case.since == "fault":
        return START + offset - (0.0 if case.group == MOCAP else LATENCY)
    if case.since == "latch":
        return summary["latch_times"][0]
    if case.since == "throw":  # which may end in the tick that it begins in
        return next(tick["time"] for tick in ticks if tick["state"] not in BEFORE)
    return next(tick["time"] for tick in ticks if tick["state"] == case.since)

"""``visthrow hil check``: checks of the poses and the autopilot, of a hand-carry, or of a run's
hover.
"""

import argparse
import dataclasses
import json
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hil.control.recording.record import TICKS, lines, load_setup, require_run
from hil.control.state_machine import OperatorInput, State
from hil.control.tick.runner import Runner
from hil.errors import RunError
from hil.links.backends import make_backend
from hil.links.backends.base import FOLLOW, DryRun, Status
from hil.links.backends.thrust_curve import LEAST_SHARES, HoverMeter
from hil.links.clock import Clock, ManualClock, MonotonicClock
from hil.links.roster import Roster
from hil.params import HilParams
from hil.poses import handcarry
from hil.poses.body_track import Track
from hil.poses.pose import VEHICLE
from hil.poses.sources.open_source import open_source, unit_problems
from hil.run_command import key_of, params_of
from visthrow.onboard.hover import GRAVITY
from visthrow.onboard.policy import Policy, find_policy

CALM = 0.15  # speed below which a hover counts as steady [m/s]
LIFTED = 0.3  # height above which a vehicle counts as flying [m]
SETTLING = 50  # ticks at the start of a hover that are left out: a second
FOR_EVER = 1e9  # [s]
LISTEN = 5.0  # default duration of the check of poses [s]
CARRY = 180.0  # default duration of a hand-carry [s]


def check(args: argparse.Namespace) -> int:
    """Do the requested check."""
    if args.hand_carry:
        return _hand_carry(args)
    if args.hover_of is None:
        return _listen(args)
    good, text = hover_of_run(args.hover_of)
    print(f"{'PASS' if good else 'FAIL'}  {text}")
    return 0 if good else 1


@contextmanager
def _open_all(params: HilParams, args: argparse.Namespace) -> Iterator[tuple[Any, Any, Clock]]:
    """Open the source, the autopilot's link and the clock."""
    with tempfile.TemporaryDirectory() as folder:
        opened = open_source(params, Path(folder), MonotonicClock(args.speed), key_of(args))
        try:
            yield opened
        finally:
            opened[0].close()


def _hand_carry(args: argparse.Namespace) -> int:
    params = params_of(args)
    params = dataclasses.replace(
        params, source=dataclasses.replace(params.source, check_units=False)
    )
    with _open_all(params, args) as (source, _, clock):
        recorded = isinstance(clock, ManualClock)
        steps = handcarry.collect(
            source, clock, args.seconds or CARRY, lambda text: print(text, flush=True), recorded
        )
    finding = handcarry.judge(steps, params.frames[VEHICLE])
    print(handcarry.summary_text(finding, params.frames[VEHICLE]))
    return 0 if finding.passed else 1


def _listen(args: argparse.Namespace) -> int:
    """Check poses and autopilot for a while, without commands.

    The runner that would fly processes them, but never takes the vehicle over.
    """
    params = params_of(args)
    waiting = dataclasses.replace(params.states, idle=FOR_EVER, check=FOR_EVER, check_hold=FOR_EVER)
    with _open_all(params, args) as (source, link, clock):
        runner = Runner(
            dataclasses.replace(params, states=waiting),
            Policy.load(find_policy(params.policy)),
            DryRun(),
        )
        autopilot = AutopilotCheck(params, make_backend(params, link))
        begin = clock.now()
        seconds = args.seconds or LISTEN
        poses = []
        last: list[str] = []
        while clock.now() - begin < seconds and not source.ended:
            time = clock.now()
            new_poses = source.poll(time)
            poses += new_poses
            runner.tick(time, new_poses, autopilot.status(time), OperatorInput())
            last = runner.decider.problems() or last
            autopilot.tick(time, runner)
            clock.sleep_until(time + runner.pilot.period)
        time = clock.now()
        results = autopilot.results(time, runner.mass)
        autopilot.backend.close()
    rosters = [*source.rosters, *filter(None, [getattr(autopilot.backend, "roster", None)])]
    for name, track in runner.tracks.items():
        print(_body_line(name, track, time, time - begin, source.stamped))
    for roster in rosters:
        print("".join(f"{line}\n" for line in _link_lines(roster, params, time - begin)), end="")
    problems = (
        runner.decider.problems()
        + _not_taken(rosters, time - begin)
        + unit_problems(poses, params.frames)
        + [text for good, text in results if not good]
    )
    lasted = runner.machine.measure_hold(time)
    required = params.states.check_hold
    if not problems and lasted < required:
        problems = [
            f"all was well for the last {lasted:.1f} s; expected {required:g} s:"
            f" {'; '.join(last) or 'look longer, with --seconds'}"
        ]
    print("".join(f"{text}\n" for good, text in results if good), end="")
    print("\n".join(f"FAIL  {text}" for text in problems) or "PASS  all checks: a run would hover")
    return 1 if problems else 0


def _not_taken(rosters: list[Roster], seconds: float) -> list[str]:
    """Return texts on messages of known senders that were not accepted as poses, and why. A few
    do not count, such as a position before the first attitude.
    """
    return [
        f"{count} {entry.text()}"
        for roster in rosters
        for entry, count in roster.received.items()
        if entry.why and entry.system is not None and entry.address in (None, *roster.at.values())
        if count > seconds
    ]


def _body_line(name: str, track: Track, time: float, seconds: float, stamped: bool) -> str:
    flow = track.stream.flow(time)
    state = track.state(time)
    refused = json.dumps(track.gate.refused) if track.gate.refused else "none"
    if state is None:
        return f"{name}: no pose; refused by the gate: {refused}"
    x, y, z = state.pos
    return (
        f"{name}: {track.accepted / seconds:.0f} poses/s, age {1e3 * state.age:.0f} ms, at"
        f" ({x:+.3f}, {y:+.3f}, {z:+.3f}) m, refused: {refused}, velocity late by"
        f" {max(0.0, 1e3 * track.filter.lag):.0f} ms"
        + ("" if flow is None else f"\n  {flow.text()}")
        + (" (stamps are arrivals: the source tells no time)" if not stamped else "")
    )


def _link_lines(roster: Roster, params: HilParams, seconds: float) -> list[str]:
    """Return lines on a link's traffic: all of it if an expected party is silent, else the
    refused part.
    """
    silent = [party.name for party in roster.parties if party.name not in roster.at]
    lines = (
        [f"{' and '.join(silent)} not heard; expected: {roster.describe_parties()}"]
        if silent
        else []
    )
    for entry, count in roster.received.most_common():
        if silent or entry.why:
            lines.append(f"  {count / seconds:.1f} a second: {entry.text()}")
    if silent and not roster.received:
        lines.append(f"  nobody speaks on {params.source.device or params.link.device}")
    return lines


class AutopilotCheck:
    """A check of an autopilot without commands: of its parameters, and of the thrust share that
    it reports while the vehicle hovers.
    """

    def __init__(self, params: Any, backend: Any):
        """Start before the first message; a dry run has no autopilot."""
        self.backend = backend
        vehicle = params.vehicle
        self.meter = None if vehicle is None else HoverMeter(vehicle.thrust)

    def status(self, time: float) -> Status:
        """Return the status for the runner at a time [s], without the audit's fault, which
        :meth:`results` reports.
        """
        return dataclasses.replace(self.backend.status(time), fault=None)

    def tick(self, time: float, runner: Any) -> None:
        """Process messages; ``runner``: its track shows whether the vehicle hovers."""
        self.backend.service(time)
        track = runner.tracks[VEHICLE]
        state = track.state(time)
        if (
            self.meter is not None
            and state is not None
            and state.pos[2] > LIFTED
            and track.calm_speed() < CALM
        ):
            self.meter.add(self.backend.share)
        self.backend.share = None  # each report counts once

    def results(self, time: float, mass: float) -> list[tuple[bool, str]]:
        """Return the results for a hovering mass [kg]: whether each is good, and its text."""
        if self.meter is None:
            return []
        audit = self.backend.audit
        status = self.backend.status(time)
        if audit.rules:
            print(audit.table())
        out = [] if audit.fault() is None else [(False, audit.fault())]
        if not audit.done:
            out.append(
                (False, f"parameters were not read: {status.note or 'the time was too short'}")
            )
        return [*out, self.meter.summary_text(mass)]


def hover_of_run(folder: str | Path) -> tuple[bool, str]:
    """Return whether the thrust commanded in a run's hover before its throws matches the weight,
    and a text. Raises `RunError`: not a run with an autopilot, or too little hover.
    """
    folder = Path(folder)
    require_run(folder)
    params, policy = load_setup(folder)
    if params.vehicle is None:
        raise RunError(
            f"{folder} is a dry run: nothing followed its commands; expected a run with an"
            " autopilot"
        )
    weight = policy.total_mass * GRAVITY
    thrusts = []
    hovering = 0
    for line in lines(folder / TICKS):
        mode = Status(*line["status"]).mode
        follows = line["state"] in (State.READY, State.ARMED) and line["command"] and mode == FOLLOW
        hovering = hovering + 1 if follows else 0
        if hovering > SETTLING:
            thrusts.append(line["command"][0])
    if len(thrusts) < LEAST_SHARES:
        raise RunError(
            f"{folder}: {len(thrusts)} ticks of steady hover before throws; expected {LEAST_SHARES}"
            f" or more, after {SETTLING}: hover longer before a throw, as with --set"
            " states.armed_least=3.0"
        )
    thrust = params.vehicle.thrust
    commanded = sum(thrusts) / len(thrusts)
    ratio = commanded / weight
    text = (
        f"hover took {ratio:.3f} times the weight by the config's calibration: the hover share is"
        f" {thrust.share(commanded):.4f}, not {thrust.share(weight):.4f} ({len(thrusts)} ticks,"
        f" {100 * thrust.tolerance:g} % allowed)"
    )
    return abs(ratio - 1.0) <= thrust.tolerance, text

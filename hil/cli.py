"""``visthrow hil``: poses of a motion-capture system in, commands of a trained policy out."""

import argparse
import dataclasses
import json
import select
import signal
import sys
import time
from pathlib import Path
from typing import Any

ACTIONS = {
    "run": "fly, or run dry, by a config of configs/hil",
    "view": "look at a run in 3D: live, or from its folder as a recording, pictures and flight logs",
    "replay": "run a recorded run again and compare every action, bit for bit",
    "check": "look at the poses that come, and at what speaks against a throw",
    "record": "record the poses that come and what the policy would make of them; never arms, sends nothing",
    "fake": "a fake autopilot with the simulator's vehicle, to throw over the wire",
    "direct": "the fake's throws without wire, autopilot and real time: what the wire costs is measured against them",
}


def above_zero(text: str) -> float:
    """A number above 0 of the command line."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not value > 0.0:
        raise argparse.ArgumentTypeError(f"'{text}'; expected a number above 0")
    return value


def seed(text: str) -> int:
    """A whole number from 0 on of the command line."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}'; expected a whole number of 0 or more")
    return int(text)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = (
        "examples:\n"
        "  visthrow hil run                              dry run: poses on udp port 14560, nothing is sent\n"
        "  visthrow hil run --config fake --auto-arm     with `visthrow hil fake` in another terminal: a throw\n"
        "  visthrow hil run --config mine.toml --out runs/monday\n"
        "  visthrow hil replay runs/monday               the same actions again?\n"
        "  visthrow hil view runs/monday                 a recording for rerun, a picture and a flight log a throw\n"
        "  visthrow hil check --seconds 5                what comes, how old, how often, and the checks\n"
        "  visthrow hil check --hand-carry               carry the vehicle about: which axes fit?\n"
        "\nWhile a run goes on, type 'arm' (one throw), 'land' or 'abort' and Enter; Ctrl-C aborts.\n"
    )
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    subs = {name: actions.add_parser(name, help=text, description=text) for name, text in ACTIONS.items()}
    for name in ("run", "check", "record"):
        sub = subs[name]
        sub.add_argument("--config", default="dry_run", metavar="NAME", help="of configs/hil, or a file")
        sub.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
        sub.add_argument("--seconds", type=above_zero, default=None, help="end after this time")
        sub.add_argument("--speed", type=float, default=1.0, help="of the clock; below 1 with a fake of the same speed")
    for name in ("run", "record"):
        subs[name].add_argument(
            "--out", default=None, metavar="FOLDER", help="of the run (default: a new one in runs/hil)"
        )
        subs[name].add_argument("--view", action="store_true", help="serve a live view to this machine's browser")
        subs[name].add_argument(
            "--bare", action="store_true", help="leave out flight logs and pictures; `hil view` makes them later"
        )
    subs["run"].add_argument(
        "--write-parameters", action="store_true", help="set the autopilot's parameters that the audit finds wrong"
    )
    check = subs["check"]
    check.add_argument("--hand-carry", action="store_true", help="carry the vehicle about by hand: are the axes right?")
    check.add_argument(
        "--against-camera", nargs="+", metavar="FILE", help="recordings of a camera's detections; the first is fitted"
    )
    check.add_argument("--out", default="out/against_camera", metavar="FOLDER", help="of --against-camera")
    subs["check"].add_argument(
        "--hover-of", metavar="FOLDER", default=None, help="of a run: was its hover's thrust the weight by the calibration?"
    )
    subs["run"].add_argument("--auto-arm", action="store_true", help="arm whenever ready; for simulated vehicles only")
    for name in ("replay", "view"):
        subs[name].add_argument("folder", metavar="FOLDER", help="of a run")
    subs["view"].add_argument("--live", action="store_true", help="serve the run while it goes on, on 127.0.0.1 alone")
    subs["view"].add_argument("--out", default=None, metavar="FILE", help="of the recording (default: run.rrd in the folder)")
    subs["view"].add_argument("--web-port", type=int, default=9090, metavar="N", help="of the live view (default: 9090)")
    subs["view"].add_argument("--data-port", type=int, default=9876, metavar="N", help="of its data (default: 9876)")
    _add_simulated(subs["fake"], subs["direct"])


def _add_simulated(fake: argparse.ArgumentParser, direct: argparse.ArgumentParser) -> None:
    """Add the arguments of what flies a simulated vehicle."""
    direct.add_argument("--config", default="fake", metavar="NAME", help="of configs/hil, or a file")
    direct.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    direct.add_argument("--seeds", type=seed, nargs="+", default=[0], metavar="N", help="of starts, noise and loss; a throw each")
    fake.add_argument("--rate", type=float, default=100.0, metavar="HZ", help="poses a second of each body")
    plants = {direct: "make", fake: "make; of a firmware make_motors"}
    for parser, name in plants.items():
        parser.add_argument(
            "--plant", default=None, metavar="MODULE:FUNCTION",
            help=f"that makes the vehicle (default: visthrow.throws.wire_plant:{name})",
        )  # fmt: skip
    fake.add_argument("--device", default="udpout:127.0.0.1:14560", help="the runner's port")
    fake.add_argument("--policy", default="vision", metavar="POLICY", help="whose plant is flown")
    fake.add_argument("--seed", type=seed, default=0, help="of start, noise and loss")
    fake.add_argument("--seconds", type=above_zero, default=60.0, help="end after this time")
    fake.add_argument("--after", type=above_zero, default=10.0, help="end this long after the payload's landing [s]")
    fake.add_argument("--speed", type=float, default=1.0, help="of the clock")
    fake.add_argument(
        "--answer", default="accepted", help="to the release: accepted, in-progress, denied, silent, stuck"
    )
    fake.add_argument(
        "--kind", default="ardupilot", help="of autopilot: ardupilot, px4, betaflight; betaflight-sitl is a bridge to its firmware"
    )
    fake.add_argument("--firmware", default=None, metavar="PROGRAM", help="that betaflight-sitl starts")
    fake.add_argument("--folder", default="out/firmware", metavar="FOLDER", help="of the firmware's settings and blackbox")
    fake.add_argument("--config", default="betaflight_sitl", metavar="NAME", help="of the run that the firmware is set up for")
    fake.add_argument("--msp-port", type=int, default=14561, help="where the fake Betaflight listens")
    fake.add_argument(
        "--option", dest="overrides", action="append", default=[], metavar="KEY=VALUE",
        help="of hil.fakes.Options: silent_after=12, command_delay=0.03, parameters.GUID_OPTIONS=0, ...",
    )
    fake.add_argument("--out", default=None, metavar="FILE", help="write the report here")


def run(args: argparse.Namespace) -> int:
    """Do what was asked."""
    does = {
        "run": _run, "record": _run, "view": _view, "replay": _replay, "check": _check, "fake": _fake, "direct": _direct,
    }  # fmt: skip
    return does[args.action](args)


SWITCH = 5e-4
"""After which the recorder's thread gives way to the flying one [s]; Python's 5 ms are a quarter of a tick."""


class Keyboard:
    """The operator at the terminal: lines of standard input, and Ctrl-C."""

    def __init__(self, auto_arm: bool) -> None:
        """Take over Ctrl-C."""
        self._auto, self._stop = auto_arm, False
        try:
            self._open = sys.stdin.fileno() >= 0
        except (AttributeError, OSError, ValueError):  # there is no terminal
            self._open = False
        signal.signal(signal.SIGINT, self._interrupt)

    def _interrupt(self, *_: Any) -> None:
        if self._stop:
            raise KeyboardInterrupt
        self._stop = True

    def words(self, state: str) -> Any:
        """See `hil.control.loop.Operator`."""
        from hil.control.decision import Words

        said = set()
        while self._open and select.select([sys.stdin], [], [], 0)[0]:
            line = sys.stdin.readline()
            self._open = bool(line)
            said.add(line.strip().lower())
        return Words("arm" in said or (self._auto and state == "ready"), "land" in said, "abort" in said or self._stop)


def _params(args: argparse.Namespace) -> Any:
    from hil.params import HilParams
    from visthrow import config

    return config.load(HilParams, config.find("hil", args.config), args.overrides)


def _run(args: argparse.Namespace) -> int:
    started = time.monotonic()
    from hil.backends import make_backend, mechanism_lag, require_reach
    from hil.backends.check import told
    from hil.control.loop import fly
    from hil.control.realtime import keep, prepare
    from hil.control.rehearsal import Rehearsal
    from hil.control.runner import Runner
    from hil.links.clock import ManualClock, MonotonicClock
    from hil.recording.latency import Stages
    from hil.recording.record import Recorder
    from hil.recording.report import finish, story
    from hil.recording.view import beside
    from hil.sources.images import open_images
    from hil.sources.opening import open_source
    from visthrow.onboard.policy import Policy, find_policy

    params = _params(args)
    if args.action == "record":
        params = dataclasses.replace(params, backend="dry-run", observe=True)
    folder = Path(args.out or f"runs/hil/{time.strftime('%Y%m%d-%H%M%S')}")
    policy = Policy.load(find_policy(params.policy))
    source, link, recorded = open_source(params, folder, args.speed)
    clock = ManualClock(source.start) if recorded else MonotonicClock(args.speed)
    require_reach(params, policy.contract)
    backend = make_backend(params, link, getattr(args, "write_parameters", False), _tell_parameters, folder)
    runner = Runner(params, policy, backend, mechanism_lag(params))
    warm_up(runner)
    rehearsal = Rehearsal(runner) if params.realtime.rehearse and not recorded else None
    refused = prepare(params.realtime)
    recorder = Recorder(folder, params)
    for text in refused or keep(params.realtime):  # the recorder's thread holds what the flying one waits for; others do not
        print(f"note: {text}", file=sys.stderr)
    operator = Keyboard(args.action == "run" and args.auto_arm)
    print(f"ready after {time.monotonic() - started:.2f} s; waiting for poses", file=sys.stderr, flush=True)
    viewer, stages = beside(folder) if args.view else None, Stages()
    eyes = open_images(params.images, params.camera, clock.now) if params.keypoints == "detector" else None
    summary = fly(runner, source, clock, operator, recorder, args.seconds or float("inf"), _tell, stages, eyes, rehearsal)
    summary["autopilot"] = told(backend, link)
    if eyes is not None:
        eyes.close()
    backend.close()
    source.close()
    recorder.close(summary)
    if viewer is not None:
        viewer.terminate()
    print(story(summary, folder))
    if not args.bare:
        print("\n".join(finish(folder, stages)))
    return 1 if summary["aborted"] or summary["errors"] else 0


def warm_up(runner: Any) -> None:
    """Call the policy a few times on the ground: first calls are slow. One thread: more only wait for each other."""
    import numpy as np
    import torch

    torch.set_num_threads(1)
    sys.setswitchinterval(SWITCH)
    still = np.zeros((1, 3))
    for _ in range(3):
        runner.pilot.act(still, np.array([[0.0, 0.0, 0.0, 1.0]]), still, still, still - [0, 0, 0.4], still[0])
    runner.pilot.start()


def _tell_parameters(table: str) -> None:
    """Show the audit of the autopilot's parameters."""
    print(table, file=sys.stderr, flush=True)


def _tell(decision: Any) -> None:
    """Say each change of state."""
    print(f"{decision.time:12.3f} s  {decision.state:8} {decision.reason}", file=sys.stderr, flush=True)


def _replay(args: argparse.Namespace) -> int:
    from hil.recording.playback import replay

    found = replay(args.folder)
    for n, name, was, now in found["differences"][:10]:
        print(f"tick {n}: {name} was {was}, is {now}")
    same = "all bit for bit the same" if not found["differences"] else f"{len(found['differences'])} DIFFERENCES"
    print(f"{found['ticks']} ticks, {found['actions']} actions of the policy: {same}")
    return 0 if not found["differences"] else 1


def _view(args: argparse.Namespace) -> int:
    from hil.recording import view

    return view.run(Path(args.folder), args.live, args.out, args.web_port, args.data_port)


def _check(args: argparse.Namespace) -> int:
    if args.against_camera:
        from hil.recording import camera_report

        figures = camera_report.against_camera(_params(args), args.against_camera, args.out)
        print(camera_report.story(figures, args.out))
        return 0
    if args.hand_carry:
        return _hand_carry(args)
    if args.hover_of is not None:
        from hil.backends.check import hover_of_run

        good, text = hover_of_run(args.hover_of)
        print(f"{'PASS' if good else 'FAIL'}  {text}")
        return 0 if good else 1
    from hil.backends import DryRun, make_backend
    from hil.backends.check import AutopilotCheck
    from hil.control.decision import Words
    from hil.control.runner import Runner
    from hil.links.clock import ManualClock, MonotonicClock
    from hil.poses.plausible import unit_problems
    from hil.sources.opening import open_source
    from visthrow.onboard.policy import Policy, find_policy

    params = _params(args)
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        source, link, recorded = open_source(params, Path(folder), args.speed)
        clock = ManualClock(source.start) if recorded else MonotonicClock(args.speed)
        runner = Runner(params, Policy.load(find_policy(params.policy)), DryRun())
        autopilot = AutopilotCheck(params, make_backend(params, link))
        begin, seconds, poses = clock.now(), args.seconds or 5.0, []
        while clock.now() - begin < seconds and not source.ended:
            now = clock.now()
            came = source.poll(now)
            poses += came
            runner.tick(now, came, runner.backend.status(now), Words())
            autopilot.tick(now, runner)
            clock.sleep_until(now + runner.pilot.period)
        now = clock.now()
        found = autopilot.results(now, runner.mass)
        autopilot.backend.close()
        source.close()
    for name, track in runner.tracks.items():
        state = track.state(now)
        if state is None:
            print(f"{name}: no pose; refused: {track.gate.refused or 'none'}")
            continue
        x, y, z = state.pos
        print(
            f"{name}: {track.accepted / (now - begin):.0f} poses/s, age {1e3 * state.age:.0f} ms, at ({x:+.3f}, {y:+.3f}, "
            f"{z:+.3f}) m, refused: {json.dumps(track.gate.refused) if track.gate.refused else 'none'}, "
            f"velocity late by {max(0.0, 1e3 * track.filter.lag):.0f} ms"
        )
    problems = runner.problems() + unit_problems(poses, params.frames) + [text for good, text in found if not good]
    print("".join(f"{text}\n" for good, text in found if good), end="")
    print("\n".join(f"FAIL  {text}" for text in problems) or "PASS  all checks")
    return 1 if problems else 0


def _hand_carry(args: argparse.Namespace) -> int:
    import tempfile

    from hil.links.clock import ManualClock, MonotonicClock
    from hil.poses import handcarry
    from hil.poses.pose import VEHICLE
    from hil.sources.opening import open_source

    params = _params(args)
    params = dataclasses.replace(params, source=dataclasses.replace(params.source, check_units=False))
    with tempfile.TemporaryDirectory() as folder:
        source, _, recorded = open_source(params, Path(folder), args.speed)
        clock = ManualClock(source.start) if recorded else MonotonicClock(args.speed)
        steps = handcarry.collect(source, clock, args.seconds or 180.0, lambda text: print(text, flush=True), recorded)
        source.close()
    finding = handcarry.judge(steps, params.frames[VEHICLE])
    print(handcarry.story(finding, params.frames[VEHICLE]))
    return 0 if finding.passed else 1


def _direct(args: argparse.Namespace) -> int:
    from hil.fakes.direct import Direct, scored
    from hil.fakes.mocap import MocapParams
    from hil.fakes.process import load_plant
    from visthrow.onboard.policy import Policy, find_policy

    params = _params(args)
    policy, mocap = Policy.load(find_policy(params.policy)), MocapParams()
    for seed in args.seeds:
        plant = load_plant(args.plant or "visthrow.throws.wire_plant:make", params.policy, seed)
        report = Direct(plant, policy, params, mocap, seed).throw()
        print(json.dumps({"seed": seed, **scored(report, params, report["start"]), **report}), flush=True)
    return 0


def _fake(args: argparse.Namespace) -> int:
    from hil.fakes.process import VEHICLE_ID, ListeningPort, MocapParams, load_plant, make_fake, read_options, serve
    from hil.links.clock import MonotonicClock
    from hil.links.device import check_device, open_port
    from hil.links.mavlink_link import Link

    options, mocap = read_options([*args.overrides, f"answer={args.answer}"]), MocapParams(rate=args.rate)
    firmware = args.kind == "betaflight-sitl"
    plant = load_plant(args.plant or f"visthrow.throws.wire_plant:{'make_motors' if firmware else 'make'}", args.policy, args.seed)
    link = Link(open_port(check_device(args.device)), *VEHICLE_ID)
    clock, out = MonotonicClock(args.speed), None if args.out is None else Path(args.out)
    if firmware:
        report = _fly_firmware(args, plant, link, mocap, options, clock, out)
    else:
        port = ListeningPort(args.msp_port) if args.kind == "betaflight" else None
        fake = make_fake(args.kind, plant, link, mocap, args.seed, options, port)
        print(f"the fake {args.kind} flies", file=sys.stderr, flush=True)
        report = serve(fake, clock, args.seconds, out, args.after)
    print(json.dumps(report, indent=2))
    return 0


def _fly_firmware(
    args: argparse.Namespace, plant: Any, link: Any, mocap: Any, options: Any, clock: Any, out: Path | None
) -> dict[str, Any]:  # fmt: skip
    """Set a firmware up, fly the plant by its motor outputs, end it."""
    from hil.errors import RunError
    from hil.fakes.process import serve
    from hil.fakes.sitl import SLOW, BetaflightSitl, Firmware, favour, needed
    from hil.params import HilParams
    from visthrow import config

    if args.firmware is None:
        raise RunError("--kind betaflight-sitl without --firmware; expected Betaflight's program for a PC")
    params = config.load(HilParams, config.find("hil", args.config), [])
    firmware = Firmware(args.firmware, args.folder)
    try:
        kept = firmware.set_up(needed(params.betaflight))
        print("".join(f"{name:28} {value}\n" for name, value in kept.items()), end="", file=sys.stderr)
        fake = BetaflightSitl(plant, link, mocap, args.seed, options, params.betaflight)
        favour()
        fake.sensors.start(args.speed)
        print("the firmware has its settings; it flies", file=sys.stderr, flush=True)
        report = serve(fake, clock, args.seconds, out, args.after)
        fake.close()
    finally:
        firmware.stop()
    if report["late_periods"] > SLOW * report["time"] / plant.period:
        print(
            f"this machine is too slow: {report['late_periods']} of {report['time'] / plant.period:.0f} periods were late; "
            f"slow both clocks, --speed {args.speed / 2:g} here and of the run", file=sys.stderr,
        )  # fmt: skip
    return report

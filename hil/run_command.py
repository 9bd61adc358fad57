"""``visthrow hil run`` and ``record``: from a configuration to a flown run with its folder."""

import argparse
import contextlib
import dataclasses
import sys
import time
from pathlib import Path
from typing import Any

from hil.control.calibrating import CalibrationSolver
from hil.control.loop import LandAfterCalibration, Loop, Operator
from hil.control.realtime import keep, prepare
from hil.control.recording.latency import Stages
from hil.control.recording.record import RunRecorder, begin_folder, pack
from hil.control.recording.run_report import finish, summary_text
from hil.control.recording.view import start_viewer
from hil.control.tick.runner import Runner
from hil.errors import ConfigError, RunError
from hil.links.backends import make_backend, mechanism_lag, require_reach
from hil.links.clock import Clock, MonotonicClock
from hil.links.crtp import CFLIB
from hil.links.device import check_device
from hil.links.mavlink_link import Link
from hil.links.pymav import read_key
from hil.links.team_link import TeamLink
from hil.operator_terminal import Console, Terminal
from hil.params import HilParams
from hil.poses.sources.images import open_images
from hil.poses.sources.open_source import open_source
from visthrow import config
from visthrow.onboard.policy import Policy, find_policy


def params_of(args: argparse.Namespace) -> HilParams:
    """Return the configuration that a command names."""
    return config.load(HilParams, config.find("hil", args.config), args.overrides)


def key_of(args: argparse.Namespace) -> bytes | None:
    """Return the key that ``--sign`` names, or None."""
    return None if args.sign is None else read_key(args.sign)


def require_fake(params: HilParams) -> None:
    """Raise `RunError` for ``--auto-arm`` where a real vehicle could be at the other end: no
    loopback address, or no MAVLink poses.
    """
    devices = [params.link.device, params.source.device or params.link.device]
    devices += [f"udp:{member}" for member in (params.team.members if params.team else ())]
    if hasattr(params.vehicle, "device"):
        devices.append(params.vehicle.device)
    remote = [device for device in devices if not _is_loopback(device)]
    if params.source.kind == "mocap":
        remote.append(f"source.kind {params.source.kind}")
    if remote:
        raise RunError(
            f"--auto-arm with {', '.join(remote)}; it is for `visthrow hil fake` on this machine"
            " alone: type 'arm' instead"
        )


def _is_loopback(device: str) -> bool:
    if device.startswith(("serial:", *CFLIB)):
        return False
    return check_device(device, remote=True).host.startswith(("127.", "::1"))


def fly(args: argparse.Namespace) -> int:
    """Fly, or run dry, and write the run's folder; return 1 if the run was aborted or an
    exception was raised, else 0.
    """
    start = time.monotonic()
    params = run_params(args)
    folder = Path(args.out or f"runs/hil/{time.strftime('%Y%m%d-%H%M%S')}")
    console = Console()
    with begin_folder(folder):
        loop, link = _prepare(args, params, folder, console)
    delay = time.monotonic() - start
    print(f"ready after {delay:.2f} s; waiting for poses", file=sys.stderr, flush=True)
    viewer = start_viewer(folder) if args.view else None
    if loop.runner.calibrating is not None:
        policy = loop.runner.pilot.policy
        spreads = params.calibration.spreads
        loop.solver = CalibrationSolver(params.camera, policy.contract, spreads)
    summary = loop.fly(args.seconds or float("inf"))
    backend = loop.runner.backend
    source = loop.source
    rosters = [*source.rosters, *filter(None, [getattr(backend, "roster", None)])]
    summary |= {
        "speed": args.speed,
        "autopilot": autopilot_record(backend, link),
        "links": [roster.summary() for roster in rosters],
    }
    for part in (loop.eyes, loop.solver, loop.team, backend, source):
        if part is not None:
            part.close()
    loop.recorder.close(summary)
    if viewer is not None:
        viewer.terminate()
    console.close()
    _print(summary_text(summary, folder))
    if not args.bare:
        _print("\n".join(finish(folder, loop.stages, args.speed)))
    return _exit_status(summary, folder)


def run_params(args: argparse.Namespace) -> HilParams:
    """Return the configuration of an action; raises `ConfigError`, `RunError` where they do not fit
    together.
    """
    params = params_of(args)
    if args.action == "record":
        return dataclasses.replace(params, backend="dry-run", observe=True)
    if args.action == "calibrate" and params.calibration is None:
        raise ConfigError(
            f"config '{args.config}' has no table [calibration]; expected one, as of"
            " configs/hil/detector.toml"
        )
    if args.action == "run" and args.auto_arm:
        require_fake(params)
    return params


def _prepare(
    args: argparse.Namespace, params: HilParams, folder: Path, console: Console
) -> tuple[Loop, Link | None]:
    """Return the loop of a run, and the autopilot's link, if any."""
    flies = args.action == "run"
    policy = Policy.load(find_policy(params.policy))
    source, link, clock = open_source(
        params, folder, MonotonicClock(args.speed), key_of(args), console.say
    )
    require_reach(params, policy.contract)
    write = flies and args.write_parameters
    backend = make_backend(params, link, write, console.say, folder)
    runner = Runner(params, policy, backend, mechanism_lag(params))
    runner.estimator.watcher = getattr(backend, "place", None)  # if it uses the vehicle's poses
    refused = prepare(params.realtime)
    runner.commander.warm_up()
    eyes = None
    if params.keypoints == "detector":
        eyes = open_images(params.images, params.camera, clock.now)
    recorder = RunRecorder(folder, params)
    # The recorder's thread has inherited the priority, as the flying one waits for it.
    for text in refused or keep(params.realtime):
        console.say(f"note: {text}")
    simulated = lambda: any(link.roster.simulated for link in source.links)  # noqa: E731
    operator: Operator = Terminal(flies and args.auto_arm, simulated, console.say)
    if args.action == "calibrate":
        operator = LandAfterCalibration(operator, runner.calibrating)
    loop = Loop(
        *(runner, source, clock, operator, recorder, console.decision, Stages(), eyes),
        team=_team(params, runner.pilot.period, clock, args.speed),
    )
    return loop, link


def _team(params: HilParams, period: float, clock: Clock, speed: float) -> TeamLink | None:
    """Return the link to the rest of a team, on the machines' clock; None for one vehicle."""
    if params.team is None:
        return None
    offset = time.time() * speed - clock.now()
    return TeamLink(params.team, period, offset, params.link.remote)


def _exit_status(summary: dict[str, Any], folder: Path) -> int:
    """Return 1 for a failed run, after packing it, else 0."""
    if not (summary["aborted"] or summary["errors"]):
        return 0
    with contextlib.suppress(RunError):
        path = pack(folder)
        _print(f"{path}  the run in one file: `visthrow hil replay` says where it went wrong")
    return 1


def autopilot_record(backend: Any, link: Any) -> dict[str, Any]:
    """Return the summary of a run's autopilot: parameters, the last release, texts, and the clocks
    of the link's peers.
    """
    out: dict[str, Any] = {"backend": backend.name}
    if hasattr(backend, "audit"):
        audit = backend.audit
        release = backend.release_record
        out["parameters"] = {
            "found": audit.found,
            "written": audit.written,
            "problems": audit.problems,
        }
        out["release"] = {"state": release.state, "note": release.note, "sends": release.sends}
        out["texts"] = getattr(backend, "texts", [])[-50:]
    if link is not None and link.sync is not None:
        out["clocks"] = link.sync.summary()
    return out


def _print(text: str) -> None:
    """Print, unless the terminal is gone."""
    with contextlib.suppress(OSError):
        print(text, flush=True)

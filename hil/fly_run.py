"""``visthrow hil run`` and ``record``: from a configuration to a flown run with its folder."""

import argparse
import contextlib
import dataclasses
import sys
import time
from pathlib import Path
from typing import Any

from hil.control.calibrating import CalibrationSolver
from hil.control.loop import LandAfterCalibration, Loop
from hil.control.realtime import keep, prepare
from hil.control.recording.latency import Stages
from hil.control.recording.record import RunRecorder, begun, pack
from hil.control.recording.run_report import finish, summary_text
from hil.control.recording.view import start_viewer
from hil.control.runner import Runner
from hil.errors import ConfigError, RunError
from hil.links.backends import make_backend, mechanism_lag, require_reach
from hil.links.clock import ManualClock, MonotonicClock
from hil.links.crtp import CFLIB
from hil.links.device import check_device
from hil.links.pymav import read_key
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
    devices += (
        [getattr(params, params.backend).device]
        if params.backend in ("betaflight", "crazyflie")
        else []
    )
    loopback = lambda text: check_device(text, remote=True).host.startswith(("127.", "::1"))  # noqa: E731
    remote = [
        text for text in devices if text.startswith(("serial:", *CFLIB)) or not loopback(text)
    ]
    if params.source.kind == "mocap":
        remote.append(f"source.kind {params.source.kind}")
    if remote:
        raise RunError(
            f"--auto-arm with {', '.join(remote)}; it is for `visthrow hil fake` on this machine"
            " alone: type 'arm' instead"
        )


def fly(args: argparse.Namespace) -> int:
    """Fly, or run dry, and write the run's folder; 1 for a run that was aborted or in which
    something raised, else 0.
    """
    started, recording = time.monotonic(), args.action == "record"
    params = params_of(args)
    if recording:
        params = dataclasses.replace(params, backend="dry-run", observe=True)
    calibrates = args.action == "calibrate"
    if calibrates and params.calibration is None:
        raise ConfigError(
            f"config '{args.config}' has no table [calibration]; expected one, as of"
            " configs/hil/detector.toml"
        )
    auto_arm = args.action == "run" and args.auto_arm
    if auto_arm:
        require_fake(params)
    folder = Path(args.out or f"runs/hil/{time.strftime('%Y%m%d-%H%M%S')}")
    policy, console = Policy.load(find_policy(params.policy)), Console()
    with begun(folder):
        source, link, recorded = open_source(
            params, folder, MonotonicClock(args.speed), key_of(args), console.say
        )
        clock = ManualClock(source.start) if recorded else MonotonicClock(args.speed)
        require_reach(params, policy.contract)
        backend = make_backend(
            params, link, args.action == "run" and args.write_parameters, console.say, folder
        )
        runner = Runner(params, policy, backend, mechanism_lag(params))
        runner.estimator.watcher = getattr(backend, "place", None)  # who wants the vehicle's poses
        refused = prepare(params.realtime)
        runner.commander.warm_up()
        eyes = (
            open_images(params.images, params.camera, clock.now)
            if params.keypoints == "detector"
            else None
        )
        recorder = RunRecorder(folder, params)
    for text in refused or keep(
        params.realtime
    ):  # the recorder's thread holds what the flying one waits for; others do not
        console.say(f"note: {text}")
    operator = Terminal(
        auto_arm, lambda: any(one.roster.simulated for one in source.links), console.say
    )
    print(
        f"ready after {time.monotonic() - started:.2f} s; waiting for poses",
        file=sys.stderr,
        flush=True,
    )
    viewer, stages = start_viewer(folder) if args.view else None, Stages()
    solver = (
        None
        if runner.calibrating is None
        else CalibrationSolver(params.camera, policy.contract, params.calibration.spreads)
    )
    operator = LandAfterCalibration(operator, runner.calibrating) if calibrates else operator
    loop = Loop(runner, source, clock, operator, recorder, console.decision, stages, eyes, solver)
    summary = loop.fly(args.seconds or float("inf"))
    summary["speed"] = args.speed
    summary["autopilot"] = autopilot_record(backend, link)
    rosters = [*source.rosters, *filter(None, [getattr(backend, "roster", None)])]
    summary["links"] = [roster.summary() for roster in rosters]
    for part in (eyes, solver, backend, source):
        if part is not None:
            part.close()
    recorder.close(summary)
    if viewer is not None:
        viewer.terminate()
    console.close()
    _show(summary_text(summary, folder))
    if not args.bare:
        _show("\n".join(finish(folder, stages, args.speed)))
    if summary["aborted"] or summary["errors"]:
        with contextlib.suppress(RunError):
            _show(
                f"{pack(folder)}  the run in one file: `visthrow hil replay` says where it went"
                " wrong"
            )
        return 1
    return 0


def autopilot_record(backend: Any, link: Any) -> dict[str, Any]:
    """Return what a run's summary keeps of its autopilot: parameters, the last release, texts,
    clocks of the link's peers.
    """
    out: dict[str, Any] = {"backend": backend.name}
    if hasattr(backend, "audit"):
        audit, release = backend.audit, backend.release_record
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


def _show(text: str) -> None:
    """Print where somebody still reads: the terminal may have gone with the run."""
    with contextlib.suppress(OSError):
        print(text, flush=True)

"""``visthrow hil fake`` and ``direct``: the simulated vehicle over the wire, and without it."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from hil.cli.flight import key_of, params_of
from hil.errors import RunError
from hil.fakes.base import Options
from hil.fakes.direct import Direct, scored
from hil.fakes.mocap import MocapParams
from hil.fakes.process import VEHICLE_ID, AnsweringPort, ListeningPort, load_plant, make_fake, read_options, serve
from hil.fakes.sitl import SLOW, ArduPilotSitl, BetaflightSitl, Firmware, HangingBall, MotorPlant, Px4Sih, needed, throw
from hil.links.clock import Clock, MonotonicClock
from hil.links.device import check_device, open_port
from hil.links.mavlink_link import Link
from hil.params import HilParams
from visthrow import config
from visthrow.onboard.policy import Policy, find_policy

PLANT, MOTORS, BALL = "visthrow.throws.wire_plant:make", "visthrow.throws.wire_plant:make_motors", "hil.cli.simulated:make_ball"
"""What makes the vehicle behind a fake, and behind a firmware; the ball below a firmware's own vehicle."""

BRIDGE_ID = (254, 190)  # MAVLink ids of the bridge where it listens to an autopilot itself
BALL_LAG = 0.06  # from the mechanism's output to separation below PX4's vehicle [s], as `visthrow.throws.wire_plant.MECHANISM`


def direct(args: argparse.Namespace) -> int:
    """Throw without a wire, or through a firmware in lock step; a line of JSON a seed."""
    params = params_of(args)
    policy, mocap = Policy.load(find_policy(params.policy)), MocapParams()
    plant = args.plant or (PLANT if args.firmware is None else MOTORS)
    for seed in args.seeds:
        flown = load_plant(plant, args.policy or params.policy, seed)
        if args.firmware is None:
            report = Direct(flown, policy, params, mocap, seed).throw()
        else:
            report = throw(args.firmware, Path(args.folder) / f"{seed:03d}", params, policy, flown, mocap, seed)
            summary = report.pop("run")
            report |= {"start": None, "state": summary["state"], "reason": summary["reason"]}
        print(json.dumps({"seed": seed, **scored(report, params, report["start"]), **report}), flush=True)
    return 0


def fake(args: argparse.Namespace) -> int:
    """Fly a fake autopilot, and print its report."""
    options, mocap = read_options([*args.overrides, f"answer={args.answer}"]), MocapParams(rate=args.rate)
    sitl, usual = SITL.get(args.kind, (None, PLANT))
    plant = load_plant(args.plant or usual, args.policy, args.seed)
    link = Link(open_port(check_device(args.device)), *VEHICLE_ID, key=key_of(args))
    clock, out = MonotonicClock(args.speed), None if args.out is None else Path(args.out)
    if sitl is not None:
        report = sitl(args, plant, link, mocap, options, clock, out)
        _tell_late(report, plant.period, args.speed)
    else:
        port = ListeningPort(args.msp_port) if args.kind == "betaflight" else None
        if args.kind == "crazyflie":
            port = AnsweringPort(open_port(check_device(f"udp:127.0.0.1:{args.msp_port}")))
        flown = make_fake(args.kind, plant, link, mocap, args.seed, options, port)
        print(f"the fake {args.kind} flies", file=sys.stderr, flush=True)
        report = serve(flown, clock, args.seconds, out, args.after)
    print(json.dumps(report, indent=2))
    return 0


def _fly_betaflight(
    args: argparse.Namespace, plant: MotorPlant, link: Link, mocap: MocapParams, options: Options, clock: Clock, out: Path | None
) -> dict[str, Any]:  # fmt: skip
    """Set a firmware up, fly the plant by its motor outputs, end it; the report."""
    if args.firmware is None:
        raise RunError("--kind betaflight-sitl without --firmware; expected Betaflight's program for a PC")
    params = config.load(HilParams, config.find("hil", args.config)).betaflight
    firmware = Firmware(args.firmware, args.folder)
    try:
        kept = firmware.set_up(needed(params))
        firmware.start()
        print("".join(f"{name:28} {value}\n" for name, value in kept.items()), end="", file=sys.stderr)
        flown = BetaflightSitl(plant, link, mocap, args.seed, options, params, firmware.stands)
        flown.sensors.start()
        print("the firmware has its settings; it flies", file=sys.stderr, flush=True)
        report = serve(flown, clock, args.seconds, out, args.after)
        flown.close()
    finally:
        firmware.stop()
    return report


def _fly_ardupilot(
    args: argparse.Namespace, plant: MotorPlant, link: Link, mocap: MocapParams, options: Options, clock: Clock, out: Path | None
) -> dict[str, Any]:  # fmt: skip
    """Fly the plant by ArduPilot's outputs; the report."""
    params = config.load(HilParams, config.find("hil", args.config)).ardupilot
    flown = ArduPilotSitl(plant, link, mocap, args.seed, options, params)
    print("waiting for ArduPilot: --model json:127.0.0.1", file=sys.stderr, flush=True)
    try:
        return serve(flown, clock, args.seconds, out, args.after)
    finally:
        flown.close()


def _fly_px4(
    args: argparse.Namespace, plant: HangingBall, link: Link, mocap: MocapParams, options: Options, clock: Clock, out: Path | None
) -> dict[str, Any]:  # fmt: skip
    """Hang the ball below PX4's own vehicle; the report."""
    params = config.load(HilParams, config.find("hil", args.config)).px4
    flown = Px4Sih(plant, link, mocap, args.seed, options, params, Link(open_port(check_device(args.autopilot)), *BRIDGE_ID))
    print(f"waiting for PX4 on {args.autopilot}", file=sys.stderr, flush=True)
    try:
        return serve(flown, clock, args.seconds, out, args.after)
    finally:
        flown.close()


def make_ball(policy: str, seed: int) -> HangingBall:
    """Return rope and ball that a policy was trained with, below a vehicle that is told where it is."""
    contract = Policy.load(find_policy(policy)).contract
    rope, alone = contract["rope"], contract["vehicle"]["body"]["mass"]
    return HangingBall(
        np.array(rope["mount"]), rope["length"] + rope["payload_offset"], BALL_LAG,
        (alone + rope["rope_mass"] + rope["payload_mass"], alone), contract["action"]["max_thrust"],
    )  # fmt: skip


def _tell_late(report: dict[str, Any], period: float, speed: float) -> None:
    """Say where the machine was too slow for its clock."""
    periods = report["time"] / period
    if report["late_periods"] > SLOW * periods:
        print(
            f"this machine is too slow: {report['late_periods']} of {periods:.0f} periods were late; slow both clocks, --speed "
            f"{speed / 2:g} here and of the run", file=sys.stderr,
        )  # fmt: skip


SITL: dict[str, tuple[Any, str]] = {
    "betaflight-sitl": (_fly_betaflight, MOTORS), "ardupilot-sitl": (_fly_ardupilot, MOTORS), "px4-sih": (_fly_px4, BALL),
}
"""Kinds of fake that are a bridge to a firmware in software: what flies them, and what makes the vehicle behind it."""

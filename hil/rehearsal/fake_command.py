"""``visthrow hil fake``: a simulated vehicle behind a fake autopilot or a firmware in software."""

import argparse
import json
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from hil.commands import examples
from hil.errors import RunError
from hil.links.clock import MonotonicClock
from hil.links.device import check_device, open_port
from hil.links.mavlink_link import Link
from hil.params import HilParams
from hil.rehearsal.bridges.ardupilot_bridge import ArduPilotSitl
from hil.rehearsal.bridges.betaflight_bridge import SLOW, BetaflightSitl
from hil.rehearsal.bridges.betaflight_firmware import Firmware, list_settings
from hil.rehearsal.bridges.px4_bridge import HangingBall, Px4Sih
from hil.rehearsal.fake import VEHICLE_ID, Fake, FakeOptions
from hil.rehearsal.fake_mocap import FakeMocapParams
from hil.rehearsal.process import AFTER_LANDING, FAKES, load_fake, load_plant, serve
from hil.run_command import key_of
from visthrow import config
from visthrow.common.arguments import declare
from visthrow.common.errors import suggest
from visthrow.common.storage import writable
from visthrow.onboard.policy import Policy, find_policy

PLANT = "visthrow.throws.wire_plant:make"
MOTORS = "visthrow.throws.wire_plant:make_motors"
BALL = "hil.rehearsal.fake_command:make_ball"
"""What makes the vehicle behind a fake, and behind a firmware; the ball below a firmware's own
vehicle.
"""

SITL = {"betaflight-sitl": MOTORS, "ardupilot-sitl": MOTORS, "px4-sih": BALL}
"""Kinds of fake that are a bridge to a firmware in software, and what makes the vehicle behind it.
"""

BRIDGE_ID = (254, 190)  # MAVLink ids of the bridge where it listens to an autopilot itself
# from the mechanism's output to separation below PX4's vehicle [s], as
# `visthrow.throws.wire_plant.MECHANISM`
BALL_LAG = 0.06


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the action."""
    declare(__file__)(parser)
    parser.set_defaults(after=AFTER_LANDING)
    parser.epilog = examples("fake")


def run(args: argparse.Namespace) -> int:
    """Fly a fake autopilot, or a bridge to a firmware in software, and print its report."""
    kind_name = args.kind
    out = None if args.out is None else Path(args.out)
    options = config.loads(
        FakeOptions, "", [*args.overrides, f"answer={args.answer}"], "options of the fake"
    )
    mocap = FakeMocapParams(rate=args.rate)
    kinds = {*FAKES, *SITL}
    if ":" not in kind_name and kind_name not in kinds:
        raise RunError(f"--kind {kind_name}; {suggest(kind_name, kinds)}, or module:class")
    maker = args.plant or SITL.get(kind_name, PLANT)
    plant = load_plant(maker, args.policy, args.seed, args.changes)
    if out is not None:
        writable(out.parent)
    link = Link(
        open_port(check_device(args.device), "--device udpout:127.0.0.1:PORT"),
        *VEHICLE_ID,
        key=key_of(args),
    )
    with ExitStack() as ends:
        vehicle = plant, link, mocap, args.seed, options
        if kind_name in SITL:
            flown = _bridge(args, vehicle, ends)
        else:
            kind = load_fake(kind_name)
            flown = kind(*vehicle, kind.open_port(args.msp_port))
            print(f"the fake {kind_name} flies", file=sys.stderr, flush=True)
        ends.callback(flown.close)
        report = serve(flown, MonotonicClock(args.speed), args.seconds, out, args.after)
    late = report["late_periods"] * plant.period / report["time"]
    if kind_name in SITL and max(late, 1.0 - report.get("speed", 1.0)) > SLOW:
        print(
            f"this machine is too slow: {100 * late:.0f} % of the periods were late, the firmware's"
            f" clock went at {report.get('speed', 1.0):.2f} of this one's; slow all clocks,"
            f" --speed {args.speed / 2:g} here and of the run, the firmware's as its page says",
            file=sys.stderr,
        )
    print(json.dumps(report, indent=2))
    return 0


def _bridge(args: argparse.Namespace, vehicle: tuple[Any, ...], ends: ExitStack) -> Fake:
    """Return the bridge to a firmware: its outputs fly the plant, or the ball hangs below PX4's own
    vehicle.
    """
    params = config.load(HilParams, config.find("hil", args.config))
    flown: Fake
    if args.kind == "betaflight-sitl":
        if args.firmware is None:
            raise RunError(
                "--kind betaflight-sitl without --firmware; expected Betaflight's program for a PC"
            )
        firmware = Firmware(args.firmware, args.folder)
        ends.callback(firmware.stop)
        settings = firmware.set_up(list_settings(params.betaflight))
        firmware.start()
        print(
            "".join(f"{name:28} {value}\n" for name, value in settings.items()),
            end="",
            file=sys.stderr,
        )
        flown = BetaflightSitl(*vehicle, params.betaflight, firmware.stands)
        flown.sensors.start()
        status = "the firmware has its settings; it flies"
    elif args.kind == "ardupilot-sitl":
        flown = ArduPilotSitl(*vehicle, params.ardupilot)
        status = "waiting for ArduPilot: --model json:127.0.0.1"
    else:
        flown = Px4Sih(
            *vehicle,
            params.px4,
            Link(
                open_port(check_device(args.autopilot), "--autopilot udp:127.0.0.1:PORT"),
                *BRIDGE_ID,
            ),
        )
        status = f"waiting for PX4 on {args.autopilot}"
    print(status, file=sys.stderr, flush=True)
    return flown


def make_ball(policy: str, seed: int) -> HangingBall:
    """Return the rope and ball that a policy was trained with, below a vehicle that receives where
    it is.
    """
    contract = Policy.load(find_policy(policy)).contract
    rope = contract["rope"]
    vehicle = contract["vehicle"]["body"]["mass"]
    return HangingBall(
        np.array(rope["mount"]),
        rope["length"] + rope["payload_offset"],
        BALL_LAG,
        (vehicle + rope["rope_mass"] + rope["payload_mass"], vehicle),
        contract["action"]["max_thrust"],
    )

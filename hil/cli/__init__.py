"""``visthrow hil``: poses of a motion-capture system in, commands of a trained policy out."""

import argparse
import importlib

ACTIONS = {
    "run": "fly, or run dry, by a config of configs/hil",
    "view": "look at a run in 3D: live, or from its folder as a recording, pictures and flight logs",
    "replay": "run a recorded run again and compare every action, bit for bit",
    "check": "look at the poses that come, and at what speaks against a throw",
    "calibrate": "hover, sway, tell the camera's tilt and latency and the thrust in hover, and land; no throw",
    "record": "record the poses that come and what the policy would make of them; never arms, sends nothing",
    "fake": "a fake autopilot with the simulator's vehicle, to throw over the wire",
    "direct": "the fake's throws without wire, autopilot and real time: what the wire costs is measured against them",
}


DOES = {
    "run": ("flight", "fly"), "record": ("flight", "fly"), "calibrate": ("flight", "fly"),
    "view": ("recorded", "view"), "replay": ("recorded", "again"),
    "check": ("check", "check"), "fake": ("simulated", "fake"), "direct": ("simulated", "direct"),
}  # fmt: skip
"""Module and function of each action, imported only when it was chosen."""


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
        "  visthrow hil run --config mine.toml --out runs/first\n"
        "  visthrow hil replay runs/first               the same actions again?\n"
        "  visthrow hil view runs/first                 a recording for rerun, a picture and a flight log a throw\n"
        "  visthrow hil check --seconds 5                what comes, how old, how often, and the checks\n"
        "  visthrow hil check --hand-carry               carry the vehicle about: which axes fit?\n"
        "\nWhile a run goes on, type 'arm' (one throw), 'land' or 'abort' and Enter; Ctrl-C, SIGTERM and SIGHUP abort.\n"
    )
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    subs = {name: actions.add_parser(name, help=text, description=text) for name, text in ACTIONS.items()}
    for name in ("run", "check", "record", "calibrate"):
        sub = subs[name]
        sub.add_argument("--config", default="dry_run", metavar="NAME", help="of configs/hil, or a file")
        sub.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
        sub.add_argument("--seconds", type=above_zero, default=None, help="end after this time")
        sub.add_argument("--speed", type=float, default=1.0, help="of the clock; below 1 with a fake of the same speed")
        sub.add_argument("--sign", default=None, metavar="KEYFILE", help="sign MAVLink messages, and hear none that is not signed")
    for name in ("run", "record", "calibrate"):
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
    subs["check"].add_argument(
        "--hover-of", metavar="FOLDER", default=None, help="of a run: was its hover's thrust the weight by the calibration?"
    )
    subs["run"].add_argument("--auto-arm", action="store_true", help="arm whenever ready; for `visthrow hil fake` alone")
    for name in ("replay", "view"):
        more = ", or its bundle" if name == "replay" else ""
        subs[name].add_argument("folder", metavar="FOLDER", help=f"of a run{more}")
    subs["view"].add_argument("--live", action="store_true", help="serve the run while it goes on, on 127.0.0.1 alone")
    out = "of the recording: .rrd (rerun) or .mcap (Foxglove); default: run.rrd in the folder"
    subs["view"].add_argument("--out", default=None, metavar="FILE", help=out)
    subs["view"].add_argument("--web-port", type=int, default=9090, metavar="N", help="of the live view (default: 9090)")
    subs["view"].add_argument("--data-port", type=int, default=9876, metavar="N", help="of its data (default: 9876)")
    _add_simulated(subs["fake"], subs["direct"])


def _add_simulated(fake: argparse.ArgumentParser, direct: argparse.ArgumentParser) -> None:
    """Add the arguments of what flies a simulated vehicle."""
    direct.add_argument("--config", default="fake", metavar="NAME", help="of configs/hil, or a file")
    direct.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    direct.add_argument("--seeds", type=seed, nargs="+", default=[0], metavar="N", help="of starts, noise and loss; a throw each")
    fake.add_argument("--rate", type=float, default=100.0, metavar="HZ", help="poses a second of each body")
    direct.add_argument("--policy", default=None, metavar="POLICY", help="whose plant is flown (default: the one that throws)")
    for parser in (fake, direct):
        parser.add_argument("--firmware", default=None, metavar="PROGRAM", help="Betaflight's for a PC, to fly the plant's motors")
        parser.add_argument("--folder", default="out/firmware", metavar="FOLDER", help="of the firmware's settings and blackbox")
        parser.add_argument(
            "--plant", default=None, metavar="MODULE:FUNCTION",
            help="that makes the vehicle (default: visthrow.throws.wire_plant:make, behind a firmware :make_motors)",
        )  # fmt: skip
    fake.add_argument("--device", default="udpout:127.0.0.1:14560", help="the runner's port")
    fake.add_argument("--sign", default=None, metavar="KEYFILE", help="as of `hil run`")
    fake.add_argument("--policy", default="vision", metavar="POLICY", help="whose plant is flown")
    fake.add_argument("--seed", type=seed, default=0, help="of start, noise and loss")
    fake.add_argument("--seconds", type=above_zero, default=60.0, help="end after this time")
    fake.add_argument("--after", type=above_zero, default=10.0, help="end this long after the payload's landing [s]")
    fake.add_argument("--speed", type=float, default=1.0, help="of the clock")
    fake.add_argument(
        "--answer", default="accepted", help="to the release: accepted, in-progress, denied, silent, stuck"
    )
    fake.add_argument(
        "--kind", default="ardupilot",
        help="of autopilot: ardupilot, px4, betaflight, crazyflie; or a bridge to software: betaflight-sitl, ardupilot-sitl, px4-sih",
    )
    fake.add_argument("--autopilot", default="udp:127.0.0.1:14550", help="where px4-sih hears PX4 itself: its port for ground stations")
    fake.add_argument("--config", default="betaflight_sitl", metavar="NAME", help="of the run that the firmware is set up for")
    fake.add_argument("--msp-port", type=int, default=14561, help="where the fake Betaflight or Crazyflie listens")
    fake.add_argument(
        "--option", dest="overrides", action="append", default=[], metavar="KEY=VALUE",
        help="of hil.fakes.Options: silent_after=12, command_delay=0.03, parameters.GUID_OPTIONS=0, ...",
    )
    fake.add_argument("--out", default=None, metavar="FILE", help="write the report here")


def run(args: argparse.Namespace) -> int:
    """Do what was asked."""
    module, name = DOES[args.action]
    return getattr(importlib.import_module(f"hil.cli.{module}"), name)(args)

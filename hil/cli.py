"""``visthrow hil``: poses of a motion-capture system in, commands of a trained policy out."""

import argparse
import importlib
from typing import Any

from visthrow.common.arguments import ABOVE_ZERO, PORT, WHOLE

ACTIONS = {
    "run": ("flight:fly", "fly, or run dry, by a config of configs/hil"),
    "view": (
        "control.recording.view:run",
        "look at a run in 3D: live, or from its folder as a recording, pictures and flight logs",
    ),
    "replay": (
        "control.recording.playback:again",
        "run a recorded run again and compare every action, bit for bit",
    ),
    "check": ("check:check", "look at the poses that come, and at what speaks against a throw"),
    "calibrate": (
        "flight:fly",
        (
            "hover, sway, tell the camera's tilt and latency and the thrust in hover, and land; no"
            " throw"
        ),
    ),
    "record": (
        "flight:fly",
        (
            "record the poses that come and what the policy would make of them; never arms, sends"
            " nothing"
        ),
    ),
    "fake": (
        "rehearsal.fake_command:fake",
        "a fake autopilot with the simulator's vehicle, to throw over the wire",
    ),
}
"""Name -> module and function, imported only when it was chosen, and help."""

EXAMPLES = """
  visthrow hil run                              dry run: poses on udp port 14560, nothing is sent
  visthrow hil run --config fake --auto-arm     a throw; needs `visthrow hil fake` in a terminal
  visthrow hil run --config mine.toml --out runs/first
  visthrow hil record --config mine.toml --seconds 60
  visthrow hil calibrate --config mine.toml     a hover by which the camera's tilt is told
  visthrow hil replay runs/first                the same actions again?
  visthrow hil view runs/first                  a recording, a picture and a log of each throw
  visthrow hil check --seconds 5                what comes, how old, how often, and the checks
  visthrow hil check --hand-carry               carry the vehicle about: which axes fit?
  visthrow hil fake --seconds 60                flies for `visthrow hil run --config fake`
"""

DURING = """

During a run, type 'arm' (one throw), 'land' or 'abort' and Enter.
Ctrl-C, SIGTERM and SIGHUP abort.
"""


def examples(action: str = "") -> str:
    """Return the examples of an action, or of all."""
    lines = [line for line in EXAMPLES.splitlines() if line.startswith(f"  visthrow hil {action}")]
    return "\n".join(["examples:", *lines]) + (DURING if action in ("", *FLIES) else "")


FLIES = ("run", "record", "calibrate")
FLAG, OVERRIDES = {"action": "store_true"}, {"dest": "overrides", "action": "append", "default": []}
KINDS = (
    "ardupilot, or module:class; or a bridge to software: betaflight-sitl, ardupilot-sitl, px4-sih"
)
PLANTS = "visthrow.throws.wire_plant:make, behind a firmware :make_motors"
FILE = "of the recording: .rrd (rerun) or .mcap (Foxglove); default: run.rrd in the folder"

OPTIONS: tuple[tuple[tuple[str, ...], str, str | None, str | None, dict[str, Any]], ...] = (
    (
        ("run", "check", "record", "calibrate"),
        "--config",
        "NAME",
        "of configs/hil, or a file",
        {"default": "dry_run"},
    ),
    (("run", "check", "record", "calibrate"), "--set", "KEY=VALUE", None, OVERRIDES),
    (
        ("run", "check", "record", "calibrate"),
        "--seconds",
        None,
        "end after this time",
        {"type": ABOVE_ZERO},
    ),
    (
        ("run", "check", "record", "calibrate"),
        "--speed",
        None,
        "of the clock; below 1 with a fake of the same speed",
        {"type": ABOVE_ZERO, "default": 1.0},
    ),
    (
        ("run", "check", "record", "calibrate"),
        "--sign",
        "KEYFILE",
        "sign MAVLink messages, and hear none that is not signed",
        {},
    ),
    (FLIES, "--out", "FOLDER", "of the run (default: a new one in runs/hil)", {}),
    (FLIES, "--view", None, "serve a live view to this machine's browser", FLAG),
    (
        FLIES,
        "--bare",
        None,
        "leave out flight logs and pictures; `hil view` makes them later",
        FLAG,
    ),
    (
        ("run",),
        "--write-parameters",
        None,
        "set the autopilot's parameters that the audit finds wrong",
        FLAG,
    ),
    (
        ("check",),
        "--hand-carry",
        None,
        "carry the vehicle about by hand: are the axes right?",
        FLAG,
    ),
    (
        ("check",),
        "--hover-of",
        "FOLDER",
        "of a run: was its hover's thrust the weight by the calibration?",
        {},
    ),
    (("run",), "--auto-arm", None, "arm whenever ready; for `visthrow hil fake` alone", FLAG),
    (("replay",), "folder", "FOLDER", "of a run, or its bundle", {}),
    (("view",), "folder", "FOLDER", "of a run", {}),
    (("view",), "--live", None, "serve the run while it goes on, on 127.0.0.1 alone", FLAG),
    (("view",), "--out", "FILE", FILE, {}),
    (
        ("view",),
        "--web-port",
        "N",
        "of the live view (default: 9090)",
        {"type": PORT, "default": 9090},
    ),
    (("view",), "--data-port", "N", "of its data (default: 9876)", {"type": PORT, "default": 9876}),
    (
        ("fake",),
        "--rate",
        "HZ",
        "poses a second of each body",
        {"type": ABOVE_ZERO, "default": 100.0},
    ),
    (
        ("fake",),
        "--firmware",
        "PROGRAM",
        "of --kind betaflight-sitl: Betaflight's for a PC, to fly the plant's motors",
        {},
    ),
    (
        ("fake",),
        "--folder",
        "FOLDER",
        "of the firmware's settings and blackbox",
        {"default": "out/firmware"},
    ),
    (("fake",), "--plant", "MODULE:FUNCTION", f"that makes the vehicle (default: {PLANTS})", {}),
    (("fake",), "--device", None, "the runner's port", {"default": "udpout:127.0.0.1:14560"}),
    (("fake",), "--sign", "KEYFILE", "as of `hil run`", {}),
    (("fake",), "--policy", "POLICY", "whose plant is flown", {"default": "vision"}),
    (("fake",), "--seed", None, "of start, noise and loss", {"type": WHOLE, "default": 0}),
    (("fake",), "--seconds", None, "end after this time", {"type": ABOVE_ZERO, "default": 60.0}),
    (
        ("fake",),
        "--after",
        None,
        "end this long after the payload's landing [s]",
        {"type": ABOVE_ZERO, "default": 10.0},
    ),
    (("fake",), "--speed", None, "of the clock", {"type": ABOVE_ZERO, "default": 1.0}),
    (
        ("fake",),
        "--answer",
        None,
        "to the release: accepted, in-progress, denied, silent, stuck",
        {"default": "accepted"},
    ),
    (("fake",), "--kind", None, f"of autopilot: {KINDS}", {"default": "ardupilot"}),
    (
        ("fake",),
        "--autopilot",
        None,
        "where px4-sih hears PX4 itself: its port for ground stations",
        {"default": "udp:127.0.0.1:14550"},
    ),
    (
        ("fake",),
        "--config",
        "NAME",
        "of the run that the firmware is set up for",
        {"default": "betaflight_sitl"},
    ),
    (
        ("fake",),
        "--msp-port",
        None,
        "where a fake listens that has a port of its own",
        {"type": PORT, "default": 14561},
    ),
    (
        ("fake",),
        "--option",
        "KEY=VALUE",
        "of hil.rehearsal.fake.Options: silent_after=12, parameters.GUID_OPTIONS=0, ...",
        OVERRIDES,
    ),
    (("fake",), "--out", "FILE", "write the report here", {}),
)
"""Actions, name, what stands for the value, help, and the rest of an argument."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = examples()
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    subs = {
        name: actions.add_parser(
            name,
            help=text,
            description=text,
            epilog=examples(name),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        for name, (_, text) in ACTIONS.items()
    }
    for names, option, metavar, text, more in OPTIONS:
        kinds = {
            key: value
            for key, value in {"metavar": metavar, "help": text, **more}.items()
            if value is not None
        }
        for name in names:
            subs[name].add_argument(option, **kinds)


def run(args: argparse.Namespace) -> int:
    """Do what was asked."""
    module, _, name = ACTIONS[args.action][0].partition(":")
    return getattr(importlib.import_module(f"hil.{module}"), name)(args)

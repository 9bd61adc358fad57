"""Actions of ``visthrow hil``, a module each, and the options that they share."""

import argparse

from visthrow.common.arguments import ABOVE_ZERO, add_common

FLIES = ("run", "record", "calibrate")

EXAMPLES = """
  visthrow hil run                              dry run: poses on udp port 14560, nothing is sent
  visthrow hil run --config fake --auto-arm     a throw; needs `visthrow hil fake` in a terminal
  visthrow hil run --config mine.toml --out runs/first
  visthrow hil record --config mine.toml --seconds 60
  visthrow hil calibrate --config mine.toml     estimate the camera's tilt in a hover
  visthrow hil replay runs/first                check that the policy repeats its actions
  visthrow hil view runs/first                  a recording, a picture and a log of each throw
  visthrow hil check --seconds 5                rate and age of incoming poses, and the checks
  visthrow hil check --hand-carry               carry the vehicle by hand to check its axes
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


def add_source_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of whatever receives poses: configuration, time, clock and signing."""
    add = parser.add_argument
    add("--config", metavar="NAME", default="dry_run", help="of configs/hil, or a file")
    add_common(parser, device=False, json=False)
    add("--seconds", type=ABOVE_ZERO, help="end after this time")
    speed = "of the clock; below 1 with a fake of the same speed"
    add("--speed", type=ABOVE_ZERO, default=1.0, help=speed)
    signing = "sign MAVLink messages, and reject any that is not signed"
    add("--sign", metavar="KEYFILE", help=signing)

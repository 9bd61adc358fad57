"""``visthrow hil``: poses of a motion-capture system in, commands of a trained policy out.

Each action is imported when chosen.
"""

import argparse

from hil.commands import examples
from visthrow.common.arguments import add_commands, run_command

ACTIONS = {
    "run": ("fly, or run dry, by a config of configs/hil", "hil.commands.run_command"),
    "view": (
        "look at a run in 3D: live, or from its folder as a recording, pictures and flight logs",
        "hil.commands.view_command",
    ),
    "replay": (
        "run a recorded run again and compare every action, bit for bit",
        "hil.commands.replay_command",
    ),
    "check": (
        "check the poses that arrive, and what forbids a throw",
        "hil.commands.check_command",
    ),
    "calibrate": (
        "hover, sway, estimate the camera's tilt and latency and the thrust in hover, and land",
        "hil.commands.calibrate_command",
    ),
    "record": (
        "record the poses that arrive and what the policy would make of them; never arms",
        "hil.commands.record_command",
    ),
    "fake": (
        "a fake autopilot with the simulator's vehicle, to throw over the wire",
        "hil.rehearsal.fake_command",
    ),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the actions of the command."""
    parser.epilog = examples()
    add_commands(parser, ACTIONS, "action")


def run(args: argparse.Namespace) -> int:
    """Do what was asked."""
    return run_command(ACTIONS, args.action, args)

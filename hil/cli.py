"""``visthrow hil``: poses of a motion-capture system in, commands of a trained policy out.

Each action is imported when chosen.
"""

import argparse

from hil.commands import examples
from visthrow.common.arguments import add_commands, run_command

ACTIONS = {
    "run": (
        "fly, or compute commands without sending them (a dry run)",
        "hil.commands.flight_command",
    ),
    "view": (
        "show a run in 3D while it flies, or write a recording, pictures and flight logs of it",
        "hil.commands.view_command",
    ),
    "replay": (
        "run a recorded run again and compare every action, bit for bit",
        "hil.commands.replay_command",
    ),
    "check": (
        "check the incoming poses, and print what prevents a throw",
        "hil.commands.check_command",
    ),
    "calibrate": (
        "hover, sway, estimate the camera's tilt and latency and the thrust in hover, and land",
        "hil.commands.flight_command",
    ),
    "record": (
        "record incoming poses and the policy's commands for them; never arms",
        "hil.commands.flight_command",
    ),
    "fake": (
        "run a fake autopilot that flies the simulated vehicle over UDP",
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

"""``visthrow hil``: poses of a motion-capture system in, commands of a trained policy out.

Each action is imported when chosen.
"""

import argparse
import tomllib
from pathlib import Path

from hil.commands import examples
from visthrow.common.arguments import add_commands, run_command

ACTIONS = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the actions of the command."""
    parser.epilog = examples()
    add_commands(parser, ACTIONS, "action")


def run(args: argparse.Namespace) -> int:
    """Do what was asked."""
    return run_command(ACTIONS, args.action, args)

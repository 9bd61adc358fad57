"""``visthrow diagnose``: from measured flights to what the simulation gets wrong.

Each action is imported when chosen.
"""

import argparse

from visthrow.common.arguments import add_commands, run_command
from visthrow.common.toml_text import tables_beside

ACTIONS = tables_beside(__file__)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the actions of the command."""
    add_commands(parser, ACTIONS, "action")


def run(args: argparse.Namespace) -> int:
    """Do what was asked."""
    return run_command(ACTIONS, args.action, args)

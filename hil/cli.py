"""``visthrow hil``: flies a trained policy on poses of a motion-capture system.

Each action is imported when chosen.
"""

import argparse

from hil.commands import examples
from visthrow.common.arguments import add_commands, run_command
from visthrow.common.toml_text import tables_beside

ACTIONS = tables_beside(__file__)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the actions of the command."""
    parser.epilog = examples()
    add_commands(parser, ACTIONS, "action")


def run(args: argparse.Namespace) -> int:
    """Run the chosen action."""
    return run_command(ACTIONS, args.action, args)

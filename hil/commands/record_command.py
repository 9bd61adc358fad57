"""``visthrow hil record``: record poses, and what the policy would make of them; never arms."""

import argparse

from hil.commands import add_flight_options, examples, fly

run = fly


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the action."""
    parser.epilog = examples("record")
    add_flight_options(parser)

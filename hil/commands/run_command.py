"""``visthrow hil run``: fly, or run dry, by a configuration."""

import argparse

from hil.commands import add_flight_options, examples, fly

run = fly


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the action."""
    parser.epilog = examples("run")
    add_flight_options(parser)
    write = "set the autopilot's parameters that the audit finds wrong"
    parser.add_argument("--write-parameters", action="store_true", help=write)
    arm = "arm whenever ready; for `visthrow hil fake` alone"
    parser.add_argument("--auto-arm", action="store_true", help=arm)

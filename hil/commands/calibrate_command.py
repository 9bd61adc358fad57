"""``visthrow hil calibrate``: hover, sway, estimate the camera's tilt and latency, and land."""

import argparse

from hil.commands import add_flight_options, examples, fly

run = fly


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the action."""
    parser.epilog = examples("calibrate")
    add_flight_options(parser)

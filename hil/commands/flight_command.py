"""``visthrow hil run``, ``record`` and ``calibrate``: fly, or run dry, by a configuration."""

import argparse

from hil.commands import add_arguments as add_arguments


def run(args: argparse.Namespace) -> int:
    """Fly, or run dry, and return the exit status."""
    from hil import fly_run

    return fly_run.fly(args)

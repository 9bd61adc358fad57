"""``visthrow hil replay``: run a recorded run again and compare every action, bit for bit."""

import argparse

from hil.commands import examples


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the action."""
    parser.epilog = examples("replay")
    parser.add_argument("folder", metavar="FOLDER", help="of a run, or its bundle")


def run(args: argparse.Namespace) -> int:
    """Replay and compare."""
    from hil.control.recording import playback

    return playback.compare_run(args)

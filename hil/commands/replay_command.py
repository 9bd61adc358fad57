"""``visthrow hil replay``: replay a recorded run and compare every action, bit for bit."""

import argparse

from hil.commands import add_arguments as add_arguments


def run(args: argparse.Namespace) -> int:
    """Replay and compare."""
    from hil.control.recording import playback

    return playback.compare_run(args)

"""``visthrow hil check``: poses as they arrive, and the failed pre-throw checks."""

import argparse

from hil.commands import add_source_options, examples


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the action."""
    parser.epilog = examples("check")
    add_source_options(parser)
    carry = "carry the vehicle about by hand: are the axes right?"
    parser.add_argument("--hand-carry", action="store_true", help=carry)
    hover = "of a run: was its hover's thrust the weight by the calibration?"
    parser.add_argument("--hover-of", metavar="FOLDER", help=hover)


def run(args: argparse.Namespace) -> int:
    """Listen, print and judge."""
    from hil import check

    return check.check(args)

"""``visthrow hil check``: poses as they arrive, and the failed pre-throw checks."""

import argparse

from hil.commands import add_arguments as add_arguments


def run(args: argparse.Namespace) -> int:
    """Listen, print and judge."""
    from hil import check

    return check.check(args)

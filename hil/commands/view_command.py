"""``visthrow hil view``: look at a run in 3D, live or from its folder."""

import argparse

from hil.commands import add_arguments as add_arguments


def run(args: argparse.Namespace) -> int:
    """Write or serve the view."""
    from hil.control.recording import view

    return view.run(args)

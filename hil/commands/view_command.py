"""``visthrow hil view``: look at a run in 3D, live or from its folder."""

import argparse

from hil.commands import examples
from visthrow.common.arguments import PORT


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the action."""
    parser.epilog = examples("view")
    add = parser.add_argument
    add("folder", metavar="FOLDER", help="of a run")
    add("--live", action="store_true", help="serve the run while it goes on, on 127.0.0.1 alone")
    out = "of the recording: .rrd (rerun) or .mcap (Foxglove); default: run.rrd in the folder"
    add("--out", metavar="FILE", help=out)
    web = "of the live view (default: 9090)"
    data = "of its data (default: 9876)"
    add("--web-port", metavar="N", type=PORT, default=9090, help=web)
    add("--data-port", metavar="N", type=PORT, default=9876, help=data)


def run(args: argparse.Namespace) -> int:
    """Write or serve the view."""
    from hil.control.recording import view

    return view.run(args)

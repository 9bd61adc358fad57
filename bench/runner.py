"""The HIL runner against the fake autopilot, each in its own process, over loopback in real time.

Latency and soak by default: times of each stage, ticks missed, memory. With ``--throws`` a series
of throws, each paired with the same one flown without a wire. With ``--faults`` its reactions to
faults, and their delays."""

import argparse
import sys
from collections.abc import Sequence

from bench import start
from bench.faults import faults
from bench.report import finish
from bench.soak import soak
from bench.throws import series


def run(args: argparse.Namespace) -> int:
    """Run the chosen measurement."""
    measure = series if args.throws else soak if args.faults is None else faults
    return finish(measure(args), args)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = start.parser_of(__doc__)
    parser.add_argument(
        "--policy",
        default="vision",
        metavar="POLICY",
        help="a shipped name or a file (default: vision)",
    )
    parser.add_argument(
        "--minutes",
        type=float,
        default=1.0,
        metavar="N",
        help="of the soak, in real time (default: 1)",
    )
    parser.add_argument(
        "--rate",
        type=float,
        default=200.0,
        metavar="HZ",
        help="of poses in the soak (default: 200)",
    )
    parser.add_argument(
        "--core", type=int, metavar="N", help="CPU core that the runner is kept on in the soak"
    )
    parser.add_argument("--keep", metavar="FOLDER", help="keep the soak's run here")
    parser.add_argument(
        "--throws",
        type=int,
        default=0,
        metavar="N",
        help="throw so often instead; may be interrupted",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the first throw (default: 0)")
    parser.add_argument(
        "--jobs",
        type=int,
        default=1,
        metavar="N",
        help=(
            "throws or faults at once, each with a core for the run and one for the fake where"
            " there are enough (default: 1)"
        ),
    )
    parser.add_argument(
        "--speed",
        type=float,
        default=1.0,
        metavar="X",
        help="of both clocks in throws and faults; below 1 on a machine too slow for real time",
    )
    parser.add_argument(
        "--out", default="out/hil", metavar="FOLDER", help="of the series (default: out/hil)"
    )
    parser.add_argument(
        "--keep-runs", action="store_true", help="keep the run folder of each throw, for hil view"
    )
    parser.add_argument(
        "--kind",
        default="ardupilot",
        help="of fake in faults; other kinds fly the ways for a run to end",
    )
    parser.add_argument(
        "--faults",
        nargs="*",
        metavar="NAME",
        help="inject these faults instead (default: each in turn)",
    )
    return start.main(parser, run, argv)


if __name__ == "__main__":
    sys.exit(main())

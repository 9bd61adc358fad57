"""``visthrow diagnose check``: whether logs can answer anything, before a model is asked."""

import argparse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the action."""
    parser.add_argument("logs", metavar="LOG", nargs="+", help="files or folders of flights")


def run(args: argparse.Namespace) -> int:
    """Read, look, print."""
    from visthrow.flightlog import FlightLog

    for path in args.logs:
        log = FlightLog.load(path)
        print(path, ", ".join(f"{name} {len(channel.time)}" for name, channel in log.channels.items()))
    return 0

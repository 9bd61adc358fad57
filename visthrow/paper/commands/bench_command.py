"""``visthrow bench records``: what was measured, with command, commit and machine."""

import argparse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the action of the command."""
    records = parser.add_subparsers(dest="bench", metavar="ACTION", required=True).add_parser(
        "records",
        help="print the recorded measurements as Markdown",
        description=(
            "Print the recorded measurements as Markdown: the command and commit that made each,"
            " and the command of today."
        ),
    )
    records.add_argument("names", metavar="NAME", nargs="*", help="records to print (default: all)")


def run(args: argparse.Namespace) -> int:
    """Print records."""
    from visthrow.common.errors import VisthrowError, suggest
    from visthrow.paper import measurements

    paths = {path.stem: path for path in measurements.record_paths()}
    unknown = [name for name in args.names if name not in paths]
    if unknown:
        raise VisthrowError(f"no record '{unknown[0]}'; {suggest(unknown[0], paths)}")
    for name in args.names or paths:
        record = measurements.load(paths[name])
        print(f"## {name}\n\n{measurements.origin(record)}\n\n{measurements.body(record)}\n")
    return 0

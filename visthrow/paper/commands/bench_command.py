"""``visthrow bench records``: print recorded measurements, with command, commit and machine."""

import argparse

from visthrow.common.arguments import declare

add_arguments = declare(__file__)


def run(args: argparse.Namespace) -> int:
    """Print the records."""
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

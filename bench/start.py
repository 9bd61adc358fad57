"""Parts that the commands of this folder share: options, error messages, exit status."""

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import Any

from visthrow.common.arguments import EXIT_BAD_INPUT, EXIT_INTERRUPTED
from visthrow.common.errors import VisthrowError

Run = Callable[[argparse.Namespace], Any]


def parser_of(about: str | None, record: bool = True) -> argparse.ArgumentParser:
    """A parser that shows a module's docstring, with the options of a record."""
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if record:
        parser.add_argument(
            "--record",
            metavar="NAME",
            help="keep the result in the package's records under this name",
        )
        parser.add_argument(
            "--json", metavar="FILE", help="write the printed figures to this file as well"
        )
    return parser


def main(parser: argparse.ArgumentParser, run: Run, argv: Sequence[str] | None = None) -> int:
    """Run a command; its status, 2 after a mistake of the user, 130 after Ctrl-C."""
    args = parser.parse_args(argv)
    try:
        return int(run(args) or 0)
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except (VisthrowError, ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT

"""The command line. Each command has a module, which is imported only if the command is chosen, so
that ``visthrow --help`` is fast.

``hil`` and ``diagnose`` have command lines of their own.
"""

import argparse
import gc
import os
import sys
from collections.abc import Sequence

from visthrow import __version__
from visthrow.common.arguments import (
    EXIT_BAD_INPUT,
    EXIT_INTERRUPTED,
    add_commands,
    complete,
    run_command,
)
from visthrow.common.errors import VisthrowError
from visthrow.common.extras import missing_package
from visthrow.common.toml_text import tables_beside

_TABLES = tables_beside(__file__, "commands.toml")

COMMANDS: dict[str, tuple[str, str]] = _TABLES["commands"]
"""Name -> help and module."""

TRACEBACK_VARIABLE = "VISTHROW_TRACEBACK"

GC_THRESHOLD = 50_000
"""Number of new objects that starts a garbage collection. At Python's default of 700, collections
take an eighth of the import time of a command and free nothing, because modules stay.
"""

_DESCRIPTION = """\
Train, compare and fly policies that throw a ball hanging on a rope below a quadrotor onto a target.
"""

_EPILOG = """\
examples:
  visthrow demo                                  a first look: one throw, a picture, a table
  visthrow train state --device cuda             train the policy that sees true positions
  visthrow fly --target 2.0                      one throw at a target 2 m away
  visthrow compare --json out/table.json         state against vision over many throws
  visthrow config vehicle paper                  the values of the simulated vehicle

'visthrow COMMAND --help' describes a command.
Set VISTHROW_TRACEBACK=1 to see where an error came from.
"""


def build_parser() -> argparse.ArgumentParser:
    """Build the parser, which imports only the chosen command's module for its arguments."""
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        "visthrow", description=_DESCRIPTION, epilog=_EPILOG, formatter_class=form
    )
    parser.add_argument("--version", action="version", version=f"visthrow {__version__}")
    add_commands(parser, COMMANDS, "command", title="commands")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status.

    Returns the command's status; 2 for a mistake of the user, reported in one message; 130 after
    Ctrl-C."""
    gc.set_threshold(GC_THRESHOLD)
    try:
        parser = build_parser()
        complete(parser)
        args = parser.parse_args(argv)
        status = run_command(COMMANDS, args.command, args)
        sys.stdout.flush()  # raises BrokenPipeError here, not when Python ends
        return status
    except KeyboardInterrupt:
        print("visthrow: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:  # the reader of our output has ended, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except ModuleNotFoundError as error:
        if hider := _find_hiding_file(error):
            return _refuse(
                f"{hider} hides visthrow's own package of that name; rename it, or run the command"
                " from another folder"
            )
        if error.name == "mujoco.batch":
            return _refuse(
                "the package 'mujoco' here has no mujoco.batch, which mujoco-core 4 brings: MuJoCo"
                " 3, which another package here asks for, was installed over it; install"
                " 'visthrow[reference]' in an environment of its own"
            )
        extra = _TABLES["extras"].get((error.name or "").partition(".")[0])
        if extra is None:
            raise
        return _refuse(
            f"this needs the package '{missing_package(error)}'; install it with: pip install"
            f" 'visthrow[{extra}]'"
        )
    except (VisthrowError, ValueError, OSError) as error:
        if os.environ.get(TRACEBACK_VARIABLE):
            raise
        return _refuse(str(error) or type(error).__name__)


def _find_hiding_file(error: ModuleNotFoundError) -> str | None:
    """Return the file of another module that shadows one of this project, such as a ``camera.py``
    in the working folder; None if there is none.
    """
    name = (error.name or "").partition(".")[0]
    module = sys.modules.get(name)
    root = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    place = getattr(module, "__file__", None)
    if (
        name not in ("camera", "sim", "hil")
        or place is None
        or os.path.abspath(place).startswith(os.path.join(root, name))
    ):
        return None
    return str(place)


def _refuse(message: str) -> int:
    print(f"visthrow: error: {message}", file=sys.stderr)
    return EXIT_BAD_INPUT

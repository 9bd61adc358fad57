"""Commands and the options that they share, the exit status of a process, and how it is asked to
stop.
"""

import argparse
import contextlib
import importlib
import math
import os
import signal
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from visthrow.common.errors import suggest

Commands = Mapping[str, tuple[str, str]]
"""Name -> (help, module).

The module has ``add_arguments(parser)`` and ``run(args) -> int``; it is imported only when chosen.
"""

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130


def checked(kind: type, good: Callable[[float], bool], expected: str) -> Callable[[str], float]:
    """Return what reads a number of the command line that must be good."""

    def parse(text: str) -> float:
        with contextlib.suppress(ValueError):
            if good(value := kind(text)):
                return value
        raise argparse.ArgumentTypeError(f"'{text}'; expected {expected}")

    return parse


NUMBER = checked(float, math.isfinite, "a finite number")
ABOVE_ZERO = checked(float, lambda x: 0.0 < x < math.inf, "a number above 0")
WHOLE = checked(int, lambda x: x >= 0, "a whole number of 0 or more")
PORT = checked(int, lambda x: 0 < x < 65536, "a port, 1 to 65535")


def add_common(parser: argparse.ArgumentParser, *, device: bool = True, json: bool = True) -> None:
    """Add the options that commands share:

    ``--set``, ``--device`` (see ``visthrow.training.compute_device.resolve``) and ``--json``.
    """
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help=(
            "change one value of the configuration, for instance --set vehicle.body.mass=0.25; may"
            " be repeated"
        ),
    )
    if device:
        parser.add_argument(
            "--device",
            default="auto",
            metavar="NAME",
            help="auto, cpu, cuda or cuda:1 (default: a GPU if there is one)",
        )
    if json:
        parser.add_argument(
            "--json", metavar="FILE", help="write the printed figures to this file as well"
        )


SOLVER: Mapping[str, Any] = {
    "dest": "overrides",
    "action": "append",
    "default": [],
    "type": "sim.solver={}".format,
    "metavar": "NAME",
    "help": "physics engine of vehicle and rope (sim.solver)",
}
"""Option of a command that flies the training simulator."""


def add_out(parser: argparse.ArgumentParser, default: str, what: str) -> None:
    """Add ``--out``: the folder of what a command writes."""
    parser.add_argument(
        "--out", default=default, metavar="FOLDER", help=f"{what} (default: {default})"
    )


def add_conditions(parser: argparse.ArgumentParser, whose: str) -> None:
    """Add what throws are flown under: ``--plant``, ``--seed``, ``--config``, ``--allow``."""
    add = parser.add_argument
    add(
        "--plant",
        default="hybrid",
        metavar="NAME",
        help="hybrid (the training simulator, the default), reference, or reference-realistic",
    )
    add("--seed", type=WHOLE, default=0, help="seed of starts, noise and plant (default: 0)")
    add("--config", metavar="NAME", help=f"fly in this train config instead of {whose} own")
    allow = (
        "permit this difference from the conditions of the policy's training (vehicle,"
        " rope.length); may be repeated"
    )
    add("--allow", action="append", default=[], metavar="KEY", help=allow)
    add("--solver", **SOLVER)


def add_commands(
    parser: argparse.ArgumentParser, commands: Commands, dest: str, **group: Any
) -> None:
    """Add commands, of which one must be chosen; its name goes to ``args.<dest>``."""
    choices = parser.add_subparsers(
        dest=dest, metavar=dest.upper(), required=True, parser_class=_Lazy, **group
    )
    form = argparse.RawDescriptionHelpFormatter
    for name, (text, module) in commands.items():
        description = text[0].upper() + text[1:] + "."
        choices.add_parser(
            name, module=module, help=text, description=description, formatter_class=form
        )


def complete(parser: argparse.ArgumentParser) -> None:
    """Answer a shell that asks for completions and exit; return at once where none asks.

    The words of the line choose the commands whose arguments are loaded.
    """
    line = os.environ.get("COMP_LINE")
    if "_ARGCOMPLETE" not in os.environ or line is None:
        return
    import argcomplete

    chosen = parser
    for word in line.split()[1:]:
        parsers = chosen._subparsers._group_actions[0].choices if chosen._subparsers else {}
        if word in parsers:
            chosen = parsers[word]
            if isinstance(chosen, _Lazy):
                chosen.add_module_arguments()
    argcomplete.autocomplete(parser)


def run_command(commands: Commands, name: str, args: argparse.Namespace) -> int:
    """Run the chosen command; returns its exit status.

    Raises StorageError where ``--json`` could not be written, before the work.
    """
    if getattr(args, "json", None):
        from visthrow.common.storage import check_place

        check_place(args.json)
    return int(importlib.import_module(commands[name][1]).run(args) or 0)


class _Lazy(argparse.ArgumentParser):
    """Asks its module for the arguments only when it is the chosen one."""

    def __init__(self, *args: Any, module: str | None = None, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._module = module

    def add_module_arguments(self) -> None:
        """Add the arguments of the module, once."""
        if self._module is not None:
            module = self._module
            self._module = None
            importlib.import_module(module).add_arguments(self)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        self.add_module_arguments()
        namespace_out, unknown = super().parse_known_args(args, namespace)
        # else the command's own parser would say it, without its options
        if unknown and self._subparsers is None:
            options = [option for option in self._option_string_actions if option.startswith("--")]
            if unknown[0].startswith("-"):
                hint = f"; {suggest(unknown[0].split('=')[0], options)}"
            else:
                hint = ""
            self.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
        return namespace_out, unknown


class StopRequest:
    """Signals taken down, ``asked``, while it is entered, so that no piece of work is cut in two; a
    second one interrupts.

    An interrupt that is raised anywhere is lost where it meets a destructor: Python prints it and
    goes on. Threads beside the main one hear no signals."""

    def __init__(self, signals: Sequence[int], message: str = "") -> None:
        """Begin; ``message``: what the first one is answered on the terminal."""
        self.asked = False
        self._said = message
        self._signals = signals if threading.current_thread() is threading.main_thread() else ()

    def __enter__(self) -> "StopRequest":
        self._before = {number: signal.signal(number, self._take) for number in self._signals}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _take(self, number: int, frame: object) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        if self._said:
            print(self._said, file=sys.stderr)

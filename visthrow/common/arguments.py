"""Commands and their shared options, exit statuses, and requests to stop."""

import argparse
import contextlib
import importlib
import math
import os
import signal
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from visthrow.common.errors import suggest
from visthrow.common.toml_text import tables_beside

Commands = Mapping[str, tuple[str, str]]
"""Name -> (help, module).

The module has ``add_arguments(parser)`` and ``run(args) -> int``. It is imported only if its
command is chosen.
"""

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130


def make_number_parser(
    kind: type, good: Callable[[float], bool], expected: str
) -> Callable[[str], float]:
    """Return a parser of numbers that refuses those for which ``good`` is false; ``expected``: a
    description of valid numbers for the message.
    """

    def parse(text: str) -> float:
        with contextlib.suppress(ValueError):
            if good(value := kind(text)):
                return value
        raise argparse.ArgumentTypeError(f"'{text}'; expected {expected}")

    return parse


ABOVE_ZERO = make_number_parser(float, lambda x: 0.0 < x < math.inf, "a number above 0")
WHOLE = make_number_parser(int, lambda x: x >= 0, "a whole number of 0 or more")

TYPES: Mapping[str, Callable[[str], Any]] = {
    "number": make_number_parser(float, math.isfinite, "a finite number"),
    "above zero": ABOVE_ZERO,
    "distance": make_number_parser(float, lambda x: 0.0 <= x <= 3.0, "a distance from 0 to 3 m"),
    "whole": WHOLE,
    "count": make_number_parser(int, lambda x: x > 0, "a whole number of 1 or more"),
    "port": make_number_parser(int, lambda x: 0 < x < 65536, "a port, 1 to 65535"),
    "int": int,
    "float": float,
    "names": lambda text: text.split(","),
    "solver": "sim.solver={}".format,
}
"""Name in tables of arguments -> parser of a word of the command line."""

SHARED: Mapping[str, Mapping[str, Any]] = tables_beside(__file__, "data/arguments.toml")
"""Shared option -> argparse's keywords."""


def add_option(
    parser: argparse.ArgumentParser, name: str, shared: bool = False, **values: Any
) -> None:
    """Add an argument; ``shared``: that of this name in :data:`SHARED`, with ``values``
    replaced.
    """
    if shared:
        values = {**SHARED[name], **values}
    reader = values.get("type")
    if isinstance(reader, str):
        values["type"] = TYPES[reader]
    parser.add_argument(name, **values)


def add_table(table: Mapping[str, Any], parser: argparse.ArgumentParser) -> None:
    """Add the arguments, actions and defaults of a table of ``commands.toml``.

    Keys of the table: ``epilog``, ``arguments`` (name -> keywords of :func:`add_option`),
    ``actions`` (name -> a table of the same form with ``help``), ``dest`` of the chosen action,
    ``defaults``.
    """
    parser.epilog = table.get("epilog", parser.epilog)
    for name, values in table.get("arguments", {}).items():
        add_option(parser, name, **values)
    parser.set_defaults(**table.get("defaults", {}))
    if "actions" in table:
        dest = table.get("dest", "action")
        actions = parser.add_subparsers(dest=dest, metavar="ACTION", required=True)
        form = argparse.RawDescriptionHelpFormatter
        for name, action in table["actions"].items():
            texts = {key: action[key] for key in ("help", "description") if key in action}
            add_table(action, actions.add_parser(name, formatter_class=form, **texts))


def declare(*modules: str) -> Callable[[argparse.ArgumentParser], None]:
    """Return a command's ``add_arguments``, which adds the table of each module: the table with the
    module's name in ``commands.toml`` in its folder.
    """
    tables = [tables_beside(module, "commands.toml")[Path(module).stem] for module in modules]

    def add_all(parser: argparse.ArgumentParser) -> None:
        for table in tables:
            add_table(table, parser)

    return add_all


def add_commands(
    parser: argparse.ArgumentParser, commands: Commands, dest: str, **group: Any
) -> None:
    """Add commands, one of which is required; its name is stored in ``args.<dest>``."""
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
    """Print completions and exit if a shell requests them; otherwise return at once.

    Arguments are loaded only for the commands on the line.
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
    """Run the chosen command and return its exit status.

    Raises StorageError: the file of ``--json`` cannot be written; checked before the work.
    """
    if getattr(args, "json", None):
        from visthrow.common.storage import check_place

        check_place(args.json)
    return int(importlib.import_module(commands[name][1]).run(args) or 0)


class _Lazy(argparse.ArgumentParser):
    """A parser that loads its module's arguments only if its command is chosen."""

    def __init__(self, *args: Any, module: str | None = None, **kwargs: Any):
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
        # otherwise the main parser would report them, without this command's options
        if unknown and self._subparsers is None:
            options = [option for option in self._option_string_actions if option.startswith("--")]
            if unknown[0].startswith("-"):
                hint = f"; {suggest(unknown[0].split('=')[0], options)}"
            else:
                hint = ""
            self.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
        return namespace_out, unknown


class StopRequest:
    """A context manager that records a signal in ``asked`` instead of interrupting a piece of work;
    a second signal raises KeyboardInterrupt.

    A KeyboardInterrupt inside a destructor would be lost: Python prints it and continues. Threads
    other than the main one receive no signals."""

    def __init__(self, signals: Sequence[int], message: str = ""):
        """Prepare for these signals; ``message``: printed on the first one."""
        self.asked = False
        self._message = message
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
        if self._message:
            print(self._message, file=sys.stderr)

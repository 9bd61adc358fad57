"""The main commands as Python functions. Each option of a command is a keyword of its function.

``visthrow train laptop --minutes 5 --set rope.length=0.4`` is
``visthrow.train("laptop", minutes=5, set={"rope.length": 0.4})``. Names, defaults and errors are
those of the command line; errors are :class:`visthrow.common.errors.VisthrowError`.
"""

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from visthrow.logs.flightlog import FlightLog
    from visthrow.onboard.policy import Policy

REPEATED = ("set", "allow", "export")
"""Options that may be repeated, with one value each."""


def train(config: str | Path, *, out: str | Path, **options: Any) -> "Policy":
    """Train a policy and return it; ``out`` is the folder of the run."""
    from visthrow.onboard.policy import Policy

    _run("train", [config], {"out": out, **options})
    return Policy.load(Path(out) / "policy.npz")


def fly(
    policy: str | Path = "vision", *, out: str | Path = "out/fly", **options: Any
) -> "FlightLog":
    """Fly one throw and return its log; ``out`` is the folder of the files."""
    from visthrow.logs.flightlog import FlightLog

    _run("fly", [], {"policy": policy, "out": out, **options})
    return FlightLog.load(Path(out) / "flight.npz")


def compare(*policies: str | Path, **options: Any) -> dict[str, Any]:
    """Throw many times with each policy and return the figures of ``--json``."""
    return _run_json("compare", list(policies), options)


def diagnose(*logs: str | Path, **options: Any) -> dict[str, Any]:
    """Find the effects that explain flights and return the figures of ``--json``."""
    return _run_json("diagnose", ["explain", *logs], options)


def _run_json(command: str, words: list[Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """Run a command and return its figures."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "figures.json"
        _run(command, words, {**options, "json": path})
        figures: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return figures


def _run(command: str, words: list[Any], options: Mapping[str, Any]) -> int:
    """Run a command of the command line and return its status.

    Raises VisthrowError: the command reports a mistake, or an option is unknown."""
    from visthrow import cli
    from visthrow.common.arguments import run_command
    from visthrow.common.errors import VisthrowError

    argv = [command, *map(str, words)]
    for name, value in options.items():
        argv += _words(f"--{name.replace('_', '-')}", value, name in REPEATED)
    try:
        args = cli.build_parser().parse_args(argv)
    except SystemExit as error:
        raise VisthrowError(f"visthrow {' '.join(argv)}: not a valid command") from error
    return run_command(cli.COMMANDS, command, args)


def _words(option: str, value: Any, repeated: bool) -> list[str]:
    """Return the words of one option. True is a flag; False or None omits the option."""
    if value is None or value is False:
        return []
    if value is True:
        return [option]
    if isinstance(value, Mapping):
        value = [f"{key}={item}" for key, item in value.items()]
    values = [value] if isinstance(value, (str, Path, int, float)) else list(value)
    if not repeated:
        return [option, *map(str, values)]
    return [word for item in values for word in (option, str(item))]

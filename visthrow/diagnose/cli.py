"""``visthrow diagnose``: from measured flights to what the simulation gets wrong. Each action is imported when chosen."""

import argparse
import importlib
from typing import Any

ACTIONS = {
    "check": ("look at logs: clocks, units, frames, gaps, what is excited, what they can answer", "visthrow.diagnose.inputs.check_cli"),
    "map": ("propose how a foreign table's columns are read, and ask what it cannot know", "visthrow.diagnose.inputs.map_cli"),
    "explain": ("say what the simulation gets wrong about flights, and what that is worth", "visthrow.diagnose.reporting.explain_cli"),
    "apply": ("write the configuration that a diagnosis asks for, ready to train in", "visthrow.diagnose.extend.apply_cli"),
    "fit": ("make the first configuration of your own vehicle or motor, from flights without payload", "visthrow.diagnose.inputs.fit_cli"),
    "plan": ("propose the manoeuvre that separates what could not be separated", "visthrow.diagnose.reporting.plan_cli"),
    "blind": ("hide effects in your own noise: which sizes would be named", "visthrow.diagnose.reporting.blind_cli"),
}
"""Name -> (help, module). The module has ``add_arguments(parser)`` and ``run(args) -> int``."""


class _LazyParser(argparse.ArgumentParser):
    """Asks its module for the arguments only when it is the chosen one."""

    def __init__(self, *args: Any, module: str, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._module: str | None = module

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """See the base class."""
        if self._module is not None:
            module, self._module = self._module, None
            importlib.import_module(module).add_arguments(self)
        return super().parse_known_args(args, namespace)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the actions of the command."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True, parser_class=_LazyParser)
    form = argparse.RawDescriptionHelpFormatter
    for name, (text, module) in ACTIONS.items():
        about = text[0].upper() + text[1:] + "."
        actions.add_parser(name, module=module, help=text, description=about, formatter_class=form)


def run(args: argparse.Namespace) -> int:
    """Do what was asked."""
    return int(importlib.import_module(ACTIONS[args.action][1]).run(args) or 0)

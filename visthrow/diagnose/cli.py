"""``visthrow diagnose``: from measured flights to what the simulation gets wrong.

Each action is imported when chosen.
"""

import argparse

from visthrow.common.arguments import add_commands, run_command

ACTIONS = {
    "check": (
        "check logs: clocks, units, frames, gaps, excitation, and what they can answer",
        "visthrow.diagnose.reporting.check_cli",
    ),
    "map": (
        "propose a mapping for the columns of a table, and ask for what it cannot infer",
        "visthrow.diagnose.inputs.map_cli",
    ),
    "explain": (
        "find what the simulation gets wrong about flights, and how much it matters",
        "visthrow.diagnose.reporting.explain_cli",
    ),
    "apply": (
        "write the corrected configuration of a diagnosis, ready for training",
        "visthrow.diagnose.extend.apply_cli",
    ),
    "fit": (
        "make the first configuration of your own vehicle or motor, from flights without payload",
        "visthrow.diagnose.inputs.fit_cli",
    ),
    "plan": (
        "propose the next flight: the one expected to give the most evidence",
        "visthrow.diagnose.reporting.plan_cli",
    ),
    "blind": (
        "hide effects in your own noise, and report which sizes would be named",
        "visthrow.diagnose.reporting.blind_cli",
    ),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the actions of the command."""
    add_commands(parser, ACTIONS, "action")


def run(args: argparse.Namespace) -> int:
    """Do what was asked."""
    return run_command(ACTIONS, args.action, args)

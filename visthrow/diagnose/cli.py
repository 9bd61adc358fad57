"""``visthrow diagnose``: from measured flights to what the simulation gets wrong.

Each action is imported when chosen.
"""

import argparse

from visthrow.common.arguments import add_commands, run_command

ACTIONS = {
    "check": (
        "look at logs: clocks, units, frames, gaps, what is excited, what they can answer",
        "visthrow.diagnose.inputs.check_cli",
    ),
    "map": (
        "propose how a foreign table's columns are read, and ask what it cannot know",
        "visthrow.diagnose.inputs.map_cli",
    ),
    "explain": (
        "say what the simulation gets wrong about flights, and what that is worth",
        "visthrow.diagnose.reporting.explain_cli",
    ),
    "apply": (
        "write the configuration that a diagnosis asks for, ready to train in",
        "visthrow.diagnose.extend.apply_cli",
    ),
    "fit": (
        "make the first configuration of your own vehicle or motor, from flights without payload",
        "visthrow.diagnose.inputs.fit_cli",
    ),
    "plan": (
        "find the flight that tells most of what could not be told",
        "visthrow.diagnose.reporting.plan_cli",
    ),
    "blind": (
        "hide effects in your own noise: which sizes would be named",
        "visthrow.diagnose.reporting.blind_cli",
    ),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the actions of the command."""
    add_commands(parser, ACTIONS, "action")


def run(args: argparse.Namespace) -> int:
    """Do what was asked."""
    return run_command(ACTIONS, args.action, args)

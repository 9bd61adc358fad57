"""``visthrow bench``: how long training takes here; what was measured before. Each action is imported when chosen."""

import argparse

from visthrow.common.arguments import add_commands, run_command

ACTIONS = {
    "train": ("where the wall time of a training goes: in an iteration, or to an error", "visthrow.evidence.bench.iteration"),
    "records": ("print the recorded measurements as Markdown", "visthrow.evidence.bench.records"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the actions of the command."""
    parser.epilog = (
        "examples:\n"
        "  visthrow bench train state --device cuda       simulation, environment, inference and learning\n"
        "  visthrow bench train laptop --until 0.06 0.04  seconds of a whole training to these errors, over seeds\n"
        "  visthrow bench records                         what was measured before, on which machine and commit\n"
    )
    add_commands(parser, ACTIONS, "bench")


def run(args: argparse.Namespace) -> int:
    """Measure, or print what was measured."""
    return run_command(ACTIONS, args.bench, args)

"""``visthrow hil run``, ``record`` and ``calibrate``: fly, or run dry, by a configuration."""

import argparse

from hil.commands import add_source_options, examples


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of an action, which is the last word of the parser's program."""
    action = parser.prog.split()[-1]
    parser.epilog = examples(action)
    add_source_options(parser)
    add = parser.add_argument
    add("--out", metavar="FOLDER", help="of the run (default: a new one in runs/hil)")
    add("--view", action="store_true", help="serve a live view to this machine's browser")
    bare = "leave out flight logs and pictures; `hil view` makes them later"
    add("--bare", action="store_true", help=bare)
    if action == "run":
        write = "set the autopilot's parameters that the audit finds wrong"
        add("--write-parameters", action="store_true", help=write)
        arm = "arm whenever ready; for `visthrow hil fake` alone"
        add("--auto-arm", action="store_true", help=arm)


def run(args: argparse.Namespace) -> int:
    """Fly, or run dry, and return the exit status."""
    from hil import fly_run

    return fly_run.fly(args)

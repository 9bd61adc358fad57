"""Actions of ``visthrow hil`` and their options; the module of an action is imported when it
runs.
"""

import argparse
from pkgutil import resolve_name

from visthrow.common.arguments import add_table
from visthrow.common.toml_text import tables_beside

TABLES = tables_beside(__file__, "commands.toml")
"""Groups of arguments; the group of an action has its name."""

FLIES = ("run", "record", "calibrate")

FUNCTIONS = dict.fromkeys(FLIES, "hil.run_command:fly") | {
    "check": "hil.check:check",
    "replay": "hil.control.recording.playback:compare_run",
    "view": "hil.control.recording.view:run",
}
"""Action -> the function that runs it."""

EXAMPLES = """
  visthrow hil run                              dry run: poses on udp port 14560, nothing is sent
  visthrow hil run --config fake --auto-arm     a throw; needs `visthrow hil fake` in a terminal
  visthrow hil run --config mine.toml --out runs/first
  visthrow hil record --config mine.toml --seconds 60
  visthrow hil calibrate --config mine.toml     estimate the camera's tilt in a hover
  visthrow hil replay runs/first                check that the policy repeats its actions
  visthrow hil view runs/first                  a recording, a picture and a log of each throw
  visthrow hil check --seconds 5                rate and age of incoming poses, and the checks
  visthrow hil check --hand-carry               carry the vehicle by hand to check its axes
  visthrow hil fake --seconds 60                flies for `visthrow hil run --config fake`
"""

DURING = """

During a run, type 'arm' (one throw), 'land' or 'abort' and Enter.
Ctrl-C, SIGTERM and SIGHUP abort.
"""


def examples(action: str = "") -> str:
    """Return the examples of an action, or of all."""
    lines = [line for line in EXAMPLES.splitlines() if line.startswith(f"  visthrow hil {action}")]
    return "\n".join(["examples:", *lines]) + (DURING if action in ("", *FLIES) else "")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of an action, which is the last word of the parser's program."""
    action = parser.prog.split()[-1]
    groups = [action]
    if action in FLIES:
        groups = ["source", "flight", action]
    elif action == "check":
        groups = ["source", action]
    for group in groups:
        if group in TABLES:
            add_table(TABLES[group], parser)
    parser.epilog = examples(action)


def run(args: argparse.Namespace) -> int:
    """Run the chosen action and return the exit status."""
    return resolve_name(FUNCTIONS[args.action])(args)

"""``visthrow train``: train a policy, from scratch or from another, with progress, evaluation,
checkpoints, resume.
"""

import argparse
from dataclasses import fields

from visthrow.common.arguments import ABOVE_ZERO, SOLVER, WHOLE, add_common

EXAMPLES = """\
examples:
  visthrow train laptop                          a state policy on the cores of a laptop
  visthrow train laptop --until 0.04             stop once throws at 2.0 m land 4 cm off on average
  visthrow train mine.toml --from state          adapt the shipped policy to a vehicle of your own
  visthrow train vision --seed 2 --out runs/v2   another seed, in a folder of its own
  visthrow train --resume --out runs/v2          go on where an interrupted run stopped
  torchrun --nproc-per-node 2 -m visthrow.cli train state   on two GPUs
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = EXAMPLES
    add = parser.add_argument
    names = (
        "a name of configs/train (state, vision, vision_located, laptop, laptop_vision, paper, ...)"
        " or a TOML file of your own"
    )
    add("config", metavar="CONFIG", nargs="?", help=f"{names}; a resumed run has it in its folder")
    add("--seed", type=WHOLE, help="of everything random (default: 1, or that of the resumed run)")
    add("--out", metavar="FOLDER", help="folder of the run (default: runs/CONFIG-SEED)")
    add(
        "--from",
        dest="start",
        metavar="POLICY",
        help=(
            "start from this policy, a shipped name or a file, with the short schedule of"
            " configs/ppo/adapt.toml"
        ),
    )
    add(
        "--iterations",
        type=int,
        metavar="N",
        help="stop after iteration N (default: the configuration's last)",
    )
    add("--minutes", type=ABOVE_ZERO, metavar="T", help="stop after this time [min]")
    add(
        "--until",
        type=ABOVE_ZERO,
        metavar="ERROR",
        help="stop once the mean landing error at 2.0 m is below this [m]",
    )
    add(
        "--evaluate-every",
        type=int,
        metavar="N",
        help=(
            "throw 200 times every N iterations (default: a twentieth of the time on a terminal,"
            " and with --until)"
        ),
    )
    add(
        "--checkpoint-every",
        type=int,
        metavar="N",
        help="iterations between checkpoints (default: a hundredth of the time)",
    )
    add("--resume", action="store_true", help="continue from the folder's checkpoint")
    add("--solver", **SOLVER)
    add_common(parser)


def run(args: argparse.Namespace) -> int:
    """Train."""
    from visthrow.training import session

    options = session.Options(
        **{item.name: getattr(args, item.name) for item in fields(session.Options)}
    )
    return session.run(options)

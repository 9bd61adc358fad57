"""Adaptation of the shipped state policy to altered vehicles: landing error before and after a
short training from it.

The alterations are the effects of the committed loops. Each increases the policy's mean error over
that on its original vehicle; the table shows the share of this increase that the training removes.
All throws are flown in the training simulator, with all noise, from the same seed. Results in the
folder are reused.

    python -m bench.adaptation --device cuda
    python -m bench.adaptation --device cpu --seconds 120 --only release_lag
"""

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench import loop, start
from bench import report as records
from visthrow.common import compute_device, statistics
from visthrow.common.storage import write_json
from visthrow.diagnose.apply.patch import extend
from visthrow.onboard.policy import Policy, find_policy
from visthrow.task import Experiment, contract_of, load_experiment
from visthrow.training.protocol import throw
from visthrow.training.trainer import ADAPTATION, Trainer, adopt_layers

TARGET = 2.0
THROWS = 1000
SEED = 12345
STAGES = ("home", "before", "after")


def adapt(
    experiment: Experiment, policy: Policy, args: argparse.Namespace
) -> tuple[Policy, dict[str, float]]:
    """The policy after a full training, or one cut at ``--seconds``; its seconds without the
    set-up, and its iterations.
    """
    trainer = Trainer(adopt_layers(experiment, policy), args.device, args.seed)
    spent = 0.0
    trainer.algorithm.take_up(policy)
    while trainer.iteration < trainer.algorithm.iterations and spent < args.seconds:
        begin = time.perf_counter()
        trainer.step()
        spent += time.perf_counter() - begin
    return trainer.algorithm.export(contract_of(experiment), {}), {
        "seconds": spent,
        "iterations": trainer.iteration,
    }


def measure_errors(
    folder: Path, hidden: Mapping[str, float], args: argparse.Namespace
) -> dict[str, Any]:
    """Errors of one alteration."""
    kept = folder / "errors.json"
    if kept.exists():
        return json.loads(kept.read_text())
    nominal = load_experiment("state", [ADAPTATION, *args.changes])
    shipped = Policy.load(find_policy("state"))
    altered = extend(nominal, hidden)
    policy, figures = adapt(altered, shipped, args)
    errors = {"hidden": dict(hidden), **figures}
    for stage, experiment, thrower in zip(
        STAGES, (nominal, altered, altered), (shipped, shipped, policy), strict=True
    ):
        throws = throw(
            experiment, thrower.to(args.device).actor(THROWS), TARGET, THROWS, args.device, SEED
        )
        errors[stage] = throws.error[throws.success].round(5).tolist()
    write_json(kept, errors)
    return errors


def report(records_of: Sequence[Mapping[str, Any]], where: str) -> records.Report:
    """Table of the alterations."""
    rows = []
    figures = []
    for f in records_of:
        errors = {stage: 1e3 * np.array(f[stage]) for stage in STAGES}
        mean = {stage: float(e.mean()) for stage, e in errors.items()}
        won = (mean["before"] - mean["after"]) / (mean["before"] - mean["home"])
        cells = [statistics.mean(errors[stage]).text(1) for stage in STAGES]
        rows.append(
            (
                loop.describe_hidden(f),
                *cells,
                f"{100 * won:.0f} %",
                str(f["iterations"]),
                f"{f['seconds']:.1f} s",
            )
        )
        outcome = {
            "error_mm": mean,
            "landed": {stage: len(e) for stage, e in errors.items()},
            "won_back": won,
        }
        figures.append({k: v for k, v in f.items() if k not in STAGES} | outcome)
    header = (
        "altered",
        "own vehicle [mm]",
        "before [mm]",
        "after [mm]",
        "won back",
        "iterations",
        "training",
    )
    table = records.Table("Adaptation of the shipped state policy", header, tuple(rows))
    notes = (
        (
            f"Mean landing error of {THROWS} throws from hover at {TARGET} m with all noise, 95 %"
            " intervals; seconds of rollouts and learning."
        ),
    )
    return records.Report(
        "train",
        f"Adaptation on {records.device_name(where)}",
        (table,),
        notes,
        {"effects": figures},
    )


def run(args: argparse.Namespace) -> int:
    """Measure every alteration and report."""
    args.device = compute_device.resolve(args.device)
    alterations = []
    for hidden in [record["hidden"] for record in loop.read()]:
        if not args.only or set(hidden) & set(args.only):
            alterations.append(
                measure_errors(
                    Path(args.out) / "-".join(f"{n}_{v:g}" for n, v in hidden.items()), hidden, args
                )
            )
    return records.finish(report(alterations, args.device), args)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = start.parser_of(__doc__)
    parser.add_argument("--only", nargs="*", metavar="EFFECT", help="of those (default: all)")
    parser.add_argument(
        "--out", default="runs/adaptation", metavar="FOLDER", help="(default: runs/adaptation)"
    )
    parser.add_argument(
        "--seconds", type=float, default=10.0, help="of an adaptation, at most (default: 10)"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--device", default="auto", metavar="NAME")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="changes",
        metavar="KEY=VALUE",
        help="in the adaptations",
    )
    return start.main(parser, run, argv)


if __name__ == "__main__":
    sys.exit(main())

"""Adaptation of a shipped policy to altered vehicles: landing error before, after a short training from it, and of one from scratch.

The alterations are the effects of the committed loops. What an alteration costs is the shipped policy's mean error there beyond
that of a policy trained for it; the share of it that the short training wins back is the figure. All three throw the same
throws of the training's simulator, with all noise. What is in the folder is not done again.

    python -m tests.bench.adaptation --device cuda       on the card
    python -m tests.bench.adaptation --device cpu --seconds 120 --stages before after
"""

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tests.bench import loop, start
from visthrow import config
from visthrow.common import statistics
from visthrow.common.storage import write_json
from visthrow.diagnose.extend.patch import extended
from visthrow.evidence.bench import records
from visthrow.onboard.policy import Policy, find_policy
from visthrow.task import Experiment, contract_of
from visthrow.training import device
from visthrow.training.protocol import throw
from visthrow.training.trainer import ADAPTATION, Trainer, fitted

TARGET, THROWS, SEED = 2.0, 1000, 12345
STAGES = ("before", "after", "scratch")


def thrown(experiment: Experiment, policy: Policy, where: str) -> list[float]:
    """Landing errors [m]; of a throw that did not come down there is none."""
    throws = throw(experiment, policy.to(where).actor(THROWS), TARGET, THROWS, where, SEED)
    return throws.error[throws.success].round(5).tolist()


def trained(experiment: Experiment, where: str, seed: int, policy: Policy | None = None, limit: float = np.inf) -> tuple[Policy, float, int]:
    """Policy of a training in full, or until ``limit`` [s]; its seconds, building left out, and its iterations."""
    trainer, spent = Trainer(experiment, where, seed), 0.0
    if policy is not None:
        trainer.take_up(policy)
    while trainer.iteration < trainer.algorithm.iterations and spent < limit:
        begin = time.perf_counter()
        trainer.step()
        spent += time.perf_counter() - begin
    return trainer.algorithm.export(contract_of(experiment), {}), spent, trainer.iteration


def measured(folder: Path, hidden: Mapping[str, float], args: argparse.Namespace) -> dict[str, Any]:
    """Errors of one alteration; what the folder holds of them is taken from there."""
    shipped, kept = Policy.load(find_policy("state")), folder / "errors.json"
    found = json.loads(kept.read_text()) if kept.exists() else {"hidden": dict(hidden)}

    def scratch() -> list[float]:
        experiment = extended(config.load(Experiment, config.find("train", args.scratch)), hidden)
        return thrown(experiment, trained(experiment, args.device, args.seed)[0], args.device)

    def after() -> list[float]:
        alone = config.load(Experiment, config.find("train", "state"), [ADAPTATION, *args.changes])
        experiment = fitted(extended(alone, hidden), shipped)
        policy, found["seconds"], found["iterations"] = trained(experiment, args.device, args.seed, shipped, args.seconds)
        return thrown(experiment, policy, args.device)

    def before() -> list[float]:
        return thrown(extended(config.load(Experiment, config.find("train", "state")), hidden), shipped, args.device)

    for stage in (before, after, scratch):
        if stage.__name__ in args.stages and stage.__name__ not in found:
            found[stage.__name__] = stage()
            write_json(kept, found)
            print(f"{loop.hidden_text(found)}: {stage.__name__} {np.mean(found[stage.__name__]):.4f} m", flush=True)
    return found


def report(found: Sequence[Mapping[str, Any]], where: str) -> records.Report:
    """Table of the alterations."""
    rows, figures = [], []
    for f in found:
        errors = {stage: 1e3 * np.array(f[stage]) for stage in STAGES if stage in f}
        told = [statistics.mean(errors[stage]).text(1) if stage in errors else "-" for stage in STAGES]
        mean = {stage: float(e.mean()) for stage, e in errors.items()}
        won = f"{100 * (mean['before'] - mean['after']) / (mean['before'] - mean['scratch']):.0f} %" if len(mean) == len(STAGES) else "-"
        rows.append((loop.hidden_text(f), *told, won, f"{f['seconds']:.1f} s" if "after" in mean else "-"))
        landed = {stage: len(e) for stage, e in errors.items()}
        figures.append({**{k: v for k, v in f.items() if k not in STAGES}, "error_mm": mean, "landed": landed})
    header = ("altered", "before [mm]", "after [mm]", "from scratch [mm]", "won back", "training")
    notes = (
        f"Mean landing error of {THROWS} throws from hover at {TARGET} m with all noise, 95 % intervals; seconds of rollouts and learning.",
    )
    name, table = device.device_name(where), records.Table("Adaptation of the shipped state policy", header, tuple(rows))
    return records.Report("train", f"Adaptation on {name}", (table,), notes, {"effects": figures})


def run(args: argparse.Namespace) -> int:
    """Measure every alteration and report."""
    args.device, effects = device.resolve(args.device), [record["hidden"] for record in loop.read()]
    wanted = [e for e in effects if not args.only or set(e) & set(args.only)]
    found = [measured(Path(args.out) / "-".join(f"{n}_{v:g}" for n, v in e.items()), e, args) for e in wanted]
    return records.finish(report(found, args.device), args)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = start.parser_of(__doc__)
    parser.add_argument("--only", nargs="*", metavar="EFFECT", help="of those (default: all)")
    parser.add_argument("--out", default="runs/adaptation", metavar="FOLDER", help="(default: runs/adaptation)")
    parser.add_argument("--scratch", default="state_fast", metavar="CONFIG", help="of the policies from scratch (default: state_fast)")
    parser.add_argument("--stages", nargs="+", choices=STAGES, default=STAGES, metavar="STAGE", help=f"of {', '.join(STAGES)}")
    parser.add_argument("--seconds", type=float, default=10.0, help="of an adaptation, at most (default: 10)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--device", default="auto", metavar="NAME")
    parser.add_argument("--set", action="append", default=[], dest="changes", metavar="KEY=VALUE", help="in the adaptations")
    return start.main(parser, run, argv)


if __name__ == "__main__":
    sys.exit(main())

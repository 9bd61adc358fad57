"""Train a policy through a solver until a time is up, and keep policies on the way, to be thrown
afterwards."""

import json
import time
from pathlib import Path

from bench import start
from bench.engine import overrides
from visthrow import config
from visthrow.common import provenance
from visthrow.common.storage import write_json
from visthrow.task import Experiment, contract_of
from visthrow.training.trainer import Trainer

FIRST = 4  # iterations after which the pace is known; the first loads kernels
KEPT = 9  # policies on the way


def train(experiment: Experiment, out: Path, seconds: float, device: str, seed: int) -> None:
    """Train for so many seconds at most; schedules follow the iterations that the pace allows.

    Writes ``policy-K.npz``, the last of them as ``policy.npz``, and with each ``training.json``."""
    begin = time.perf_counter()
    trainer, curve, spent = Trainer(experiment, device, seed), [], 0.0
    built = time.perf_counter() - begin
    made_by = {"seed": seed, "config": config.to_dict(experiment, defaults=False)}
    last, kept_at, pace = experiment.iterations, 0.0, None
    while trainer.iteration < last:
        step = time.perf_counter()
        figures = trainer.step()
        now = time.perf_counter()
        step, left = now - step, seconds - (now - begin)
        spent += step
        if trainer.iteration >= FIRST:
            pace = step if pace is None else 0.9 * pace + 0.1 * step
            last = min(experiment.iterations, trainer.iteration + max(0, int(left / pace)))
            trainer.algorithm.iterations = last
        steps = trainer.iteration * trainer.algorithm.samples
        kept = trainer.iteration == last or spent - kept_at > seconds / KEPT
        row = {name: float(figures[name]) for name in ("landing_error", "released", "episodes")}
        curve.append({"seconds": spent, "steps": steps, "kept": kept, **row})
        if kept:
            kept_at = spent
            policy = trainer.algorithm.export(contract_of(experiment), made_by)
            policy.save(out / f"policy-{trainer.iteration}.npz")
            policy.save(out / "policy.npz")
            told = {"built_s": built, "seconds": dict(trainer.seconds), "curve": curve}
            told |= {"solver": experiment.sim.solver, "seed": seed}
            write_json(out / "training.json", {**told, "provenance": provenance.collect()})
        if trainer.iteration % 10 == 0:
            print(json.dumps({"iteration": trainer.iteration, "of": last, **curve[-1]}), flush=True)


def run(args) -> int:
    changes = overrides(args.solver) if args.solver else []
    experiment = config.load(
        Experiment, config.find("train", args.config), [*changes, *args.overrides]
    )
    out = Path(args.out)
    out.mkdir(parents=True, exist_ok=True)
    train(experiment, out, args.seconds, args.device, args.seed)
    return 0


if __name__ == "__main__":
    parser = start.parser_of(__doc__, record=False)
    parser.add_argument("config", help="of configs/train")
    parser.add_argument("--solver", help="default: the config's")
    parser.add_argument("--seconds", type=float, default=900.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--out", required=True)
    raise SystemExit(start.main(parser, run))

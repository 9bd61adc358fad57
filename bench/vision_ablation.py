"""Inputs that a vision policy needs beside keypoints: trainings over fresh seeds, thrown with and
without faults.

Each variant changes the inputs of ``vision`` or its memory; nothing else differs.

    python -m bench.vision_ablation OUT --work runs/ablation    # goes on where it stopped

``OUT`` receives archives of policies, logs and figures, ``OUT/figures.json`` all figures.
"""

import argparse
import json
import random
import subprocess
import sys
import tarfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench import start
from bench.vision_throws import conditions
from visthrow.common.storage import write_json

LOCATED = "task.observation.located"
RESPONSE = "task.observation.response"
SHORT = ("ppo.iterations=509",)  # 2.0e8 environment steps, the paper's number
VARIANTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "memory": ("vision", ()),
    "memory_deep": ("vision", ("distillation.inner=[256,256]",)),
    "keypoints": ("vision_located", (f"{LOCATED}=false", f"{RESPONSE}=0", *SHORT)),
    "both": ("vision_located", SHORT),
    "located": ("vision_located", (f"{RESPONSE}=0", *SHORT)),
    "response": ("vision_located", (f"{LOCATED}=false", *SHORT)),
    "state_averaged": (
        "state_fast",
        (f"{LOCATED}=true", f"{RESPONSE}=8", "task.start.goal_radius=2.5", *SHORT),
    ),
}
"""Variant -> configuration of ``configs/train`` and what it changes."""

SEED = 7
THROWS = 1600
LIMIT = 230.0
"""Longest that a training takes unless stated otherwise [s]; a longer schedule is shortened."""
LEAST = 45.0
RESERVE = 15.0
"""Least remaining time to start a training, and the time reserved for its throws [s]."""


def train(trainer: Any, seconds: float) -> dict[str, Any]:
    """Train to the last iteration, or faster through the schedule so that it ends in time."""
    begin = time.perf_counter()
    planned = trainer.algorithm.iterations
    rows = []
    while True:
        done = max(trainer.iteration / planned, (time.perf_counter() - begin) / seconds)
        if done >= 1.0:
            break
        trainer.algorithm.iterations = trainer.iteration / done if trainer.iteration else planned
        rows.append(trainer.step())
    keys = ("iteration", "landing_error", "released", "value", "rollout_s", "learning_s")
    return {
        "seconds": time.perf_counter() - begin,
        "iterations": trainer.iteration,
        "planned": planned,
        "steps": trainer.iteration * trainer.algorithm.samples,
        "curve": [{key: row.get(key) for key in keys} for row in rows[::10]],
    }


def throw_all(policy: Any, device: str, count: int) -> dict[str, Any]:
    """Throws at all targets, and at one with each fault."""
    from visthrow.throws.loading import training_experiment
    from visthrow.training import protocol

    policy = policy.to(device)
    rows = {}
    layout = policy.contract["observation"]["layout"]
    for name, (target, change) in conditions(layout).items():
        flown = training_experiment(policy, "policy", change)
        throws = protocol.throw(flown, policy.actor(count), target, count, device, SEED)
        rows[name] = throws.summary()
    return rows


def job(args: argparse.Namespace) -> int:
    """Train one variant with one seed, throw, and write the results."""
    from visthrow.task import load_experiment
    from visthrow.training.trainer import Trainer, finish

    name = args.job
    seed = args.seed
    folder = Path(args.work) / f"{args.job}-{args.seed}"
    base, changes = VARIANTS[name]
    limit = min(args.longest, args.deadline - time.time() - RESERVE)
    experiment = load_experiment(base, [*changes, *args.overrides])
    folder.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(experiment, args.devices[0], seed)
    figures = train(trainer, limit)
    policy = finish(trainer, folder, {"training": figures})
    figures["throws"] = throw_all(policy, args.devices[0], args.throws)
    write_json(folder / "figures.json", {"variant": name, "seed": seed, **figures})
    return 0


def run(args: argparse.Namespace) -> int:
    """Run all trainings, several on each device, and pack the results."""
    if args.job:
        return job(args)
    work = Path(args.work)
    begin = time.time()
    work.mkdir(parents=True, exist_ok=True)
    path = work / "seeds.json"
    if not path.exists():
        write_json(path, random.SystemRandom().sample(range(1, 10**6), args.seeds))
    seeds = json.loads(path.read_text(encoding="utf-8"))
    print("seeds:", *seeds, flush=True)
    chosen = [name for name in VARIANTS if not args.only or name in args.only]
    jobs = [(name, seed) for seed in seeds for name in chosen]
    deadline = begin + args.seconds
    _work_off(jobs, args, deadline)
    _pack(work, Path(args.out))
    print(f"{time.time() - begin:.0f} s")
    return 0


def _work_off(jobs: list[tuple[str, int]], args: argparse.Namespace, deadline: float) -> None:
    """Keep ``slots`` trainings running on each device until none is left or the time is over."""
    work = Path(args.work)
    running = {}
    free = [device for _ in range(args.slots) for device in args.devices]
    while (jobs or running) and time.time() < deadline + 5.0:
        for process, (name, seed, device, begin) in list(running.items()):
            if process.poll() is None:
                continue
            del running[process]
            free.append(device)
            print(f"{name}-{seed}: {process.returncode}, {time.time() - begin:.0f} s", flush=True)
        while jobs and free and deadline - time.time() > LEAST + RESERVE:
            name, seed = jobs.pop(0)
            if (work / f"{name}-{seed}" / "figures.json").exists():
                continue
            device = free.pop(0)
            running[_begin(name, seed, device, deadline, args)] = (name, seed, device, time.time())
        if not running and deadline - time.time() <= LEAST + RESERVE:
            break
        time.sleep(0.5)
    for process in running:
        process.kill()
    print("not begun:", *(f"{name}-{seed}" for name, seed in jobs), flush=True)


def _begin(
    name: str, seed: int, device: str, deadline: float, args: argparse.Namespace
) -> subprocess.Popen:
    words = [sys.executable, "-m", "bench.vision_ablation", args.out, "--work", args.work]
    words += ["--job", name, "--seed", str(seed), "--devices", device]
    words += ["--deadline", str(deadline), "--throws", str(args.throws)]
    words += ["--longest", str(args.longest)]
    words += [part for item in args.overrides for part in ("--set", item)]
    log = Path(args.work) / f"{name}-{seed}.log"
    with log.open("w", encoding="utf-8") as file:
        return subprocess.Popen(words, stdout=file, stderr=subprocess.STDOUT)


def _pack(work: Path, out: Path) -> None:
    """Write all figures, and everything else into four archives of like size."""
    out.mkdir(parents=True, exist_ok=True)
    figures = [json.loads(path.read_text()) for path in sorted(work.glob("*/figures.json"))]
    write_json(out / "figures.json", figures)
    for row in figures:
        errors = {k: round(v.get("error_mean", -1.0), 4) for k, v in row["throws"].items()}
        print(row["variant"], row["seed"], f"{row['iterations']} it", errors, flush=True)
    files = sorted(work.rglob("*"), key=lambda path: path.stat().st_size, reverse=True)
    files = [path for path in files if path.is_file() and path.suffix != ".pt"]
    for number in range(4):
        with tarfile.open(out / f"ablation-{number}.tar.gz", "w:gz", compresslevel=1) as archive:
            for path in files[number::4]:
                archive.add(path, path.relative_to(work))


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    parser = start.parser_of(__doc__, record=False)
    parser.add_argument("out", help="folder of the archives")
    parser.add_argument("--work", default="runs/vision_ablation", help="folder of the trainings")
    parser.add_argument("--devices", nargs="+", default=["cuda:0"])
    parser.add_argument("--slots", type=int, default=3, help="trainings at once on a device")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=520.0, help="of all trainings together")
    parser.add_argument("--longest", type=float, default=LIMIT, help="of a training [s]")
    parser.add_argument("--throws", type=int, default=THROWS, help="at each target")
    parser.add_argument("--only", nargs="+", choices=VARIANTS, help="variants; default: all")
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    parser.add_argument("--job", help=argparse.SUPPRESS)
    parser.add_argument("--seed", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--deadline", type=float, help=argparse.SUPPRESS)
    return start.main(parser, run, argv)


if __name__ == "__main__":
    sys.exit(main())

"""``visthrow train``: train a policy, with progress, evaluation on the way, checkpoints, resume."""

import argparse
import os
import signal
import sys
import time
from pathlib import Path

from visthrow.common.arguments import add_common

EVALUATION_TARGET = 2.0  # [m]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = (
        "examples:\n"
        "  visthrow train state                           the state policy, on a GPU if there is one\n"
        "  visthrow train vision --seed 2 --out runs/v2   another seed, in a folder of its own\n"
        "  visthrow train laptop                          a smaller state policy on two CPU cores\n"
        "  visthrow train vision --resume --out runs/v2   go on where an interrupted run stopped\n"
        "  torchrun --nproc-per-node 2 -m visthrow.cli train state   on two GPUs\n"
    )
    parser.add_argument("config", metavar="CONFIG", help="state, vision, laptop, paper, or a TOML file of your own")
    parser.add_argument("--seed", type=int, default=1, help="of everything random (default: 1)")
    parser.add_argument("--out", metavar="FOLDER", help="folder of the run (default: runs/CONFIG-SEED)")
    parser.add_argument("--iterations", type=int, help="stop after this many iterations (default: the configuration's)")
    parser.add_argument("--minutes", type=float, help="stop, with a checkpoint, after this many minutes")
    parser.add_argument(
        "--evaluate-every",
        type=int,
        default=0,
        metavar="N",
        help="throw 200 times every N iterations (default: at the end only)",
    )
    parser.add_argument(
        "--checkpoint-every", type=int, default=100, metavar="N", help="iterations between checkpoints (default: 100)"
    )
    parser.add_argument("--resume", action="store_true", help="go on from the folder's checkpoint")
    add_common(parser)


def _ranks() -> dict | None:
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world == 1:
        return None
    import torch

    rank, local = int(os.environ["RANK"]), int(os.environ["LOCAL_RANK"])
    torch.cuda.set_device(local)
    torch.distributed.init_process_group(backend="nccl", rank=rank, world_size=world)
    return {"global_rank": rank, "local_rank": local, "world_size": world}


def run(args: argparse.Namespace) -> int:
    """Train."""
    from visthrow import config
    from visthrow.common import provenance
    from visthrow.common.errors import CheckpointError, TrainError
    from visthrow.task import Experiment
    from visthrow.training import device
    from visthrow.training.trainer import CHECKPOINT, Trainer

    path = config.find("train", args.config)
    experiment = config.load(Experiment, path, args.overrides)
    folder = Path(args.out or f"runs/{path.stem}-{args.seed}")
    ranks = _ranks()
    lead = ranks is None or ranks["global_rank"] == 0
    name = f"cuda:{ranks['local_rank']}" if ranks else device.resolve(args.device)
    if ranks and args.minutes:
        raise TrainError("--minutes would stop one of several processes and leave the others waiting; use --iterations")
    start = time.perf_counter()
    if args.resume and not (folder / CHECKPOINT).exists():
        raise CheckpointError(f"{folder}: no {CHECKPOINT} to resume from")
    if lead:
        provenance.write_run_folder(folder, experiment, resume=args.resume, seed=args.seed)
    trainer = Trainer(experiment, name, args.seed, ranks)
    if args.resume:
        trainer.load(folder / CHECKPOINT)
    finished = _loop(args, trainer, folder) if lead else _follow(args, trainer)
    if not lead:
        return 0
    trainer.save(folder / CHECKPOINT)
    if not finished:
        print(
            f"\nstopped after iteration {trainer.iteration} of {_last(args, trainer)}; go on with: visthrow train {args.config} "
            f"--seed {args.seed} --out {folder} --resume",
            file=sys.stderr,
        )
        return 130
    return _report(args, trainer, folder, time.perf_counter() - start)


def _last(args: argparse.Namespace, trainer) -> int:
    return args.iterations or trainer.algorithm.iterations


def _follow(args: argparse.Namespace, trainer) -> bool:
    """Train as one of several ranks that only the first reports on."""
    while trainer.iteration < _last(args, trainer):
        trainer.step()
    return True


class StopRequest:
    """Ctrl-C and SIGTERM taken down while it is entered, so that no iteration is cut in two; a second Ctrl-C interrupts.

    Attributes:
        asked: whether one came.
    """

    def __init__(self) -> None:
        self.asked = False

    def __enter__(self) -> "StopRequest":
        self._before = {number: signal.signal(number, self._take) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _take(self, number: int, frame: object) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        print("\nstopping after this iteration", file=sys.stderr)


def _loop(args: argparse.Namespace, trainer, folder: Path) -> bool:
    """Train with log, evaluation and checkpoints; return whether the end was reached.

    Raises:
        TrainError: A file cannot be written; what the last checkpoint holds is not lost.
    """
    from visthrow.common.errors import StorageError, TrainError
    from visthrow.training.progress import TrainLog
    from visthrow.training.trainer import CHECKPOINT

    start, kept = time.perf_counter(), trainer.iteration
    try:
        with (
            TrainLog(folder / "progress.csv", trainer.algorithm.samples, _last(args, trainer), kept) as log,
            StopRequest() as stop,
        ):
            while trainer.iteration < _last(args, trainer):
                figures = trainer.step()
                if args.evaluate_every and trainer.iteration % args.evaluate_every == 0:
                    row = trainer.evaluate(EVALUATION_TARGET)
                    nan = float("nan")
                    figures |= {"error_2m": row.get("error_mean", nan), "duration_2m": row.get("duration_mean", nan)}
                log.row(figures)
                if trainer.iteration % args.checkpoint_every == 0:
                    trainer.save(folder / CHECKPOINT)
                    kept = trainer.iteration
                if stop.asked or (args.minutes and time.perf_counter() - start > 60 * args.minutes):
                    return trainer.iteration >= _last(args, trainer)
    except (OSError, StorageError) as error:
        state = (
            f"the checkpoint of iteration {kept} is whole; make room and go on with --resume"
            if kept
            else "no checkpoint yet"
        )
        raise TrainError(f"{folder}: cannot write ({error}) in iteration {trainer.iteration}; {state}") from error
    return True


def _report(args: argparse.Namespace, trainer, folder: Path, wall: float) -> int:
    from visthrow.common.storage import write_json
    from visthrow.training.protocol import TARGETS
    from visthrow.training.trainer import finish

    rows = [trainer.evaluate(target) for target in TARGETS]
    figures = {
        "throws": rows,
        "wall_s": wall,
        "iterations": trainer.iteration,
        "env_steps": trainer.iteration * trainer.algorithm.samples,
        "seconds": dict(trainer.seconds),
    }
    finish(trainer, folder, figures)
    print(f"\n{trainer.iteration} iterations, {figures['env_steps'] / 1e6:.1f} M environment steps, {wall:.1f} s")
    for row in rows:
        if row["success"] > 0:
            print(
                f"target {row['target']:.1f} m: error {row['error_mean']:.3f} +- {row['error_std']:.3f} m, duration "
                f"{row['duration_mean']:.3f} s, success {100 * row['success']:.1f} %"
            )
        else:
            print(f"target {row['target']:.1f} m: no throw succeeded")
    print(f"policy: {folder / 'policy.npz'}")
    if args.json:
        write_json(args.json, figures)
    return 0

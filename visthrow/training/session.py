"""Run a training from its start or from a checkpoint, with a log, evaluations and checkpoints.

A training stops after its last iteration, at a requested error, at a time limit, or on Ctrl-C and
SIGTERM. In each case ``policy.npz``, ``checkpoint.pt`` and ``progress.csv`` remain in the folder of
the run."""

import contextlib
import json
import math
import os
import signal
import sys
import time
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from visthrow import config
from visthrow.common import compute_device, provenance, statistics
from visthrow.common.arguments import EXIT_INTERRUPTED, StopRequest
from visthrow.common.errors import CheckpointError, StorageError, TrainError
from visthrow.common.storage import write_json
from visthrow.common.toml_text import tables_beside
from visthrow.onboard.policy import Policy, find_policy
from visthrow.task import Experiment
from visthrow.task.measurement import Throws
from visthrow.training.progress import TrainLog
from visthrow.training.ranks import Ranks
from visthrow.training.trainer import ADAPTATION, CHECKPOINT, Trainer, adopt_layers, finish

EVALUATION_TARGET = 2.0  # [m]


# shares of the wall time that each may take if the command does not state a period
EVALUATION_SHARE = 0.05
CHECKPOINT_SHARE = 0.01

FIRST = 20.0  # time of the first of each [s], as its duration is not known before


def run(args: Namespace) -> int:
    """Train with the arguments of ``visthrow train``; return the exit status of the command."""
    _check(args)
    path = config.find("train", args.config) if args.config else None
    folder = Path(args.out or f"runs/{path.stem}-{1 if args.seed is None else args.seed}")
    begun = _resume if args.resume else _begin
    experiment, policy, seed = begun(args, path, folder)
    name = compute_device.resolve(args.device)
    ranks = Ranks.join(name != "cpu") if int(os.environ.get("WORLD_SIZE", "1")) > 1 else Ranks(name)
    start = time.perf_counter()
    # raises ConfigError for an unsupported experiment before a folder is created
    trainer = Trainer(experiment, ranks.device, seed, ranks)
    if args.resume:
        trainer.load(folder / CHECKPOINT)
    elif policy is not None:
        trainer.algorithm.take_up(policy)
    last = args.iterations or trainer.algorithm.iterations
    if ranks.lead:
        summary: dict[str, Any] = {"seed": seed, "processes": ranks.world}
        if policy is not None:
            files = {
                k: policy.made_by[k] for k in ("commit", "command", "seed") if k in policy.made_by
            }
            summary["from"] = {"policy": Path(args.start).name, **files}
        provenance.write_run_folder(folder, config.dumps(experiment), resume=args.resume, **summary)
    why = _loop(args, trainer, folder, last)
    finished = why in (DONE, REACHED)
    if ranks.lead:
        _report(args, trainer, folder, time.perf_counter() - start, finished)
    iteration = trainer.iteration
    del trainer  # its captured graphs hold the process group's communicator
    ranks.leave()
    if finished:
        return 0
    if ranks.lead:
        command = f"visthrow train --resume --out {folder}"
        if args.iterations:
            command += f" --iterations {args.iterations}"
        print(
            f"\n{why} after iteration {iteration} of {last}; continue with: {command}",
            file=sys.stderr,
        )
    return 0 if why == OUT_OF_TIME else EXIT_INTERRUPTED


def _check(args: Namespace) -> None:
    """Raise TrainError for arguments that contradict each other."""
    if args.until is not None and args.until >= EVALUATION_TARGET:
        raise TrainError(
            f"--until {args.until:g} m; throws are at {EVALUATION_TARGET:g} m: expected a smaller"
            " error, in m"
        )
    if args.resume and args.start:
        raise TrainError("--resume continues with the run's policy; --from starts a new run")
    if args.resume and not args.out and not args.config:
        raise TrainError("--resume: name the run's folder with --out")
    if not args.resume and not args.config:
        raise TrainError("no CONFIG; expected a name in configs/train, such as laptop, or a file")


def _begin(args: Namespace, path: Path, folder: Path) -> tuple:
    """Return the experiment, the policy to start from or None, and the seed of a new run.

    Raises StorageError: the folder holds a run already.
    """
    seed = 1 if args.seed is None else args.seed
    provenance.check_free(folder)
    if args.start is None:
        return config.load(Experiment, path, args.overrides), None, seed
    policy = Policy.load(find_policy(args.start))
    experiment = config.load(Experiment, path, [ADAPTATION, *args.overrides])
    return adopt_layers(experiment, policy), policy, seed


def _resume(args: Namespace, path: Path | None, folder: Path) -> tuple:
    """Return the experiment, None and the seed of the run in the folder.

    Raises CheckpointError: the folder holds no checkpoint, or the arguments contradict it.
    """
    if not (folder / CHECKPOINT).exists():
        raise CheckpointError(f"{folder}: no {CHECKPOINT} to resume from")
    experiment = config.load(Experiment, folder / "config.toml")
    if config.load(Experiment, folder / "config.toml", args.overrides) != experiment:
        raise CheckpointError(
            f"{folder}: the run's configuration is not that of --set; resume without it, or begin"
            " a new run"
        )
    if (
        path is not None
        and not args.overrides
        and config.load(Experiment, path).task.observation != experiment.task.observation
    ):
        raise CheckpointError(
            f"{folder}: the run has another configuration than {path.stem}; resume with only --out"
        )
    seed = json.loads((folder / "provenance.json").read_text(encoding="utf-8"))["seed"]
    if args.seed not in (None, seed):
        raise CheckpointError(f"{folder}: the run has the seed {seed}; resume without --seed")
    return experiment, None, seed


DONE, REACHED, OUT_OF_TIME, STOPPED = ENDS = (
    "finished",
    "reached the requested error",
    "reached the time limit",
    "stopped",
)
"""Reasons why a training stopped."""

STOPPING = "\nstopping after this iteration"


class Regularly:
    """The schedule of a periodic task, with a period in iterations or a limit on its share of the
    wall time.
    """

    def __init__(self, period: int | None, share: float):
        """Start the clock; ``period``: iterations, None to use the ``share`` of the wall time."""
        self._every = period
        self._share = share
        self._next = time.perf_counter() + FIRST

    def due(self, iteration: int) -> bool:
        """Return whether the task is due after this iteration."""
        if self._every:
            return iteration % self._every == 0
        return time.perf_counter() > self._next

    @contextlib.contextmanager
    def measure_cost(self) -> Iterator[None]:
        """Measure the duration of the block and schedule the next one accordingly."""
        begin = time.perf_counter()
        yield
        end = time.perf_counter()
        self._next = end + (end - begin) / self._share


def _loop(args: Namespace, trainer, folder: Path, last: int) -> str:
    """Train with log, evaluations and checkpoints, the last one at the end; return the reason of
    the stop, one of :data:`ENDS`.

    Raises TrainError: a file cannot be written; the last checkpoint remains.
    """
    deadline = time.perf_counter() + 60.0 * (args.minutes or math.inf)
    saved = trainer.iteration
    why = DONE
    ranks = trainer.ranks
    evaluates = ranks.lead and (args.evaluate_every or args.until or sys.stdout.isatty())
    evaluations = Regularly(args.evaluate_every, EVALUATION_SHARE)
    checkpoints = Regularly(args.checkpoint_every, CHECKPOINT_SHARE)
    log = None
    if ranks.lead:
        samples = trainer.algorithm.samples
        log = TrainLog(folder / "progress.csv", samples, last, saved, args.minutes)
    try:
        stop = StopRequest((signal.SIGINT, signal.SIGTERM), STOPPING)
        with log or contextlib.nullcontext(), stop:
            while trainer.iteration < last and why == DONE:
                figures = trainer.step()
                throws = None
                if evaluates and evaluations.due(trainer.iteration):
                    with evaluations.measure_cost():
                        throws = trainer.throw(EVALUATION_TARGET)
                if log:
                    log.row(figures, throws)
                if ranks.agree(checkpoints.due(trainer.iteration)):
                    with checkpoints.measure_cost():
                        trainer.save(folder / CHECKPOINT)
                    saved = trainer.iteration
                if args.until and throws is not None and throws.land_within(args.until):
                    why = REACHED
                elif trainer.iteration < last and stop.asked:
                    why = STOPPED
                elif trainer.iteration < last and time.perf_counter() > deadline:
                    why = OUT_OF_TIME
                why = ENDS[ranks.agree(ENDS.index(why))]
            trainer.save(folder / CHECKPOINT)
    except (OSError, StorageError) as error:
        state = "no checkpoint yet"
        if saved:
            state = f"the checkpoint of iteration {saved} is whole; free space and use --resume"
        raise TrainError(
            f"{folder}: cannot write ({error}) in iteration {trainer.iteration}; {state}"
        ) from error
    return why


def _line(throws: Throws) -> str:
    """Return a line of text with a target's landing error and its 95 % interval."""
    row = throws.summary()
    if not row["success"]:
        return f"target {row['target']:.1f} m: no throw landed"
    error = statistics.mean(throws.error[throws.success])
    return (
        f"target {row['target']:.1f} m: error {error.text()} m, duration"
        f" {row['duration_mean']:.3f} s, landed {100 * row['success']:.1f} % of {row['throws']}"
    )


def _compare(name: str | None, rows: list[dict]) -> None:
    """Compare a training's landing error with those of recorded seeds of its configuration, if any,
    and print the result.
    """
    recorded = tables_beside(__file__, "recorded.toml").get(name)
    errors = [row.get("error_mean") for row in rows if row["target"] == EVALUATION_TARGET]
    if recorded is None or errors == [None]:
        return
    worse = sum(error > errors[0] for error in recorded)
    print(
        f"at {EVALUATION_TARGET} m {worse} of {len(recorded)} recorded seeds had a larger error;"
        f" their errors were {min(recorded):.3f} to {max(recorded):.3f} m"
    )


def _report(args: Namespace, trainer, folder: Path, wall: float, finished: bool) -> None:
    """Throw at all targets, write the policy with the results, and print these."""
    throws = trainer.final_throws()
    rows = [one.summary() for one in throws["flown"]]
    steps = trainer.iteration * trainer.algorithm.samples
    figures = {
        "throws": rows,
        "wall_s": wall,
        "iterations": trainer.iteration,
        "env_steps": steps,
        "seconds": trainer.seconds,
    }
    trained = throws.get("trained", ())
    if trained:
        figures["throws_under_faults"] = [one.summary() for one in trained]
    finish(trainer, folder, figures, finished)
    print(f"\n{trainer.iteration} iterations, {steps / 1e6:.1f} M environment steps, {wall:.1f} s")
    lines = [*map(_line, throws["flown"])]
    if trained:
        lines += ["under the faults of its training:", *map(_line, trained)]
    print("\n".join(lines))
    whole = trainer.iteration == trainer.algorithm.iterations
    if whole and not args.overrides and not args.start:
        _compare(args.config, rows)
    print(f"policy: {folder / 'policy.npz'}")
    if args.json:
        write_json(args.json, figures)

"""``visthrow train``: train a policy, from scratch or from another, with progress, evaluation, checkpoints, resume."""

import argparse
import contextlib
import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from visthrow.common.arguments import EXIT_INTERRUPTED, add_common

EVALUATION_TARGET = 2.0  # [m]

EVALUATION_SHARE = 0.05
"""Of the wall time that evaluations may take where their number is left to the command."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = (
        "examples:\n"
        "  visthrow train laptop                          a state policy on the cores of a laptop\n"
        "  visthrow train laptop --until 0.04             stop once throws at 2.0 m land within 4 cm on average\n"
        "  visthrow train mine.toml --from state          adapt the shipped policy to a vehicle of your own\n"
        "  visthrow train vision --seed 2 --out runs/v2   another seed, in a folder of its own\n"
        "  visthrow train --resume --out runs/v2          go on where an interrupted run stopped\n"
        "  torchrun --nproc-per-node 2 -m visthrow.cli train state   on two GPUs\n"
    )
    names = "a name of configs/train (state, vision, vision_dropout, laptop, laptop_vision, paper, ...) or a TOML file of your own"
    parser.add_argument("config", metavar="CONFIG", nargs="?", help=f"{names}; a resumed run has it in its folder")
    parser.add_argument("--seed", type=int, help="of everything random (default: 1, or that of the resumed run)")
    parser.add_argument("--out", metavar="FOLDER", help="folder of the run (default: runs/CONFIG-SEED)")
    parser.add_argument(
        "--from", dest="start", metavar="POLICY",
        help="start from this policy, a shipped name or a file, with the short schedule of configs/ppo/adapt.toml",
    )  # fmt: skip
    parser.add_argument("--iterations", type=int, metavar="N", help="stop after iteration N (default: the configuration's last)")
    parser.add_argument("--minutes", type=float, metavar="T", help="stop after this time")
    parser.add_argument("--until", type=float, metavar="ERROR", help="stop once throws at 2.0 m land so near on average [m]")
    parser.add_argument(
        "--evaluate-every", type=int, metavar="N",
        help="throw 200 times every N iterations (default: a twentieth of the time on a terminal, with --until and --view)",
    )  # fmt: skip
    parser.add_argument(
        "--checkpoint-every", type=int, default=100, metavar="N", help="iterations between checkpoints (default: 100)"
    )
    parser.add_argument("--view", action="store_true", help="show a throw of each evaluation in this machine's browser")
    parser.add_argument("--resume", action="store_true", help="go on from the folder's checkpoint")
    add_common(parser)


def run(args: argparse.Namespace) -> int:
    """Train."""
    from visthrow import config
    from visthrow.common import provenance
    from visthrow.training import device
    from visthrow.training.ranks import Ranks
    from visthrow.training.trainer import CHECKPOINT, Trainer

    _check(args)
    experiment, policy, folder, seed = _resumed(args) if args.resume else _begun(args)
    name = device.resolve(args.device)
    ranks = Ranks.join(name != "cpu") if int(os.environ.get("WORLD_SIZE", "1")) > 1 else Ranks(name)
    start = time.perf_counter()
    trainer = Trainer(experiment, ranks.device, seed, ranks)  # refuses what cannot be trained before a folder is made
    if args.resume:
        trainer.load(folder / CHECKPOINT)
    elif policy is not None:
        trainer.take_up(policy)
    last = args.iterations or trainer.algorithm.iterations
    if ranks.lead:
        told = {"seed": seed, "processes": ranks.world} | ({"from": _origin(args.start, policy)} if policy is not None else {})
        provenance.write_run_folder(folder, config.dumps(experiment), resume=args.resume, **told)
    why = _loop(args, trainer, folder, last)
    if ranks.lead:
        _report(args, trainer, folder, time.perf_counter() - start, finished=why != STOPPED)
    iteration = trainer.iteration
    del trainer  # its captured graphs hold the processes' communicator
    ranks.leave()
    if why != STOPPED:
        return 0
    words = ["visthrow train --resume", f"--out {folder}", *([f"--iterations {args.iterations}"] if args.iterations else [])]
    print(f"\n{why} after iteration {iteration} of {last}; go on with: {' '.join(words)}", file=sys.stderr)
    return EXIT_INTERRUPTED


def _check(args: argparse.Namespace) -> None:
    """Refuse numbers that stop nothing or everything.

    Raises:
        TrainError: one of them, or words that contradict each other.
    """
    from visthrow.common.errors import TrainError

    for name in ("iterations", "minutes", "until", "evaluate_every", "checkpoint_every"):
        value = getattr(args, name)
        if value is not None and not value > 0:
            raise TrainError(f"--{name.replace('_', '-')} {value}: expected a number above 0")
    if args.resume and args.start:
        raise TrainError("--resume goes on with its own policy; --from starts a new run")
    if args.resume and not args.out and not args.config:
        raise TrainError("--resume: of which run? name its folder with --out")
    if not args.resume and not args.config:
        raise TrainError("no CONFIG; name one of configs/train, such as laptop, or a TOML file")


def _begun(args: argparse.Namespace) -> tuple:
    """Experiment, policy to start from or None, folder and seed of a new run.

    Raises:
        StorageError: the folder holds a run already.
    """
    from visthrow import config
    from visthrow.common import provenance
    from visthrow.onboard.policy import Policy, find_policy
    from visthrow.task import Experiment
    from visthrow.training.trainer import ADAPTATION, fitted

    path, seed = config.find("train", args.config), 1 if args.seed is None else args.seed
    folder = Path(args.out or f"runs/{path.stem}-{seed}")
    provenance.check_free(folder)
    if args.start is None:
        return config.load(Experiment, path, args.overrides), None, folder, seed
    policy = Policy.load(find_policy(args.start))
    return fitted(config.load(Experiment, path, [ADAPTATION, *args.overrides]), policy), policy, folder, seed


def _resumed(args: argparse.Namespace) -> tuple:
    """Experiment, None, folder and seed of the run in the folder; what is named besides must agree with it.

    Raises:
        CheckpointError: no checkpoint there, or a word that contradicts the run's configuration.
    """
    import json

    from visthrow import config
    from visthrow.common.errors import CheckpointError
    from visthrow.task import Experiment
    from visthrow.training.trainer import CHECKPOINT

    path = config.find("train", args.config) if args.config else None
    folder = Path(args.out or f"runs/{path.stem}-{1 if args.seed is None else args.seed}")
    if not (folder / CHECKPOINT).exists():
        raise CheckpointError(f"{folder}: no {CHECKPOINT} to resume from")
    experiment = config.load(Experiment, folder / "config.toml")
    if args.overrides and config.load(Experiment, folder / "config.toml", args.overrides) != experiment:
        raise CheckpointError(f"{folder}: a run of another configuration than --set says; resume without it, or begin a new run")
    if path is not None and not args.overrides and config.load(Experiment, path).task.observation != experiment.task.observation:
        raise CheckpointError(f"{folder}: a run of another configuration than {path.stem}; resume with --out alone")
    seed = json.loads((folder / "provenance.json").read_text(encoding="utf-8"))["seed"]
    if args.seed not in (None, seed):
        raise CheckpointError(f"{folder}: a run of another seed, {seed}; resume without --seed")
    return experiment, None, folder, seed


def _origin(name: str, policy) -> dict:
    """What the provenance says of the policy that a run starts from."""
    return {"policy": Path(name).name, **{k: policy.made_by[k] for k in ("commit", "command", "seed") if k in policy.made_by}}


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


DONE, REACHED, STOPPED = ENDS = ("finished", "reached the error that was asked for", "stopped")
"""Why a loop ended."""


class Evaluations:
    """When to throw on the way: every so many iterations, or as often as a share of the wall time allows."""

    def __init__(self, every: int | None, wanted: bool):
        """Begin.

        Args:
            every: iterations between two; None leaves it to the clock.
            wanted: whether there are any where it is left to the clock.
        """
        self._every, self._wanted = every, wanted
        self._after, self._cost = time.perf_counter(), 1.0

    def due(self, iteration: int) -> bool:
        """Whether to throw after this iteration."""
        if self._every:
            return iteration % self._every == 0
        return self._wanted and time.perf_counter() - self._after > self._cost / EVALUATION_SHARE

    @contextlib.contextmanager
    def timed(self) -> Iterator[None]:
        """Measure what one costs."""
        begin = time.perf_counter()
        yield
        self._after = time.perf_counter()
        self._cost = self._after - begin


def _loop(args: argparse.Namespace, trainer, folder: Path, last: int) -> str:
    """Train with log, evaluation and checkpoints, the last one at the end; return why it ended.

    Raises:
        TrainError: A file cannot be written; what the last checkpoint holds is not lost.
    """
    from visthrow.common.errors import StorageError, TrainError
    from visthrow.training.progress import TrainLog
    from visthrow.training.trainer import CHECKPOINT

    start, kept, why, ranks = time.perf_counter(), trainer.iteration, DONE, trainer.ranks
    evaluations = Evaluations(args.evaluate_every, bool(args.until or args.view or sys.stdout.isatty()))
    log = TrainLog(folder / "progress.csv", trainer.algorithm.samples, last, kept, args.minutes) if ranks.lead else None
    try:
        with log or contextlib.nullcontext(), StopRequest() as stop, _viewer(args.view and ranks.lead, trainer) as show:
            while trainer.iteration < last and why == DONE:
                figures, throws = trainer.step(), None
                if ranks.lead and evaluations.due(trainer.iteration):
                    with evaluations.timed():
                        throws = trainer.throw(EVALUATION_TARGET)
                        show(throws)
                if log:
                    log.row(figures, throws)
                if trainer.iteration % args.checkpoint_every == 0:
                    trainer.save(folder / CHECKPOINT)
                    kept = trainer.iteration
                if args.until and throws is not None and throws.within(args.until):
                    why = REACHED
                elif stop.asked or (args.minutes and time.perf_counter() - start > 60 * args.minutes):
                    why = STOPPED if trainer.iteration < last else DONE
                why = ENDS[ranks.agree(ENDS.index(why))]
            trainer.save(folder / CHECKPOINT)
    except (OSError, StorageError) as error:
        state = f"the checkpoint of iteration {kept} is whole; make room and go on with --resume" if kept else "no checkpoint yet"
        raise TrainError(f"{folder}: cannot write ({error}) in iteration {trainer.iteration}; {state}") from error
    return why


@contextlib.contextmanager
def _viewer(wanted: bool, trainer) -> Iterator:
    """Function that shows an evaluation in rerun, one of its throws and where all came down; where wanted."""
    if not wanted:
        yield lambda throws: None
        return
    import numpy as np
    import torch

    from visthrow.task import contract_of
    from visthrow.throws.loading import Loaded
    from visthrow.throws.recorded import fly
    from visthrow.view import live, rerun_view

    with live.served() as address:

        def show(throws) -> None:
            policy = trainer.algorithm.export(contract_of(trainer.experiment), {})
            with torch.random.fork_rng(devices=[]):
                log = fly(Loaded("training", policy, trainer.experiment), np.array([throws.target, 0.0, 0.0]))
            name = f"iteration {trainer.iteration}: {throws.summary().get('error_mean', float('nan')):.3f} m"
            rerun_view.show(address, name, log, trainer.experiment, throws.landing_w[throws.success])

        yield show


def _report(args: argparse.Namespace, trainer, folder: Path, wall: float, finished: bool) -> None:
    """Throw at all targets, write the policy with what came of it, and print it."""
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
    finish(trainer, folder, figures, finished)
    print(f"\n{trainer.iteration} iterations, {figures['env_steps'] / 1e6:.1f} M environment steps, {wall:.1f} s")
    for row in rows:
        if row["success"] > 0:
            print(
                f"target {row['target']:.1f} m: error {row['error_mean']:.3f} +- {row['error_std']:.3f} m, duration "
                f"{row['duration_mean']:.3f} s, landed {100 * row['success']:.1f} %"
            )
        else:
            print(f"target {row['target']:.1f} m: no throw landed")
    print(f"policy: {folder / 'policy.npz'}")
    if args.json:
        write_json(args.json, figures)

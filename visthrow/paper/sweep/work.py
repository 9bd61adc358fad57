"""Do units in this process: a part of a training run, or throws.

Units that are done, or that another process is doing, are skipped.
"""

import fcntl
import json
import os
import platform
import shutil
import sys
import time
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import torch

from visthrow.common import provenance
from visthrow.common.errors import BusyError
from visthrow.common.storage import write_json
from visthrow.paper import results
from visthrow.paper.sweep.work_units import ResultSource, SweepWork, ThrowUnit, throws_folder
from visthrow.throws.loading import Loaded, load_policy

PIECES = "pieces"  # folder of a run with one file for each part of the training

EXIT_STOPPED = 130
EXIT_BUSY = 75


def lock_of(out: Path, name: str) -> Path:
    """Return the lock file of a unit."""
    return out / "locks" / f"{name.replace('/', '_')}.lock"


@contextmanager
def hold_lock(path: Path) -> Iterator[None]:
    """Hold the lock on a file, which names the process that holds it.

    The kernel releases the lock when the process ends. The file remains: if it were removed, two
    processes could lock two files with the same name. Raises BusyError: another process holds the
    lock."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(os.open(path, os.O_RDWR | os.O_CREAT, 0o644), "r+", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise BusyError(
                f"{path}: another process holds the lock: {file.read() or 'unknown'}"
            ) from None
        file.truncate(0)
        json.dump({"process": os.getpid(), "machine": platform.node(), "since": time.time()}, file)
        file.flush()
        yield


def is_locked(path: Path) -> bool:
    """Return whether a process holds the lock on a file."""
    try:
        with path.open("r+") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False


def work(work: SweepWork, out: Path, ids: Sequence[str], device: str, minutes: float | None) -> int:
    """Do trainings and throws of these ids in sequence; after ``minutes`` a training stops with a
    checkpoint.

    Returns 0; 130 if a training was stopped before its end; 75 if another process holds the
    unit."""
    begin = time.monotonic()
    status = 0
    throws = {unit.id: unit for units in work.throws.values() for unit in units}
    for name in ids:
        remaining = (
            None if minutes is None else max(minutes - (time.monotonic() - begin) / 60, 0.01)
        )
        unit = throws.get(name) or work.source(name)
        try:
            with hold_lock(lock_of(out, name)):
                if unit.is_done(out):
                    continue
                if isinstance(unit, ResultSource):
                    status = train(unit, out, device, remaining, work.checkpoint_every)
                elif unit.source.is_done(out):
                    fly(unit, out, device)
        except BusyError as error:
            print(error, file=sys.stderr)
            status = EXIT_BUSY
        if status:
            break
    return status


def train(
    source: ResultSource, out: Path, device: str, minutes: float | None, checkpoint_every: int
) -> int:
    """Start or resume a training, up to its end or for ``minutes``; return the exit status of
    ``visthrow train``.
    """
    from visthrow.training import session
    from visthrow.training.trainer import CHECKPOINT

    folder = source.folder(out)
    resume = (folder / CHECKPOINT).is_file()
    if folder.exists() and not resume:  # killed before its first checkpoint
        shutil.rmtree(folder)
    args = Namespace(
        config=source.config,
        seed=source.seed,
        out=str(folder),
        start=None,
        iterations=None,
        minutes=minutes,
        until=None,
        evaluate_every=None,
        checkpoint_every=checkpoint_every,
        resume=resume,
        device=device,
        overrides=source.changes,
        json=None,
    )
    start = time.perf_counter()
    began = datetime.now(UTC).isoformat(timespec="seconds")
    status = 1
    try:
        status = session.run(args)
        status = (
            status if status or source.is_done(out) else EXIT_STOPPED
        )  # stopped by the time limit
    finally:
        piece = {
            "start": began,
            "seconds": round(time.perf_counter() - start, 2),
            "status": status,
            "commit": provenance.commit(),
            "processors": provenance.processors(),
        }
        write_json(folder / PIECES / f"{time.time_ns()}.json", piece)
    return status


def fly(unit: ThrowUnit, out: Path, device: str) -> None:
    """Fly the throws of a unit and write the result."""
    command = f"visthrow sweep run (throws {unit.set} of {unit.source.name})"
    results.finish(
        throws_folder(out),
        lambda _: (_columns(unit, out, device), {}),
        provenance.commit(),
        command,
        unit.unit(out),
    )


def _columns(unit: ThrowUnit, out: Path, device: str) -> dict[str, np.ndarray]:
    from visthrow.common.compute_device import resolve
    from visthrow.throws.reference_protocol import Job, fly_batch
    from visthrow.training.protocol import throw

    loaded = load(unit, out)
    if unit.params.plant == "hybrid":
        device = resolve(device)
        policy = loaded.policy.to(device)
        return results.columns_of(
            throw(
                loaded.experiment,
                policy.actor(unit.count),
                unit.target,
                unit.count,
                device,
                unit.params.seed,
            )
        )
    torch.set_num_threads(1)
    return fly_batch(
        [loaded],
        unit.params.plant,
        Job((0,), unit.target, unit.batch, unit.count, unit.params.seed),
    )


def load(unit: ThrowUnit, out: Path) -> Loaded:
    """Load a unit's policy with the experiment in which it flies.

    Raises MismatchError: the list does not allow a difference from the policy's contract.
    """
    layout = unit.experiments(out)[0]["task"]["observation"]["layout"]
    # a trained policy's config comes from the list: that in its file may be of another version
    name, changes = unit.flight_config(layout)
    return load_policy(unit.source.policy(out), name or None, changes, unit.params.allow)

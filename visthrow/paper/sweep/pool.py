"""Distribute units: trainings and throws in the training simulator to devices, throws on the
reference plant to CPU cores.

A task is a training followed by its policy's throws in the training simulator, or one batch on a
reference plant. Tasks run in separate processes (:class:`Local`) or as jobs of a cluster
(:class:`visthrow.paper.sweep.cluster.Cluster`). A process that is killed loses only the work that
it has not yet written."""

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from visthrow.paper.sweep import Changes
from visthrow.paper.sweep.work import EXIT_BUSY, EXIT_STOPPED
from visthrow.paper.sweep.work_units import ResultSource, SweepWork, ThrowUnit

VISIBLE = "CUDA_VISIBLE_DEVICES"
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
POLL = 0.3  # time between polls of running tasks [s]
GRACE = 90.0  # time for a stopped process to write its checkpoint [s]
BUSY_PAUSE = 5.0  # time before a task is tried again whose unit another process holds [s]


@dataclass(frozen=True)
class Task:
    """Units that one process does in sequence."""

    name: str
    ids: tuple[str, ...]
    gpu: bool  # whether it runs on one of the devices; otherwise on a CPU core

    def log(self, out: Path) -> Path:
        """Return the file of the process's output."""
        return out / "logs" / f"{self.name.replace('/', '_')}.txt"


class Process(subprocess.Popen):
    """A task in a process on this machine, which stops when its parent ends (see ``visthrow sweep
    work``).
    """

    def stop(self) -> None:
        self.send_signal(signal.SIGINT)


@dataclass
class Local:
    """A starter of tasks on this machine."""

    list_name: str
    out: Path
    devices: list[str]
    jobs: int
    changes: Changes

    def start(self, task: Task, device: str, minutes: float) -> Process:
        environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
        if device.startswith("cuda"):
            # make only this GPU visible, so that the process creates no context on the others
            visible = [item for item in os.environ.get(VISIBLE, "").split(",") if item]
            index = int(device.removeprefix("cuda:"))
            environment[VISIBLE] = visible[index] if visible else str(index)
            device = "cuda:0"
        elif not task.gpu:
            environment |= dict.fromkeys(THREADS, "1")
        words = [sys.executable, "-m", "visthrow.cli", "sweep", "work", self.list_name]
        words += ["--out", str(self.out), "--units", ",".join(task.ids)]
        words += ["--parent", str(os.getpid()), "--device", device]
        if minutes < math.inf:
            words += ["--minutes", f"{minutes:.3f}"]
        for change in self.changes:
            words += ["--set", change]
        log = task.log(self.out)
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("ab") as file:
            return Process(
                words,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,
            )


@dataclass
class Outcome:
    """The outcome of a run of the pool."""

    failed: dict[str, str] = field(default_factory=dict)  # task -> last line of its log
    stopped: bool = False  # whether work remained
    interrupted: bool = False  # whether it was stopped by Ctrl-C or SIGTERM, not by the time limit


def tasks(work: SweepWork, out: Path, done: set[str]) -> Iterator[Task]:
    """Yield the remaining tasks that can start now, in the order of importance; add the ids of
    finished units to ``done``.
    """

    def is_remaining(unit: ResultSource | ThrowUnit) -> bool:
        if unit.id not in done and unit.is_done(out):
            done.add(unit.id)
        return unit.id not in done

    for source in work.sources:
        units = work.throws.get(source.id, ())
        in_training = [unit.id for unit in units if unit.params.plant == "hybrid"]
        if source.config and is_remaining(source):
            yield Task(source.id, (source.id, *in_training), gpu=True)
            continue
        units = [unit for unit in units if is_remaining(unit)]
        mine = [unit.id for unit in units if unit.id in in_training]
        if mine:
            yield Task(source.id, tuple(mine), gpu=True)
        for unit in units:
            if unit.id not in in_training:
                yield Task(unit.id, (unit.id,), gpu=False)


class ProcessPool:
    """A pool that keeps devices and cores busy until a list is done, the time is over or a stop is
    requested.

    Its ``starter`` has ``devices``, each for one task at a time; ``jobs``, the number of tasks on
    CPU cores; and ``start(task, device, minutes)``, with infinite minutes for no limit. The
    returned handle has ``poll()``, which returns the exit status or None while the task runs;
    ``stop()``, to write a checkpoint and end; and ``kill()``."""

    def __init__(self, work: SweepWork, out: Path, starter: Any, say: Callable[[str], None]):
        self.work = work
        self.out = out
        self.starter = starter
        self.say = say
        self.outcome = Outcome()
        self._done = set()
        self._todo = []
        # free devices (True) and free cores (False), by Task.gpu
        self._free = {True: list(starter.devices), False: ["cpu"] * starter.jobs}
        self._running: dict[str, tuple[Task, str, Any]] = {}
        self._wait: dict[str, float] = {}  # task -> time before which it is not tried again

    def run(self, minutes: float | None = None) -> Outcome:
        """Run tasks until all are done, ``minutes`` have passed, or Ctrl-C."""
        deadline = math.inf if minutes is None else time.monotonic() + 60.0 * minutes
        self._todo = list(tasks(self.work, self.out, self._done))
        try:
            while self._todo or self._running:
                remaining = (deadline - time.monotonic()) / 60.0
                if remaining <= 0.0:
                    self.outcome.stopped = True
                    break
                self._fill(remaining)
                time.sleep(POLL)
                if self._reap():
                    self._todo = list(tasks(self.work, self.out, self._done))
                self._todo = [task for task in self._todo if task.name not in self.outcome.failed]
        except KeyboardInterrupt:
            self.outcome.stopped = self.outcome.interrupted = True
        finally:
            self._stop()
        return self.outcome

    def _fill(self, remaining: float) -> None:
        """Start tasks on free devices and cores."""
        clock = time.monotonic()
        for task in self._todo:
            if task.name in self._running or self._wait.get(task.name, 0.0) > clock:
                continue
            if self._free[task.gpu]:
                self._start(task, self._free[task.gpu].pop(0), remaining)

    def _start(self, task: Task, device: str, remaining: float) -> None:
        self._running[task.name] = (task, device, self.starter.start(task, device, remaining))
        if task.gpu:
            self.say(f"{task.name} begins on {device}")

    def _reap(self) -> bool:
        """Process the tasks that have ended; return whether there were any."""
        polled = [(*started, handle.poll()) for *started, handle in self._running.values()]
        ended = [row for row in polled if row[-1] is not None]
        for task, device, status in ended:
            del self._running[task.name]
            self._free[task.gpu].append(device)
            if status in (EXIT_BUSY, EXIT_STOPPED):
                self._wait[task.name] = time.monotonic() + BUSY_PAUSE
            elif status != 0:
                self.outcome.failed[task.name] = (
                    read_last_line(task.log(self.out)) or f"exit status {status}"
                )
                self.say(f"{task.name} FAILED: {self.outcome.failed[task.name]}")
            elif task.gpu:
                self.say(f"{task.name} done")
        return bool(ended)

    def _stop(self) -> None:
        """Stop all tasks, which write their checkpoints; kill those that do not end in time."""
        for handle in self._alive():
            handle.stop()
        end = time.monotonic() + GRACE
        while self._alive() and time.monotonic() < end:
            time.sleep(POLL)
        for handle in self._alive():
            handle.kill()
        self._running.clear()

    def _alive(self) -> list[Any]:
        """Return the handles of running tasks."""
        return [handle for *_, handle in self._running.values() if handle.poll() is None]


def read_last_line(log: Path) -> str:
    """Return the last line of a task's output."""
    if log.exists():
        return log.read_text(errors="replace").strip().rpartition("\n")[2].strip()
    return ""

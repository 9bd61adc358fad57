"""Hands units out: trainings and throws in the training simulator to devices, throws on the
reference plant to CPU cores.

What is handed out is a task: a training with its own policy's throws in the training simulator
behind it, or one batch on a reference plant. Tasks run in processes of their own (:class:`Local`)
or as jobs of a cluster (:class:`visthrow.paper.sweep.cluster.Cluster`); a process that was
killed costs what it had not yet written, and no more."""

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
POLL = 0.3  # between two looks at what runs [s]
GRACE = 90.0  # for a stopped process to write its checkpoint [s]
BUSY_PAUSE = 5.0  # before a unit that another process has is looked at again [s]


@dataclass(frozen=True)
class Task:
    """Units that one process does in turn."""

    name: str
    ids: tuple[str, ...]
    gpu: bool  # goes to one of the devices; else to a CPU core

    def log(self, out: Path) -> Path:
        """Return the process's output."""
        return out / "logs" / f"{self.name.replace('/', '_')}.txt"


class Process(subprocess.Popen):
    """A task in a process of this machine; it stops by itself when this one dies (see ``visthrow
    sweep work``).
    """

    def stop(self) -> None:
        self.send_signal(signal.SIGINT)


@dataclass
class Local:
    """Starts tasks on this machine."""

    list_name: str
    out: Path
    devices: list[str]
    jobs: int
    changes: Changes

    def start(self, task: Task, device: str, minutes: float) -> Process:
        environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
        if device.startswith("cuda"):
            # the process sees its own GPU alone, and puts no context on the others
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
    """The work that a call did: units by name."""

    failed: dict[str, str] = field(default_factory=dict)  # task -> last line of its log
    stopped: bool = False  # before everything was done
    interrupted: bool = False  # by Ctrl-C or SIGTERM, not by the clock


def tasks(work: SweepWork, out: Path, done: set[str]) -> Iterator[Task]:
    """Return the remaining work that can start now, the most important first; ids that are found to
    be done are added to ``done``.
    """

    def is_remaining(unit: ResultSource | ThrowUnit) -> bool:
        if unit.id not in done and unit.done(out):
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
    """Keeps devices and cores busy until a list is done, the time is up or a stop is requested.

    Its ``starter`` has ``devices``, for one task at once on each, ``jobs``, for so many on CPU
    cores, and ``start(task, device, minutes)``, minutes infinite where no end is set. What that
    returns has ``poll()`` for the exit status, None while it runs, ``stop()`` to write what it has
    and end, and ``kill()``."""

    def __init__(self, work: SweepWork, out: Path, starter: Any, say: Callable[[str], None]):
        self.work = work
        self.out = out
        self.starter = starter
        self.say = say
        self.outcome = Outcome()
        self._done = set()
        self._todo = []
        # devices and cores that are free, by whether a task goes to one of the devices
        self._free = {True: list(starter.devices), False: ["cpu"] * starter.jobs}
        self._running: dict[str, tuple[Task, str, Any]] = {}
        self._wait: dict[str, float] = {}  # task -> time before which it is not tried again

    def run(self, minutes: float | None = None) -> Outcome:
        """Work; returns when nothing is left, or ``minutes`` have passed, or after Ctrl-C."""
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
        """Start what there is room for."""
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
        """Take note of what ended; whether anything did."""
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
        """Have everything write its checkpoint and end."""
        for handle in self._alive():
            handle.stop()
        end = time.monotonic() + GRACE
        while self._alive() and time.monotonic() < end:
            time.sleep(POLL)
        for handle in self._alive():
            handle.kill()
        self._running.clear()

    def _alive(self) -> list[Any]:
        """Handles of what runs."""
        return [handle for *_, handle in self._running.values() if handle.poll() is None]


def read_last_line(log: Path) -> str:
    """Return the last line of what a task printed."""
    if log.exists():
        return log.read_text(errors="replace").strip().rpartition("\n")[2].strip()
    return ""

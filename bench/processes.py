"""Runs and fakes in separate processes: the measured program is the command that flies."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.fakes import KINDS
from visthrow.common.arguments import EXIT_INTERRUPTED
from visthrow.common.errors import VisthrowError

ENDED = 120.0
"""Longest time for a run to end after a signal [s]."""

CONFIGS = {"ardupilot": "fake", "px4": "fake_px4", "betaflight": "fake_betaflight"}
"""Of a run against each kind of fake."""

COMMAND = (sys.executable, "-m", "visthrow.cli", "hil")


_given: set[int] = set()
_giving = threading.Lock()


def free_port(kind: int = socket.SOCK_DGRAM) -> int:
    """A free port of this machine, UDP or TCP, that this process did not get before."""
    with _giving:
        while True:
            with socket.socket(socket.AF_INET, kind) as probe:
                probe.bind(("127.0.0.1", 0))
                port = probe.getsockname()[1]
            if port not in _given:
                _given.add(port)
                return port


def assign_cores(jobs: int) -> list[tuple[int | None, int | None]]:
    """Assign cores to run and fake of each concurrent pair; None where there are too few for two
    each and one to spare.
    """
    usable = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    if len(usable) <= 2 * jobs:
        return [(None, None)] * jobs
    return [(usable[2 * job], usable[2 * job + 1]) for job in range(jobs)]


def side_by_side(
    what: Callable[[Any, Any], Any], items: Iterable[Any], places: Sequence[Any]
) -> Iterator[Any]:
    """Process each item in a thread and yield results as they finish; one item at a time per place.

    After an error no further item starts.
    """
    free = list(reversed(places))
    todo = iter(items)
    running = {}
    with ThreadPoolExecutor(len(places)) as pool:
        while True:
            while free and (item := next(todo, None)) is not None:
                place = free.pop()
                running[pool.submit(what, item, place)] = place
            if not running:
                return
            for future in wait_for(running, return_when=FIRST_COMPLETED).done:
                free.append(running.pop(future))
                yield future.result()


@dataclass(frozen=True)
class Pair:
    """A run against a fake.

    Attributes:
        run: further arguments of ``visthrow hil run``. fake: of ``visthrow hil fake``.
        core, fake_core: that each is kept on; None leaves it to the system.
        orderly: Ctrl-C ends both in order, and the partial result is returned.
        kind: of autopilot; Betaflight's fake is there first, since it listens.
        spoiled: name and time of a fault of the fake's motion capture; see `tests.mocap_faults`.
    """

    run: tuple[str, ...]
    fake: tuple[str, ...]
    core: int | None = None
    fake_core: int | None = None
    orderly: bool = False
    kind: str = "ardupilot"
    spoiled: tuple[str, ...] = ()

    def fly(
        self, folder: Path, watch: Callable[[int], None] | None = None, alone: bool = False
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start both, wait until the fake is done, end the run.

        Args:
            folder: of the run; not there yet.
            watch: called twice a second with the run's process id.
            alone: the fake continues to its end though the run has ended, or was killed, before.

        Returns:
            The run's summary, with whether it was ``interrupted``, empty where it was killed, and
            the fake's report.

        Raises:
            VisthrowError: one of them did not start, or did not end; the message holds its output.
        """
        port = free_port()
        msp = free_port(socket.SOCK_STREAM)
        report = folder.with_suffix(".fake.json")
        folder.parent.mkdir(parents=True, exist_ok=True)
        run = [
            *COMMAND,
            "run",
            "--config",
            CONFIGS[self.kind],
            "--set",
            f'link.device="udp:127.0.0.1:{port}"',
            "--auto-arm",
            "--bare",
        ]
        run += [
            "--set",
            f'betaflight.device="tcp:127.0.0.1:{msp}"',
            "--out",
            str(folder),
            *self.run,
        ]
        command = (
            [sys.executable, "-m", "tests.mocap_faults", *self.spoiled, "hil"]
            if self.spoiled
            else COMMAND
        )
        fake = [
            *command,
            "fake",
            "--kind",
            KINDS[self.kind],
            "--device",
            f"udpout:127.0.0.1:{port}",
            "--msp-port",
            str(msp),
        ]
        fake += ["--out", str(report), *self.fake]
        with contextlib.ExitStack() as both:
            if self.kind == "betaflight":
                other = both.enter_context(self._start(fake, self.fake_core))
                _read_first_line(other, "the fake")
            runner = both.enter_context(self._start(run, self.core))
            ready_line = _read_first_line(runner, "ready after")
            if self.kind != "betaflight":
                other = both.enter_context(self._start(fake, self.fake_core))
            interrupted = self._until(other, watch, runner, alone)
            killed = _end(runner, ready_line, alone)
        try:
            summary = (
                {} if killed else json.loads((folder / "summary.json").read_text(encoding="utf-8"))
            )
            summary |= {} if killed else {"interrupted": interrupted}
            return summary, json.loads(report.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise VisthrowError(
                f"a process of the pair ended without its report: {error}"
            ) from error
        finally:
            report.unlink(missing_ok=True)

    def _until(
        self,
        fake: subprocess.Popen,
        watch: Callable[[int], None] | None,
        runner: subprocess.Popen,
        alone: bool,
    ) -> bool:
        """Wait for the fake's end; returns whether Ctrl-C caused it."""
        try:
            _wait_for_end(fake, watch, runner, alone)
        except KeyboardInterrupt:
            if not self.orderly:
                raise
            fake.send_signal(signal.SIGINT)
            fake.wait(ENDED)
            return True
        return False

    @contextlib.contextmanager
    def _start(self, command: list[str], core: int | None) -> Iterator[subprocess.Popen]:
        quiet = subprocess.DEVNULL
        process = subprocess.Popen(
            command,
            stdin=quiet,
            stdout=quiet,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=self.orderly,  # the terminal's Ctrl-C is for us alone
        )
        try:
            if core is not None:  # long before it has threads
                os.sched_setaffinity(process.pid, {core})
            yield process
        finally:
            if process.poll() is None:
                process.kill()
            process.wait()


def _read_first_line(process: subprocess.Popen, expected: str) -> str:
    """The line that a process prints when it is ready."""
    line = process.stderr.readline()
    if not line.startswith(expected):
        raise VisthrowError(f"the run did not start: {line}{process.stderr.read()}")
    return line


def _wait_for_end(
    fake: subprocess.Popen,
    watch: Callable[[int], None] | None,
    runner: subprocess.Popen,
    alone: bool,
) -> None:
    while fake.poll() is None:
        gone = runner.poll() is not None
        if gone and not alone:  # aborted, for example: the fake writes its report
            fake.send_signal(signal.SIGINT)
            fake.wait(ENDED)
            return
        if watch is not None and not gone:
            watch(runner.pid)
        with contextlib.suppress(subprocess.TimeoutExpired):
            fake.wait(0.5)
    if fake.returncode:
        raise VisthrowError(f"the fake failed: {fake.stderr.read()}")


def _end(runner: subprocess.Popen, ready_line: str, alone: bool) -> bool:
    """Stop a run that still flies after its fake has ended.

    Returns whether the run had been killed, which is allowed with ``alone``.
    """
    if runner.poll() is None:
        runner.send_signal(signal.SIGINT)
    try:
        _, text = runner.communicate(timeout=ENDED)
    except subprocess.TimeoutExpired as error:
        raise VisthrowError(
            f"the run did not end within {ENDED:g} s after the signal: {ready_line}"
        ) from error
    if alone and runner.returncode == -signal.SIGKILL:
        return True
    # 1: aborted by the signal; interrupted: it had just ended as the signal came. Its summary has
    # the details.
    if runner.returncode not in (0, 1, EXIT_INTERRUPTED, -signal.SIGINT):
        raise VisthrowError(f"the run failed with status {runner.returncode}: {text}")
    return False


class Memory:
    """Resident memory of a process over time."""

    def __init__(self) -> None:
        """Start without a sample."""
        self.samples: list[tuple[float, float]] = []  # [s], [bytes]

    def __call__(self, pid: int) -> None:
        """Take a sample; none where the system does not report memory."""
        with contextlib.suppress(OSError, ValueError, IndexError):
            pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
            self.samples.append((time.monotonic(), float(pages * os.sysconf("SC_PAGE_SIZE"))))

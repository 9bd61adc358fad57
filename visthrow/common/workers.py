"""Run computations in separate processes.

Results are yielded as they finish. The processes end after an error, on Ctrl-C, or when the context
is left early. To resume interrupted work, a caller saves each result and skips existing ones."""

import multiprocessing as mp
import pickle
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from multiprocessing.connection import wait
from typing import Any

from visthrow.common.errors import VisthrowError

POLL_PERIOD = 0.5  # time between updates of the progress [s]


def status(text: str) -> None:
    """Replace the terminal's last line by a text; an empty text clears it. Without a terminal do
    nothing.
    """
    if sys.stderr.isatty():
        print(f"\r{text:<78}", end="" if text else "\r", file=sys.stderr, flush=True)


class Workers:
    """Processes that start their tasks at once, in order; a context manager that ends them.

    Iterating yields the index and the result of each task as they finish.
    """

    def __init__(
        self, function: Callable[[Any], Any], tasks: Iterable[Any], processes: int, label: str = ""
    ):
        """Start the processes.

        Args:
            function: function of a task, importable by its name; it may call :func:`progress`.
            tasks: arguments of the function.
            processes: largest number of processes.
            label: label of a progress line on the terminal; empty for no line.
        """
        tasks = list(tasks)
        context = mp.get_context("spawn")
        self.label = label
        self._running = {}
        self._taken = context.Value("i", 0)
        self._shares = context.Array("d", len(tasks), lock=False)
        # pickled here, as multiprocessing's pickler would send tensors as shared memory
        work = pickle.dumps((function, tasks))
        for _ in range(min(processes, len(tasks))):
            ours, theirs = context.Pipe(duplex=False)
            process = context.Process(
                target=_serve, args=(theirs, work, self._taken, self._shares), daemon=True
            )
            process.start()
            theirs.close()
            self._running[ours] = process

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._running.values():
            process.terminate()
        for process in self._running.values():
            process.join()

    def __iter__(self) -> Iterator[tuple[int, Any]]:
        busy = list(self._running)
        begin = time.monotonic()
        while busy:
            share = sum(self._shares) / len(self._shares)
            if share > 0.02:
                remaining = f", about {(time.monotonic() - begin) * (1 / share - 1):.0f} s left"
            else:
                remaining = ""
            if self.label:
                status(f"{self.label}: {100 * share:3.0f} %{remaining}")
            for end in wait(busy, POLL_PERIOD):
                try:
                    index, result = end.recv()
                except EOFError:
                    self._running[end].join()
                    raise VisthrowError(
                        f"a worker process ended with status {self._running[end].exitcode}"
                    ) from None
                if isinstance(index, int):
                    yield index, result
                elif result is None:
                    busy.remove(end)
                else:
                    raise result
        if self.label:
            status("")


def run_tasks(
    function: Callable[[Any], Any], tasks: Iterable[Any], processes: int = 1, label: str = ""
) -> Iterator[tuple[int, Any]]:
    """Yield the index and the result of each task as they finish; a single process or task runs in
    this process, without a progress line.
    """
    tasks = list(tasks)
    if processes <= 1 or len(tasks) <= 1:
        yield from ((index, function(task)) for index, task in enumerate(tasks))
    else:
        with Workers(function, tasks, processes, label) as workers:
            yield from workers


_shares: Any = None
_index = 0


def progress(share: float) -> None:
    """Report the finished share of a task; outside a worker do nothing."""
    if _shares is not None:
        _shares[_index] = share


def _serve(end: Any, work: bytes, taken: Any, shares: Any) -> None:
    """Run tasks and send (index, result) for each, then (None, None), or (None, error) after an
    error.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
    import torch

    global _shares, _index
    torch.set_num_threads(1)
    _shares = shares
    try:
        function, tasks = pickle.loads(work)
        while True:
            with taken.get_lock():
                _index = taken.value
                taken.value = taken.value + 1
            if _index >= len(tasks):
                end.send((None, None))
                return
            end.send((_index, function(tasks[_index])))
            progress(1.0)
    except Exception as error:
        error.add_note(f"in a worker process:\n{traceback.format_exc()}")
        end.send((None, error))

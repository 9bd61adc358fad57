"""Parallel launches of kernels on CPU cores. A launch uses one thread and releases the interpreter
lock.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache


def cores() -> int:
    """Return the number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def launch_in_pieces(
    launch: Callable[[int, int], None], marks: Sequence[int], threads: int
) -> None:
    """Call ``launch(first, last)`` for the rows between each pair of neighbouring marks, on several
    threads including this one, and wait for all.

    Args:
        launch: processes rows independently of each other, so that the result is bitwise equal to
            that of a single call.
        marks: ascending, from 0 to the number of rows.
        threads: largest number of threads.
    """
    stretches = iter(list(zip(marks[:-1], marks[1:])))

    def work() -> None:
        for first, last in stretches:
            launch(first, last)

    helpers = [_pool(threads).submit(work) for _ in range(min(threads, len(marks) - 1) - 1)]
    try:
        work()
    finally:
        for helper in helpers:
            helper.result()


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Return the pool of helper threads, which is reused for all launches."""
    return ThreadPoolExecutor(threads, "launch")


if hasattr(os, "register_at_fork"):
    # a child process has none of these threads
    os.register_at_fork(after_in_child=_pool.cache_clear)

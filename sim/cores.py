"""CPU cores, and kernels spread over them: a launch runs on one thread, and leaves the interpreter
free meanwhile.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def launch_in_pieces(
    launch: Callable[[int, int], None], marks: Sequence[int], threads: int
) -> None:
    """Call ``launch(first, last)`` for each stretch between two marks, so many at a time, this
    thread's among them; wait for all.

    Args:
        launch: of rows that depend on no others; together they leave the bits that one call for all
            would.
        marks: ascending, from 0 to the number of rows.
        threads: at most.
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
    """Threads that launch pieces beside the caller's; kept, since there are thousands
    of launches.
    """
    return ThreadPoolExecutor(threads, "launch")


if hasattr(os, "register_at_fork"):
    # a child process has none of these threads
    os.register_at_fork(after_in_child=_pool.cache_clear)

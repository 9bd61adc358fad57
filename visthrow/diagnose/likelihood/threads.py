"""Threads of the linear algebra.

Matrices have some hundred rows, so several threads would slow a matrix product down. Each product
uses one thread, and windows are distributed over the cores where their products are long. Short
products stay on one thread: passing Python's lock takes as long as they do."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from sim.cores import cores as cores

R = TypeVar("R")

THREADS = 4  # with 8, a diagnosis on 16 cores took an eighth longer, because of Python's lock
PIECES = 4  # pieces of work for each thread


def limit_to_one_thread() -> None:
    """Limit the BLAS libraries that this process has loaded, of numpy and scipy, to one thread."""
    import scipy.linalg  # noqa: F401

    threadpool_limits(1)


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "algebra", limit_to_one_thread)


def parallel_map(function: Callable[..., R], *columns: Iterable[Any]) -> list[R]:
    """Map a function over items, in order, on all cores; no call may wait for another one.

    ``columns``: one for each argument, as for the built-in ``map``.
    """
    items = list(zip(*columns))
    threads = min(cores(), THREADS)
    if min(threads, len(items)) < 2:
        return [function(*item) for item in items]
    pieces = min(
        PIECES * threads, len(items)
    )  # submitting items one by one would cost as much as computing small ones
    parts = _pool(threads).map(
        lambda first: [function(*item) for item in items[first::pieces]], range(pieces)
    )
    results: list[R] = [None] * len(items)
    for first, part in enumerate(parts):
        results[first::pieces] = part
    return results

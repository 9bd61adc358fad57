"""Threads of the linear algebra: its matrices are of some hundred rows, on which several threads a
product wait for each other.

So each product has one thread, and windows are spread over the cores."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from sim.cores import cores as cores

T = TypeVar("T")
R = TypeVar("R")

THREADS = 4  # threads: with 8, a diagnosis on 16 cores waited an eighth longer, for Python itself
PIECES = 4  # of what is to be done, for each thread


def limit_to_one_thread() -> None:
    """Give a product one thread from now on, in numpy, scipy and whatever else of the kind this
    process has loaded.
    """
    import scipy.linalg  # noqa: F401

    threadpool_limits(1)


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "algebra", limit_to_one_thread)


def parallel_map(function: Callable[..., R], *columns: Iterable[Any]) -> list[R]:
    """Map a function over items, in order, on all cores; no call may wait for another of these.

    ``columns``: one for each argument, as the built-in ``map`` takes them.
    """
    items = list(zip(*columns))
    threads = min(cores(), THREADS)
    if min(threads, len(items)) < 2:
        return [function(*item) for item in items]
    pieces = min(
        PIECES * threads, len(items)
    )  # each item by itself would cost as much as the small ones take
    parts = _pool(threads).map(
        lambda first: [function(*item) for item in items[first::pieces]], range(pieces)
    )
    results: list[R] = [None] * len(items)
    for first, part in enumerate(parts):
        results[first::pieces] = part
    return results

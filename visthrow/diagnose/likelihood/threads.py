"""Threads and memory of the linear algebra: its matrices are of some hundred rows, on which several
threads a product wait for each other.

So each product has one thread, and windows are spread over the cores. Thousands of arrays of a few
hundred kilobytes are taken and freed."""

import ctypes
import gc
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
TRIM_THRESHOLD = -1  # options of ``mallopt``, as glibc's ``malloc.h`` numbers them
MMAP_THRESHOLD = -3
BYTES_KEPT = 2**31 - 1  # bytes at the top of the heap, up to which none go back to the system
# bytes from which an array has a mapping of its own, which goes back when it is freed
MAPPED = 2**30


@cache
def keep_freed_memory() -> None:
    """Let this process keep what it frees for what it takes next, and look for garbage among new
    objects alone.

    By default glibc gives large arrays' pages back to the system and faults them in anew: of looks
    at noise levels, one after the other, half the time was the kernel's. A third of a million
    objects of the modules are never garbage."""
    gc.freeze()
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another C library
        return
    mallopt(MMAP_THRESHOLD, MAPPED)
    mallopt(TRIM_THRESHOLD, BYTES_KEPT)


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

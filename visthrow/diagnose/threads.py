"""Threads of the linear algebra: its matrices are of some hundred rows, on which several threads a product wait for each other.

So each product has one thread, and windows are spread over the cores.
"""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

from sim.cores import cores as cores

T = TypeVar("T")
R = TypeVar("R")

VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
MOST = 8  # threads, beyond which Python's own share of the work is all that is left


def single() -> None:
    """Ask for one thread a product unless the user said otherwise; works before numpy is imported."""
    for name in VARIABLES:
        os.environ.setdefault(name, "1")


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(min(cores(), MOST), "algebra")


def each(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """The function of every item, in order, on all cores; no call may wait for another of these."""
    items = list(items)
    if min(cores(), len(items)) < 2:
        return [function(item) for item in items]
    return list(_pool().map(function, items))

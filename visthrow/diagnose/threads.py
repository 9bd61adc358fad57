"""Threads of the linear algebra: one. Its matrices are of some hundred rows, on which threads wait for each other."""

import os

VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def single() -> None:
    """Ask for one thread unless the user said otherwise; works before numpy is imported."""
    for name in VARIABLES:
        os.environ.setdefault(name, "1")

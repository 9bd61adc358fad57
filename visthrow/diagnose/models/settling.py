"""Fits what is not known at the start of windows to their samples, all windows at once.

So linearisations are about paths near the measured ones. Unknowns are in their prior deviations,
from the middle of the prior."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy import ndarray

STEPS = 8  # Gauss-Newton steps at most, with the same derivatives
SETTLED = 1e-3  # a step that promises less than this [nats] is not tried
SHORTER = 0.3  # share of a step that is tried after one that did not help


def settle(
    fly: Callable[[ndarray], list[ndarray]], rows: Sequence[ndarray], unknowns: ndarray
) -> ndarray:
    """Fit unknowns by Gauss-Newton steps; each window takes those that lower its cost.

    Args:
        fly: returns the windows' residuals from unknowns, in their deviations, shape (N,) each.
        rows: derivatives of the windows' samples by the unknowns, likewise, shape (N, D) each.
        unknowns: to begin with, shape (W, D).
    """
    off = fly(unknowns)
    costs = _costs(off, unknowns)
    reach = np.ones(len(unknowns))
    for _ in range(STEPS):
        steps = np.array(list(map(_step, rows, off, unknowns)))
        if not np.any(steps):
            break
        trial = unknowns + reach[:, None] * steps
        flown = fly(trial)
        trial_costs = _costs(flown, trial)
        better = trial_costs < costs
        off = [new if helps else old for helps, new, old in zip(better, flown, off)]
        unknowns = np.where(better[:, None], trial, unknowns)
        costs = np.where(better, trial_costs, costs)
        reach = np.where(better, 1.0, SHORTER * reach)
    return unknowns


def newton(rows: ndarray, off: ndarray, at: ndarray | float = 0.0) -> ndarray:
    """Return the Gauss-Newton step of unknowns from where they are, shape (D,).

    ``rows``: derivatives of what is ``off``, the residual in its deviations, shape (N, D)."""
    information = rows.T @ rows + np.eye(rows.shape[1])
    step: ndarray = np.linalg.lstsq(information, rows.T @ off - at, rcond=None)[0]
    return step


def _step(rows: ndarray, off: ndarray, at: ndarray) -> ndarray:
    """Return the Gauss-Newton step of a window; 0 where it promises little."""
    none = np.zeros(len(at))
    if not (np.all(np.isfinite(off)) and np.all(np.isfinite(rows))):
        return none  # no step mends that; the search says which window it is
    step = newton(rows, off, at)
    promised = 0.5 * step @ (rows.T @ off - at)
    return step if promised > SETTLED else none


def _costs(off: Sequence[ndarray], unknowns: ndarray) -> ndarray:
    """Return the sum of squares of each window; infinite where a simulation ran away."""
    costs = np.array([part @ part for part in off]) + np.sum(unknowns**2, axis=1)
    return np.where(np.isnan(costs), np.inf, costs)

"""Fits what is not known at the start of windows to their samples, all windows at once.

So linearisations are about paths near the measured ones. Unknowns are in their prior deviations,
from the middle of the prior."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy import ndarray

STEPS = 5  # Gauss-Newton steps with the same derivatives
# a step that promises less than this [nats] is not tried
SETTLED = 1e-3
SHARES = 1.0, 0.3  # of a step, which are tried in turn


def settle(
    fly: Callable[[ndarray], list[ndarray]],
    slopes: Sequence[ndarray],
    spread: Sequence[ndarray],
    unknowns: ndarray,
) -> tuple[ndarray, list[ndarray]]:
    """Fit unknowns by Gauss-Newton steps; each window takes those that lower its cost.

    Returns the unknowns, and the residuals that they leave.

    Args:
        fly: returns the windows' residuals from unknowns, shape (N,) each.
        slopes: derivatives of the windows' samples by the unknowns, shape (N, D) each.
        spread: deviation of the samples from a right simulation, shape (N,) each.
        unknowns: to begin with, shape (W, D).
    """
    rows = [slope / sigma[:, None] for slope, sigma in zip(slopes, spread)]
    residuals = fly(unknowns)
    costs = _costs(residuals, spread, unknowns)
    for _ in range(STEPS):
        parts = zip(rows, residuals, spread, unknowns)
        steps = np.array([_step(row, r / sigma, at) for row, r, sigma, at in parts])
        before = costs
        for share in SHARES:
            if not np.any(steps):
                break
            trial = unknowns + share * steps
            flown = fly(trial)
            trial_costs = _costs(flown, spread, trial)
            better = trial_costs < costs
            residuals = [new if x else old for x, new, old in zip(better, flown, residuals)]
            unknowns = np.where(better[:, None], trial, unknowns)
            costs = np.where(better, trial_costs, costs)
            steps = np.where(better[:, None], 0.0, steps)
        if np.all(costs > before - 2.0 * SETTLED):
            break
    return unknowns, residuals


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


def _costs(residuals: Sequence[ndarray], spread: Sequence[ndarray], unknowns: ndarray) -> ndarray:
    """Return the sum of squares of each window; infinite where a simulation ran away."""
    squares = [np.sum((r / sigma) ** 2) for r, sigma in zip(residuals, spread)]
    costs = np.array(squares) + np.sum(unknowns**2, axis=1)
    return np.where(np.isnan(costs), np.inf, costs)

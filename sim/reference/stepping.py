"""Runge-Kutta steps of order 4 that halve themselves where a rope snaps.

A rope that snaps taut stiffens within a step: its transverse modes rise with the root of the tension. Each step reads
the frequency that its own two middle stages show and how far a segment turned; environments beyond the limits repeat
the step as two halves.
"""

from collections.abc import Callable

import numpy as np

LARGEST_PHASE = 0.9
"""Frequency times step beyond which a step is halved [rad]; classical RK4 is stable to 2.83."""
LARGEST_TURN = 0.25
"""Turn of a segment within one step beyond which it is halved [rad]; RK4 then errs by about 0.25^5 / 120 = 8e-6 rad."""
MOST_HALVINGS = 6


def rk4(rates: Callable[[np.ndarray], np.ndarray], state: np.ndarray, step: float | np.ndarray) -> np.ndarray:
    """Take one classical Runge-Kutta step of order 4.

    Args:
        rates: function from state to its time derivative.
        state: shape (E, N).
        step: [s], a number or shape (E, 1).
    """
    k1 = rates(state)
    k2 = rates(state + 0.5 * step * k1)
    k3 = rates(state + 0.5 * step * k2)
    k4 = rates(state + step * k3)
    return state + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def halving_rk4(
    rates: Callable[[np.ndarray, np.ndarray], np.ndarray],
    state: np.ndarray,
    step: np.ndarray,
    direction: slice,
    velocity: slice,
    depth: int = 0,
) -> np.ndarray:
    """Take one step of order 4 in each environment, in halves, quarters .. where the rope asks for it.

    Args:
        rates: function from state and step to the state's time derivative; rows with a step of 0 may stand still.
        state: shape (E, N).
        step: [s], shape (E,).
        direction: columns of the segments' directions.
        velocity: columns of their time derivatives.
        depth: halvings so far.
    """
    h = step[:, None]
    k1 = rates(state, step)
    k2 = rates(state + 0.5 * h * k1, step)
    k3 = rates(state + 0.5 * h * k2, step)
    k4 = rates(state + h * k3, step)
    after = state + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    # k2 and k3 belong to one time and to states 0.5 h (k2 - k1) apart: their ratio is the square of a frequency.
    apart = 0.5 * step * np.linalg.norm((k2 - k1)[:, direction], axis=1)
    pull = np.linalg.norm((k3 - k2)[:, velocity], axis=1)
    phase = step * np.sqrt(pull / np.maximum(apart, 1e-12))
    turn = step * np.sqrt(np.max(np.square(after[:, velocity]).reshape(len(state), -1, 3).sum(-1), axis=1))
    fine = (phase <= LARGEST_PHASE) & (turn <= LARGEST_TURN)  # false for NaN too
    coarse = ~fine & (step > 0.0)
    if depth < MOST_HALVINGS and np.any(coarse):
        half = np.where(coarse, 0.5 * step, 0.0)
        for _ in range(2):
            state = halving_rk4(rates, state, half, direction, velocity, depth + 1)
        after[coarse] = state[coarse]
    return after

"""Division of a control period into steps between events, and adaptive Runge-Kutta steps of order
4.

A rope that snaps taut stiffens within a step: the frequencies of its transverse modes are
proportional to the square root of the tension. Each step estimates the frequency from its two
middle stages, and the largest rotation of a segment. Environments in which one of them exceeds its
limit repeat the step as two halves."""

from collections.abc import Callable

import numpy as np
from numpy import ndarray

from sim.reference.rotation_arrays import length
from sim.reference.vehicle_blocks import TIME_TOLERANCE

# frequency times step beyond which a step is halved [rad]; classical RK4 is stable to 2.83
LARGEST_PHASE = 0.9
# rotation of a segment in one step beyond which the step is halved [rad]; the error of RK4 is then
# about 0.25^5 / 120 = 8e-6 rad
LARGEST_TURN = 0.25
MOST_HALVINGS = 6


def halving_rk4(
    rates: Callable[[ndarray, ndarray], ndarray],
    state: ndarray,
    step: ndarray,
    direction: slice,
    velocity: slice,
    depth: int = 0,
) -> ndarray:
    """Take one step of order 4 in each environment, divided into halves, quarters, ... where the
    rope requires it.

    Args:
        rates: function from state and step to the state's time derivative, which may be 0 in rows
            with a step of 0.
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
    # k2 and k3 are evaluated at the same time, at states 0.5 h (k2 - k1) apart: the ratio of the
    # differences is the square of a frequency.
    difference = 0.5 * step * length(k2[:, direction] - k1[:, direction])[:, 0]
    pull = length(k3[:, velocity] - k2[:, velocity])[:, 0]
    phase = step * np.sqrt(pull / np.maximum(difference, 1e-12))
    speeds = np.square(after[:, velocity]).reshape(len(state), -1, 3).sum(-1)
    turn = step * np.sqrt(np.max(speeds, axis=1))
    fine = (phase <= LARGEST_PHASE) & (turn <= LARGEST_TURN)  # false for NaN too
    coarse = ~fine & (step > 0.0)
    if depth < MOST_HALVINGS and np.any(coarse):
        half = np.where(coarse, 0.5 * step, 0.0)
        for _ in range(2):
            state = halving_rk4(rates, state, half, direction, velocity, depth + 1)
        after[coarse] = state[coarse]
    return after


def segments_of_period(edges: list[list[float]], step: float) -> ndarray:
    """Divide the spans between events into equal steps.

    Args:
        edges: times of each environment's events in any order, including start and end [s].
        step: largest step [s].

    Returns:
        Steps [s], shape (E, S), padded with zeros.
    """
    rows = []
    for times in edges:
        row: list[float] = []
        ordered = np.sort(np.array(times))
        for span in np.diff(ordered):
            if span > TIME_TOLERANCE:
                count = int(np.ceil(span / step - 1e-6))
                row += [span / count] * count
        rows.append(row)
    longest = max(len(row) for row in rows)
    return np.array([row + [0.0] * (longest - len(row)) for row in rows])


def crossing(
    pos_0: ndarray,
    vel_0: ndarray,
    pos_1: ndarray,
    vel_1: ndarray,
    step: float,
    height: float,
) -> tuple[float, ndarray]:
    """Find where a path crosses a height downwards, by the cubic Hermite curve of a step.

    Args:
        pos_0: at the start of the step [m], shape (3,).
        vel_0: [m/s], shape (3,).
        pos_1: at its end [m], shape (3,); at or below ``height``.
        vel_1: [m/s], shape (3,).
        step: [s].
        height: [m].

    Returns:
        Share of the step, 0 to 1, and the point [m], shape (3,).
    """

    def path(s: float) -> ndarray:
        early = (1.0 - s) * (step * vel_0 - way)
        late = s * (step * vel_1 - way)
        return pos_0 + s * way + s * (1.0 - s) * (early - late)

    if pos_0[2] <= height:
        return 0.0, pos_0
    way = pos_1 - pos_0
    low = 0.0
    high = 1.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if path(middle)[2] > height else (low, middle)
    return high, path(high)

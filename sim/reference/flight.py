"""Times of events: how a control period is cut into steps, and when a payload passes the landing height."""

import numpy as np

from sim.reference.blocks import TIME_TOLERANCE


def segments_of_period(edges: list[list[float]], step: float) -> np.ndarray:
    """Cut the spans between events into equal steps.

    Args:
        edges: times of the events of each environment in any order, start and end among them [s].
        step: largest step [s].

    Returns:
        Steps [s], shape (E, S); zeros where an environment needs fewer than the one that needs most.
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
    pos_0: np.ndarray, vel_0: np.ndarray, pos_1: np.ndarray, vel_1: np.ndarray, step: float, height: float
) -> tuple[float, np.ndarray]:
    """Find where a path passes a height going down, by the cubic through both ends of a step.

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

    def path(s: float) -> np.ndarray:
        bend = s * (1.0 - s)
        straight = pos_0 + s * (pos_1 - pos_0)
        return straight + bend * ((1.0 - s) * (step * vel_0 - (pos_1 - pos_0)) - s * (step * vel_1 - (pos_1 - pos_0)))

    low, high = 0.0, 1.0
    if pos_0[2] <= height:
        return 0.0, pos_0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if path(middle)[2] > height else (low, middle)
    return high, path(high)

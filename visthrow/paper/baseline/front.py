"""Settings of the sweep that trades agility for accuracy, and the hypervolume of its front."""

import numpy as np

SPEEDS = (1.7, 2.2, 2.5, 2.9)  # release speeds of the sweep [m/s]; the paper's are 1.7 and 2.2

WEIGHTS = ((1e6, 0.005), (200e3, 0.005), (50e3, 0.005), (30e3, 0.01), (3e3, 0.3))
"""Duration and energy weights of the sweep; the last three are the paper's."""

FRONT_TARGET = 2.0  # target of the sweep (the paper, Table IV) [m]
FRONT_THROWS = 10  # throws for each setting, as in the paper

CORNER = (2.5, 0.5)  # reference point of hypervolumes: duration [s] and landing error [m]


def pareto(points: np.ndarray) -> np.ndarray:
    """Return the indices of the Pareto front of points (N, 2), both coordinates minimised, ordered
    by the first coordinate.
    """
    front = []
    best = np.inf
    for i in np.lexsort((points[:, 1], points[:, 0])):
        if points[i, 1] < best:
            front.append(int(i))
            best = points[i, 1]
    return np.array(front, dtype=int)


def hypervolume(points: np.ndarray, corner: tuple[float, float] = CORNER) -> float:
    """Return the area that points (N, 2), both coordinates minimised, dominate below a reference
    point [s m].
    """
    dominating = points[np.all(points < corner, axis=1)]
    front = dominating[pareto(dominating)]
    widths = np.diff(front[:, 0], append=corner[0])
    return float((widths * (corner[1] - front[:, 1])).sum())

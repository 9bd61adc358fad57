"""How two measurements of the same motion relate: delay, axes, sign, scale, or not at all."""

import itertools
from dataclasses import dataclass

import numpy as np

REACH = 0.4
"""Largest delay looked for [s]."""
_LONGEST_GRID = 60_000  # samples; longer stretches are thinned

AXES = [
    (order, signs) for order in itertools.permutations(range(3)) for signs in itertools.product((1.0, -1.0), repeat=3)
]  # fmt: skip
"""All 48 ways to exchange and turn around three axes, mirror images too."""

UNITS = {
    180 / np.pi: "one is in degrees", np.pi / 180: "one is in degrees", 1000.0: "one is in thousandths",
    1e-3: "one is in thousandths", 9.80665: "one is in g", 1 / 9.80665: "one is in g", 100.0: "one is in hundredths",
    0.01: "one is in hundredths",
}  # fmt: skip
"""Ratio -> what it gives away."""


@dataclass(frozen=True)
class Relation:
    """How ``second`` follows ``first``."""

    delay: float  # of the second behind the first [s]
    delay_sd: float  # [s]
    correlation: float  # at that delay, axes as they are, -1 to 1
    scale: float  # second over first
    axes: str  # best exchange of axes: what x, y, z of the second are in the first
    axes_correlation: float  # with that exchange
    mirror: bool  # whether that exchange is a mirror image


def on_grid(time: np.ndarray, values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Interpolate linearly; columns one by one."""
    return np.column_stack([np.interp(grid, time, column) for column in values.T])


def relate(time_a: np.ndarray, a: np.ndarray, time_b: np.ndarray, b: np.ndarray, reach: float = REACH) -> Relation | None:
    """Relate two signals of one or three components.

    Args:
        time_a: Stamps of the first [s].
        a: The first, shape (N, 1 or 3).
        time_b: Stamps of the second [s].
        b: The second, shape (M, 1 or 3).
        reach: Largest delay [s].

    Returns:
        None where they overlap too little or do not move.
    """
    start, end = max(time_a[0], time_b[0]) + reach, min(time_a[-1], time_b[-1]) - reach
    period = max(np.median(np.diff(time_a)), np.median(np.diff(time_b)))
    period = max(period, (end - start) / _LONGEST_GRID)
    count = int((end - start) / period)
    if count < 50:
        return None
    grid = start + period * np.arange(count)
    first = _centred(on_grid(time_a, a, grid))
    steps = int(reach / period)
    cross = np.zeros((a.shape[1], b.shape[1], 2 * steps + 1))
    power = float(np.sum(first**2))
    if power <= 0.0:
        return None
    norms = np.zeros(2 * steps + 1)
    for lag in range(-steps, steps + 1):
        second = _centred(on_grid(time_b, b, grid + lag * period))
        cross[:, :, lag + steps] = first.T @ second
        norms[lag + steps] = np.sum(second**2)
    if np.min(norms) <= 0.0:
        return None
    scale_of = np.sqrt(power * norms)
    own = np.trace(cross) / scale_of
    at = int(np.argmax(own))
    offset, curve = _peak(own, at)
    best, order, signs, best_at = -2.0, (0, 1, 2), (1.0, 1.0, 1.0), at
    if a.shape[1] == 3:
        for trial, sign in AXES:
            score = sum(s * cross[i, j] for j, (i, s) in enumerate(zip(trial, sign))) / scale_of
            if np.max(score) > best:
                best, order, signs, best_at = float(np.max(score)), trial, sign, int(np.argmax(score))
    else:
        turned = -own
        best_at = int(np.argmax(np.abs(own)))
        best, signs = float(np.abs(own[best_at])), (1.0 if own[best_at] > turned[best_at] else -1.0,)
    names = ",".join(f"{'-' if s < 0 else ''}{'xyz'[i]}" for i, s in zip(order, signs))
    even = order in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
    effective = max(count * min(1.0, 0.1 / max(period, 1e-3)), 10.0)
    noise = max(1.0 - own[at] ** 2, 1e-6) / effective
    sd = period * np.sqrt(noise / max(curve, 1e-9))
    scale = float(np.trace(cross[:, :, best_at] if best_at == at else cross[:, :, at])) / power
    return Relation(
        (at - steps + offset) * period, float(sd), float(own[at]), scale, names, best,
        bool((1.0 if even else -1.0) * np.prod(signs) < 0.0) and a.shape[1] == 3,
    )  # fmt: skip


def _centred(values: np.ndarray) -> np.ndarray:
    return values - np.mean(values, axis=0)


def _peak(score: np.ndarray, at: int) -> tuple[float, float]:
    """Vertex of the parabola through the peak and its neighbours, and its curvature [1/step^2]."""
    if not 0 < at < len(score) - 1:
        return 0.0, 1e-9
    left, top, right = score[at - 1 : at + 2]
    curve = 2 * top - left - right
    return (0.5 * (right - left) / curve if curve > 0.0 else 0.0), max(float(curve), 1e-9)


def unit_hint(ratio: float) -> str:
    """What a ratio of two measurements of one thing gives away, or nothing."""
    for known, words in UNITS.items():
        if abs(np.log(abs(ratio) / known)) < 0.12:
            return words
    return ""


def derivative(time: np.ndarray, values: np.ndarray, span: float = 0.06) -> tuple[np.ndarray, np.ndarray]:
    """Derivative over about ``span`` seconds, by straight lines through the samples in it; gaps are left out.

    Returns:
        Times [s] and derivatives.
    """
    if len(time) < 3:
        return np.empty(0), np.empty((0, *values.shape[1:]))
    reach = max(1, round(0.5 * span / float(np.median(np.diff(time)))))
    width = time[2 * reach :] - time[: -2 * reach]
    rate = (values[2 * reach :] - values[: -2 * reach]) / width[:, None]
    middle = 0.5 * (time[2 * reach :] + time[: -2 * reach])
    good = width < 2.5 * span
    return middle[good], rate[good]


def rates_of(time: np.ndarray, quat: np.ndarray, span: float = 0.06) -> tuple[np.ndarray, np.ndarray]:
    """Body rates from attitudes xyzw, over about ``span`` seconds.

    Returns:
        Times [s] and rates [rad/s], shape (N, 3).
    """
    if len(time) < 3:
        return np.empty(0), np.empty((0, 3))
    from scipy.spatial.transform import Rotation

    reach = max(1, round(0.5 * span / float(np.median(np.diff(time)))))
    width = time[2 * reach :] - time[: -2 * reach]
    turn = (Rotation.from_quat(quat[: -2 * reach]).inv() * Rotation.from_quat(quat[2 * reach :])).as_rotvec()
    good = width < 2.5 * span
    return (0.5 * (time[2 * reach :] + time[: -2 * reach]))[good], (turn / width[:, None])[good]

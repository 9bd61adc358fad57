"""How two measurements of the same motion relate: delay, axes, sign, scale, or not at all."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from visthrow.common.rotations import continuous
from visthrow.logs.axes import EVERY, MATRICES

REACH = 0.4  # largest delay looked for [s]
_NEAR = (
    0.25  # of the logarithm of a ratio from a unit's: noise dilutes, cables pull, filters smooth
)
_LONGEST_GRID = 60_000  # samples; longer stretches are thinned

INDEPENDENT = (
    0.1  # samples of a flight this far apart [s] count as independent where evidence is weighed
)

UNITS = {
    180 / np.pi: "one is in degrees",
    np.pi / 180: "one is in degrees",
    1000.0: "one is in thousandths",
    1e-3: "one is in thousandths",
    9.80665: "one is in g",
    1 / 9.80665: "one is in g",
    100.0: "one is in hundredths",
    0.01: "one is in hundredths",
}
"""Ratio -> what it gives away."""


@dataclass(frozen=True)
class Relation:
    """The relation of ``second`` to ``first``."""

    delay: float  # of the second behind the first [s]
    delay_sd: float  # [s]
    correlation: float  # at that delay, axes as they are, -1 to 1
    scale: float  # second over first
    axes: str  # best exchange of axes: what x, y, z of the second are in the first
    axes_correlation: float  # with that exchange
    axes_delay: float  # of the second behind the first with that exchange [s]
    nats: float  # by which that exchange beats the axes as they are, the choice among 48 paid for


def on_grid(time: np.ndarray, values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Interpolate linearly, column by column: values of shape (T, C) at times of shape (..., N),
    shape (..., N, C).
    """
    return np.stack([np.interp(grid, time, column) for column in values.T], -1)


def relate(
    time_a: np.ndarray, a: np.ndarray, time_b: np.ndarray, b: np.ndarray, reach: float = REACH
) -> Relation | None:
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
    if min(len(time_a), len(time_b)) < 2:
        return None
    start, end = max(time_a[0], time_b[0]) + reach, min(time_a[-1], time_b[-1]) - reach
    period = max(np.median(np.diff(time_a)), np.median(np.diff(time_b)))
    period = max(period, (end - start) / _LONGEST_GRID)
    count = int((end - start) / period)
    if count < 50:
        return None
    grid = start + period * np.arange(count)
    first = _centred(on_grid(time_a, a, grid))
    steps = int(reach / period)
    cross, norms = np.zeros((a.shape[1], b.shape[1], 2 * steps + 1)), np.zeros(2 * steps + 1)
    power = float(np.sum(first**2))
    for lag in range(-steps, steps + 1):
        second = _centred(on_grid(time_b, b, grid + lag * period))
        cross[:, :, lag + steps] = first.T @ second
        norms[lag + steps] = np.sum(second**2)
    if power <= 0.0 or np.min(norms) <= 0.0:
        return None
    scale_of = np.sqrt(power * norms)
    own = np.trace(cross) / scale_of
    at = int(np.argmax(own))
    offset, curve = peak(own, at)
    exchanges, matrices = (
        (EVERY, MATRICES) if a.shape[1] == 3 else (("x", "-x"), np.array([[[1.0]], [[-1.0]]]))
    )
    scores = np.einsum("kij,jil->kl", matrices, cross / scale_of)
    k, best_at = np.unravel_index(np.argmax(scores), scores.shape)
    best = float(scores[k, best_at])
    effective = max(count * min(1.0, period / INDEPENDENT), 10.0)
    sd = period * np.sqrt(max(1.0 - own[at] ** 2, 1e-6) / effective / max(curve, 1e-9))
    plain, turned = (min(max(c, 0.0), 0.999) for c in (own[at], best))
    nats = 0.5 * effective * np.log((1.0 - plain**2) / (1.0 - turned**2)) - np.log(len(EVERY))
    return Relation(
        (at - steps + offset) * period,
        float(sd),
        float(own[at]),
        float(np.trace(cross[:, :, at])) / power,
        exchanges[k],
        best,
        float(best_at - steps) * period,
        float(nats),
    )


def _centred(values: np.ndarray) -> np.ndarray:
    return values - np.mean(values, axis=0)


def peak(score: np.ndarray, at: int) -> tuple[float, float]:
    """Vertex of the parabola through the peak and its neighbours, and its curvature [1/step^2]."""
    if not 0 < at < len(score) - 1:
        return 0.0, 1e-9
    left, top, right = score[at - 1 : at + 2]
    curve = 2 * top - left - right
    return (0.5 * (right - left) / curve if curve > 0.0 else 0.0), max(float(curve), 1e-9)


def unit_hint(ratio: float) -> str:
    """Name the unit that a ratio of two measurements suggests, or return nothing."""
    for known, words in UNITS.items():
        if ratio and abs(np.log(abs(ratio) / known)) < _NEAR:
            return words
    return ""


def derivative(
    time: np.ndarray, values: np.ndarray, span: float = 0.06
) -> tuple[np.ndarray, np.ndarray]:
    """Derivative over about ``span`` seconds, or two periods where these are longer; gaps are left
    out.

    Returns times [s] and derivatives.
    """
    first, last, middle, width = _pairs(time, span)
    return middle, (values[last] - values[first]) / width[:, None]


def rates_of(
    time: np.ndarray, quat: np.ndarray, span: float = 0.06
) -> tuple[np.ndarray, np.ndarray]:
    """Body rates from attitudes xyzw, over about ``span`` seconds as in :func:`derivative`.

    Returns times [s] and rates [rad/s], shape (N, 3).
    """
    first, last, middle, width = _pairs(time, span)
    if not len(middle):
        return middle, np.empty((0, 3))
    turn = (Rotation.from_quat(quat[first]).inv() * Rotation.from_quat(quat[last])).as_rotvec()
    return middle, turn / width[:, None]


def _pairs(time: np.ndarray, span: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """First and last sample of each stretch of about ``span``, the time in its middle [s] and its
    width [s].
    """
    period = float(np.median(np.diff(time))) if len(time) > 2 else 1.0
    reach = max(1, round(0.5 * span / period))
    first = np.arange(max(len(time) - 2 * reach, 0))
    width = time[first + 2 * reach] - time[first]
    first, width = (x[width < 2.5 * max(span, 2.0 * period)] for x in (first, width))
    last = first + 2 * reach
    return first, last, 0.5 * (time[first] + time[last]), width


def mean_over(time: np.ndarray, values: np.ndarray, at: np.ndarray, span: float) -> np.ndarray:
    """Mean of a signal over ``span`` seconds about each time, shape (N, components)."""
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(time)[:, None]
    whole = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)])
    return (on_grid(time, whole, at + 0.5 * span) - on_grid(time, whole, at - 0.5 * span)) / span


def attitude_at(time: np.ndarray, quat: np.ndarray, at: np.ndarray) -> Rotation:
    """Attitudes xyzw between samples, straight through the quaternions."""
    return Rotation.from_quat(on_grid(time, continuous(quat), at))

"""Velocity and body rate where the source gives none: a causal polynomial fit over the last poses.

Over the N samples of a window of time, whatever the source's rate, a line (order 1) or a parabola (order 2) is fitted by
least squares, with the samples' own time stamps, and its slope is taken at the newest one. Under constant acceleration a
line's slope is late by half the window, ``(N - 1) T / 2`` at an even spacing T; a parabola's is not late at all, but noisier.
For slopes ``v = sum c_i p(t - a_i)`` of samples of age a_i the lag is ``-sum c_i a_i^2 / 2`` [s] (the response to
``p = t^2 / 2`` is ``t`` less the lag), which is what :attr:`SlopeFilter.lag` reports. The slope's noise is ``sqrt(sum c_i^2)``
times that of a sample.
"""

import math
from collections import deque
from dataclasses import dataclass

from hil.frames import conjugate, multiply
from hil.pose import Pose, Quaternion, Vector

MOST_GAP = 0.1
"""A gap longer than this empties the window: what lies before it says nothing of now [s]."""

MOST_SAMPLES = 32
"""In a window, whatever the source's rate: the fit's cost stays bounded."""


@dataclass(frozen=True)
class EstimateParams:
    """The filter.

    Raises:
        ValueError: an order other than 1 or 2, or a window that is empty or longer than :data:`MOST_GAP`.
    """

    window: float  # age of the oldest sample, where there are enough younger ones [s]
    order: int  # 1: line, 2: parabola

    def __post_init__(self) -> None:
        if self.order not in (1, 2) or not 0.0 < self.window <= MOST_GAP:
            raise ValueError(
                f"order {self.order} over a window of {self.window} s; expected 1 or 2, and above 0 to {MOST_GAP} s"
            )


def slope_weights(ages: list[float], order: int) -> list[float]:
    """Weights c_i of samples of given ages [s] (newest first, 0 first) in the slope at age 0 [1/s].

    With too few samples for the order the order is lowered; with one sample the slope is 0.
    """
    return fit_weights(ages, order)[0]


def fit_weights(ages: list[float], order: int) -> tuple[list[float], list[float]]:
    """Weights of the samples in the slope at age 0 [1/s], and in the second derivative [1/s^2] (0 for a line)."""
    order, none = min(order, len(ages) - 1), [0.0] * len(ages)
    if order < 1:
        return none, none
    times = [-age for age in ages]
    n, s1, s2 = float(len(times)), sum(times), sum(t * t for t in times)
    if order == 1:
        det = n * s2 - s1 * s1
        return ([(n * t - s1) / det for t in times] if det > 0.0 else none), none
    s3, s4 = sum(t**3 for t in times), sum(t**4 for t in times)
    # The middle and the last row of the inverse of the normal matrix [[n, s1, s2], [s1, s2, s3], [s2, s3, s4]].
    row = (s2 * s3 - s1 * s4, n * s4 - s2 * s2, s1 * s2 - n * s3)
    last = (s1 * s3 - s2 * s2, s1 * s2 - n * s3, n * s2 - s1 * s1)
    det = row[0] * s1 + row[1] * s2 + row[2] * s3
    if not det > 0.0:
        return none, none
    slope = [(row[0] + row[1] * t + row[2] * t * t) / det for t in times]
    return slope, [2.0 * (last[0] + last[1] * t + last[2] * t * t) / det for t in times]


class SlopeFilter:
    """Velocity and body rate of one body.

    Attributes:
        lag: of the last estimate under constant acceleration [s]; 0 where the source gave both itself.
        acceleration: of the last estimate [m/s^2], world frame; 0 for a line.
    """

    def __init__(self, params: EstimateParams) -> None:
        """Start empty."""
        self.params, self.lag = params, 0.0
        self.acceleration: Vector = (0.0, 0.0, 0.0)
        self._window: deque[Pose] = deque(maxlen=MOST_SAMPLES)

    def reset(self) -> None:
        """Forget all samples."""
        self._window.clear()

    def update(self, pose: Pose) -> tuple[Vector, Vector]:
        """Velocity, world frame [m/s], and rate, body frame [rad/s], at a new pose; the source's own where it gives them.

        Args:
            pose: in our frames, its stamp above the last one's.
        """
        window = self._window
        if window and not 0.0 < pose.stamp - window[0].stamp <= MOST_GAP:
            window.clear()
        window.appendleft(pose)
        while len(window) > self.params.order + 1 and pose.stamp - window[-1].stamp > self.params.window:
            window.pop()
        vel, rate = pose.vel, pose.rate
        ages = [pose.stamp - sample.stamp for sample in window]
        weights, bends = fit_weights(ages, self.params.order)
        self.acceleration = _sum(bends, [sample.pos for sample in window])
        self.lag = 0.0
        if vel is not None and (rate is not None or pose.quat is None):
            return vel, rate or (0.0, 0.0, 0.0)
        self.lag = -0.5 * sum(c * a * a for c, a in zip(weights, ages))
        if vel is None:
            vel = _sum(weights, [sample.pos for sample in window])
        if rate is None and pose.quat is not None:
            rate = _sum(weights, [_turn(pose.quat, sample.quat) for sample in window])
        return vel, rate or (0.0, 0.0, 0.0)


def _sum(weights: list[float], vectors: list[Vector]) -> Vector:
    return tuple(sum(c * v[i] for c, v in zip(weights, vectors)) for i in range(3))


def _turn(now: Quaternion, then: Quaternion | None) -> Vector:
    """Rotation vector from the attitude now to an earlier one, in the body frame of now [rad]."""
    if then is None:
        return (0.0, 0.0, 0.0)
    x, y, z, w = multiply(conjugate(now), then)
    if w < 0.0:
        x, y, z, w = -x, -y, -z, -w
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 * math.atan2(sine, w) / sine if sine > 1e-12 else 2.0
    return (scale * x, scale * y, scale * z)

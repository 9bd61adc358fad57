"""Estimation of velocity and body rate by a causal polynomial fit over the last poses, if the
source gives none.

A line (order 1) or a parabola (order 2) is fitted by least squares to the N samples in a window of
time, with their time stamps; its slope at the newest sample is the estimate. Under constant
acceleration the slope of a line lags by half the window, ``(N - 1) T / 2`` at an even spacing T.
That of a parabola has no lag, but more noise. For slopes ``v = sum c_i p(t - a_i)`` of samples of
age a_i the lag is ``-sum c_i a_i^2 / 2`` [s] (the response to ``p = t^2 / 2`` is ``t`` less the
lag), which is what :attr:`SlopeFilter.lag` reports. The slope's noise is ``sqrt(sum c_i^2)`` times
that of a sample."""

from collections import deque
from dataclasses import dataclass
from typing import Annotated

from hil.poses.pose import Pose, Quaternion, Vector
from visthrow.common.rotations import conjugate, multiply, rotation_vector
from visthrow.config.bounds import Bound, Bounded

# a gap longer than this empties the window: samples before it are outdated [s]
MOST_GAP = 0.1
MOST_SAMPLES = 32  # in a window, to bound the cost of the fit


@dataclass(frozen=True)
class EstimateParams(Bounded):
    """Parameters of the filter."""

    # largest age of a sample, if there are enough younger ones [s]
    window: Annotated[float, Bound(0.0, MOST_GAP, "(]")]
    order: Annotated[int, Bound(1, 2)]  # 1: line, 2: parabola


def fit_weights(ages: list[float], order: int) -> tuple[list[float], list[float]]:
    """Return weights c_i of samples of given ages [s], newest first, in the slope at age 0 [1/s],
    and in the second derivative [1/s^2].

    With too few samples the order is lowered; with one sample the slope is 0. The second derivative
    of a line is 0."""
    order = min(order, len(ages) - 1)
    none = [0.0] * len(ages)
    if order < 1:
        return none, none
    n = float(len(ages))
    s1 = 0.0
    s2 = 0.0
    s3 = 0.0
    s4 = 0.0
    for age in ages:
        square = age * age
        s1 -= age
        s2 += square
        s3 -= age * square
        s4 += square * square
    if order == 1:
        det = n * s2 - s1 * s1
        return ([(-n * age - s1) / det for age in ages] if det > 0.0 else none), none
    # The middle and the last row of the inverse of the normal matrix [[n, s1, s2], [s1, s2, s3],
    # [s2, s3, s4]].
    r0 = s2 * s3 - s1 * s4
    r1 = n * s4 - s2 * s2
    r2 = s1 * s2 - n * s3
    det = r0 * s1 + r1 * s2 + r2 * s3
    if not det > 0.0:
        return none, none
    l0 = s1 * s3 - s2 * s2
    l2 = n * s2 - s1 * s1
    scale = 1.0 / det
    double = 2.0 / det
    slope = [(r0 - r1 * age + r2 * age * age) * scale for age in ages]
    return slope, [(l0 - r2 * age + l2 * age * age) * double for age in ages]


class SlopeFilter:
    """An estimator of velocity, acceleration and body rate of one body; ``acceleration`` is the
    last estimate [m/s^2], world frame, 0 for a line.

    The body rate is computed on demand, because many poses may arrive between two ticks, and a
    payload's rate is never used."""

    def __init__(self, params: EstimateParams):
        self.params = params
        self.acceleration: Vector = (0.0, 0.0, 0.0)
        self._window: deque[Pose] = deque(maxlen=MOST_SAMPLES)
        self._ages: list[float] = []
        self._weights: list[float] = []
        self._bends: list[float] = []
        self._rate: Vector | None = None  # None until it is computed
        self._spin: Vector = (0.0, 0.0, 0.0)

    def reset(self) -> None:
        """Forget all samples."""
        self._window.clear()

    def update(self, pose: Pose) -> Vector:
        """Add a pose in our frames, newer than the last, and return its velocity, world frame
        [m/s]: the source's, if it gives one.
        """
        window = self._window
        params = self.params
        stamp = pose.stamp
        if window and not 0.0 < stamp - window[0].stamp <= MOST_GAP:
            window.clear()
        window.appendleft(pose)
        while len(window) > params.order + 1 and stamp - window[-1].stamp > params.window:
            window.pop()
        self._ages = [stamp - sample.stamp for sample in window]
        self._weights, self._bends = fit_weights(self._ages, params.order)
        places = [sample.pos for sample in window]
        self.acceleration = _sum(self._bends, places)
        self._rate = None
        self._spin = (0.0, 0.0, 0.0)
        return _sum(self._weights, places) if pose.vel is None else pose.vel

    @property
    def rate(self) -> Vector:
        """Body rate at the last pose, body frame [rad/s]: the source's, if it gives one; 0
        without an attitude.
        """
        if self._rate is None:
            pose = self._window[0] if self._window else None
            if pose is None or pose.rate is not None or pose.quat is None:
                self._rate = (
                    pose.rate if pose is not None and pose.rate is not None else (0.0, 0.0, 0.0)
                )
            else:
                turns = [_turn(pose.quat, sample.quat) for sample in self._window]
                self._rate, self._spin = _sum(self._weights, turns), _sum(self._bends, turns)
        return self._rate

    @property
    def spin(self) -> Vector:
        """Angular acceleration at the last pose, body frame [rad/s^2]; 0 for a line, and if the
        source gives rates.
        """
        _ = self.rate  # computes the spin too
        return self._spin

    @property
    def lag(self) -> float:
        """Lag of the last estimates under constant acceleration [s]; 0 if the source gives
        velocity and rate.
        """
        if not self._window:
            return 0.0
        pose = self._window[0]
        if pose.vel is not None and (pose.rate is not None or pose.quat is None):
            return 0.0
        return -0.5 * sum(c * a * a for c, a in zip(self._weights, self._ages))


def _sum(weights: list[float], vectors: list[Vector]) -> Vector:
    x = y = z = 0.0
    for c, (a, b, d) in zip(weights, vectors):
        x += c * a
        y += c * b
        z += c * d
    return (x, y, z)


def _turn(quat: Quaternion, earlier: Quaternion | None) -> Vector:
    """Return the rotation vector from an attitude to an earlier one, in the former's body frame
    [rad].
    """
    if earlier is None:
        return (0.0, 0.0, 0.0)
    return rotation_vector(multiply(conjugate(quat), earlier))

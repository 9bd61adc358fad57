"""Samples of one quantity and their calculus: values between samples, derivatives, means.

Onboard-safe (numpy only)."""

from typing import NamedTuple

import numpy as np
from numpy import ndarray

from visthrow.common.rotations import continuous, vectors_between


class Samples(NamedTuple):
    """Samples of one quantity."""

    time: ndarray  # [s], shape (N,)
    values: ndarray  # shape (N, components)

    def at(self, times: ndarray) -> ndarray:
        """Interpolate linearly, column by column, at times of shape (..., M): shape
        (..., M, components).
        """
        return interpolate(self.time, self.values, times)

    def attitudes(self, times: ndarray) -> ndarray:
        """Attitudes between samples of attitudes xyzw, unit quaternions, straight through those of
        the samples.
        """
        between = interpolate(self.time, continuous(self.values), times)
        return between / np.linalg.norm(between, axis=1, keepdims=True)

    def mean_over(self, times: ndarray, span: float) -> ndarray:
        """Mean over ``span`` seconds about each time, shape (M, components)."""
        steps = 0.5 * (self.values[1:] + self.values[:-1]) * np.diff(self.time)[:, None]
        whole = np.vstack([0.0 * self.values[:1], np.cumsum(steps, axis=0)])
        ends = np.stack([times - 0.5 * span, times + 0.5 * span])
        begin, end = interpolate(self.time, whole, ends)
        return (end - begin) / span

    def derivative(self, span: float = 0.06) -> "Samples":
        """Return the derivative over about ``span`` seconds, or two periods where these are longer;
        gaps are left out.
        """
        first, last, middle, width = self._pairs(span)
        return Samples(middle, (self.values[last] - self.values[first]) / width[:, None])

    def rates(self, span: float = 0.06) -> "Samples":
        """Return body rates [rad/s] of attitudes xyzw, over about ``span`` seconds as in
        :meth:`derivative`.
        """
        first, last, middle, width = self._pairs(span)
        if not len(middle):
            return Samples(middle, np.empty((0, 3)))
        turns = vectors_between(self.values[first], self.values[last])
        return Samples(middle, turns / width[:, None])

    def _pairs(self, span: float) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        """First and last sample of each stretch of about ``span``, the time in its middle [s] and
        its width [s].
        """
        time = self.time
        period = np.median(np.diff(time)) if len(time) > 2 else 1.0
        reach = max(1, round(0.5 * span / period))
        first = np.arange(max(len(time) - 2 * reach, 0))
        width = time[first + 2 * reach] - time[first]
        whole = width < 2.5 * max(span, 2.0 * period)
        first = first[whole]
        last = first + 2 * reach
        return first, last, 0.5 * (time[first] + time[last]), width[whole]


def interpolate(time: ndarray, values: ndarray, grid: ndarray) -> ndarray:
    """Interpolate linearly, column by column: values of shape (T, C) at times of shape (..., N),
    shape (..., N, C).
    """
    return np.stack([np.interp(grid, time, column) for column in values.T], -1)

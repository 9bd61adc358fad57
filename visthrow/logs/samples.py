"""Samples of one quantity, with interpolation, derivatives and means.

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
        """Interpolate linearly, column by column. ``times``: shape (..., M); returns shape
        (..., M, components).
        """
        return interpolate(self.time, self.values, times)

    def attitudes(self, times: ndarray) -> ndarray:
        """Interpolate attitudes (unit quaternions, xyzw) linearly and normalise them, shape (M, 4).

        ``times``: shape (M,)."""
        between = interpolate(self.time, continuous(self.values), times)
        return between / np.linalg.norm(between, axis=1, keepdims=True)

    def mean_over(self, times: ndarray, span: float) -> ndarray:
        """Return the mean over ``span`` seconds centred at each time, shape (M, components)."""
        steps = 0.5 * (self.values[1:] + self.values[:-1]) * np.diff(self.time)[:, None]
        whole = np.vstack([0.0 * self.values[:1], np.cumsum(steps, axis=0)])
        ends = np.stack([times - 0.5 * span, times + 0.5 * span])
        begin, end = interpolate(self.time, whole, ends)
        return (end - begin) / span

    def derivative(self, span: float = 0.06) -> "Samples":
        """Return the derivative by central differences over about ``span`` seconds, at least two
        periods; differences across gaps are left out.
        """
        first, last, middle, width = self._pairs(span)
        return Samples(middle, (self.values[last] - self.values[first]) / width[:, None])

    def rates(self, span: float = 0.06) -> "Samples":
        """Return the body rates [rad/s] of attitudes xyzw, by differences as in
        :meth:`derivative`.
        """
        first, last, middle, width = self._pairs(span)
        if not len(middle):
            return Samples(middle, np.empty((0, 3)))
        turns = vectors_between(self.values[first], self.values[last])
        return Samples(middle, turns / width[:, None])

    def _pairs(self, span: float) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        """Return, for all differences over about ``span``, indices of first and last sample, time
        of the middle [s] and width [s].
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
    """Interpolate values of shape (T, C) linearly, column by column, at times of shape (..., N);
    returns shape (..., N, C).
    """
    return np.stack([np.interp(grid, time, column) for column in values.T], -1)

"""Prediction errors within windows, by horizon.

The initial state is fitted to the head of a window; the rest is predicted from it and compared with
the measurement. A window without an initial state (means, a motor on a stand, a camera's view)
has no head: all of it is predicted."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy import ndarray

from visthrow.diagnose.likelihood.evidence import UNKNOWN_RATIO
from visthrow.diagnose.likelihood.marginal import Noise
from visthrow.diagnose.models.model_interface import Indices, Window
from visthrow.logs.flightlog import STANDARD_CHANNELS

HEAD = 0.4  # share of a window, at most HEAD_SECONDS, in which the initial state is fitted
HEAD_SECONDS = 0.4
HORIZONS = (
    0.02,
    0.05,
    0.1,
    0.2,
    0.3,
    0.45,
    0.6,
    1.0,
)  # upper ends of the horizons [s]; the last one has no end


# ratio of the expected to the actual squares above which the expectation is not used
FAR_ABOVE = UNKNOWN_RATIO**2

UNITS = {"quat_wb": "rad", "angle": "rad", "thrust": "N", "current": "A", "marker_pos_c": "m"}
"""Units of residuals that differ from the channel's (an attitude's residual is a rotation vector),
and those of channels that only the small models have.
"""


READABLE = {"m": (1e3, "mm"), "rad": (180.0 / np.pi, "deg"), "m/s": (1e3, "mm/s")}
"""Unit -> factor and unit for pictures and tables, as residuals are small."""


def readable(unit: str) -> tuple[float, str]:
    """Return the factor from a unit of residuals to one that people read, and that unit."""
    return READABLE.get(unit, (1.0, unit))


def unit_of(channel: str) -> str:
    """Return the unit of a channel's residuals; empty if it has none or an unknown one."""
    standard = STANDARD_CHANNELS.get(channel)
    return UNITS.get(channel, standard.unit if standard else "")


@dataclass(frozen=True)
class Errors:
    """Sums over the predicted samples, for groups of windows (flights), channels and horizons,
    shape (F, C, H) each.
    """

    square: ndarray  # squared prediction errors, in sigmas
    count: ndarray  # number of samples
    # squares expected from sensor noise and from the initial state's uncertainty alone. Where the
    # head hardly determines the state, the expectation far exceeds the error; then it is the error.
    floor: ndarray


def errors(
    windows: Sequence[Window],
    groups: Indices,
    noise: Noise,
    residuals: Sequence[ndarray],
    channels: int,
) -> Errors:
    """Predict the rest of each window from its head and add up the errors.

    Args:
        groups: the group (flight) of each window; F groups.
        noise: for the sensor scales.
        residuals: of each window, in the channels' units, shape (N,).
        channels: number C of channels.
    """
    names, row = np.unique(groups, return_inverse=True)
    sums = np.zeros((3, len(names), channels, len(HORIZONS)))
    for window, f, residual in zip(windows, row, residuals):
        innovation, expected, horizon = predict(window, noise, residual)
        ahead = horizon >= 0
        place = window.channel[ahead], horizon[ahead]
        square, count, floor = sums_of = np.zeros((3, channels, len(HORIZONS)))
        np.add.at(square, place, innovation[ahead] ** 2)
        np.add.at(count, place, 1.0)
        np.add.at(floor, place, expected[ahead])
        sums_of[2] = np.where(floor > FAR_ABOVE * square, square, floor)
        sums[:, f] += sums_of
    return Errors(*sums)


def predict(window: Window, noise: Noise, residual: ndarray) -> tuple[ndarray, ndarray, ndarray]:
    """Predict the rest of a window from its head.

    Returns the prediction error in sigmas, of the residual's shape, the square of it that noise
    alone would cause, shape (N,), and the horizon's index (-1 in the head), shape (N,).

    Args:
        window: of N samples.
        noise: for the sensor scales.
        residual: in the channels' units, shape (N,), or (N, Q) for several.
    """
    sigma = window.sigma
    scale = noise.scale[window.channel]
    states = window.nuisance * window.nuisance_sd / sigma[:, None]
    off = (residual.T / sigma).T
    begin = window.time.min()
    length = np.ptp(window.time)
    count = states.shape[1]
    head_seconds = min(HEAD * length, HEAD_SECONDS) if count else 0.0
    horizon_time = window.time - begin - head_seconds
    head = (horizon_time <= 0.0) & (count > 0)
    weighted = (states[head] / scale[head, None] ** 2).T
    spread = np.linalg.inv(weighted @ states[head] + np.eye(count))
    fit = spread @ (weighted @ off[head])
    innovation = off - states @ fit
    if window.correlated:
        root = _root(window, scale)
        left = root - states @ (spread @ (weighted @ root[head]))
        expected = (left**2).sum(1) + ((states @ spread) ** 2).sum(1)
    else:  # the same for white noise
        expected = scale**2 + np.einsum("nd,de,ne->n", states, spread, states, optimize=True)
    nearest = np.minimum(np.searchsorted(HORIZONS, horizon_time), len(HORIZONS) - 1)
    return innovation, expected, np.where(head, -1, nearest)


def _root(window: Window, scale: ndarray) -> ndarray:
    """Return a square root of the covariance of a window's noise in sigmas, shape (N, N)."""
    root = np.diag(scale)
    for rows, factor in window.correlated:
        for row in rows.T:
            root[np.ix_(row, row)] = scale[row[0]] * factor
    return root

"""Prediction errors as quadratic forms of the effects' sizes, so that any sizes are scored without simulating again.

Within a window the initial state is fitted to the first HEAD seconds; what follows is predicted and compared at rising horizons.
A window without an initial state (means, a motor's stand, a camera's view) has nothing to fit, and is predicted whole.
Both steps are linear in the residuals, hence the squared error of any linear combination of residual columns is a quadratic form.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visthrow.diagnose.likelihood.marginal import Noise
from visthrow.diagnose.models.interface import Window
from visthrow.logs.flightlog import STANDARD_CHANNELS

HEAD = 0.4  # share of a window, at most HEAD_SECONDS, in which the initial state is fitted
HEAD_SECONDS = 0.4
HORIZONS = (0.02, 0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 1.0)  # upper ends of the horizons [s]; what lies beyond the last belongs to it


UNITS = {"quat_wb": "rad", "angle": "rad", "thrust": "N", "current": "A", "marker_pos_c": "m"}
"""Of residuals: an attitude's are rotation vectors, and the small models have channels of their own."""


READABLE = {"m": (1e3, "mm"), "rad": (180.0 / np.pi, "deg"), "m/s": (1e3, "mm/s")}
"""Unit -> factor and unit in pictures and tables, where residuals are small."""


def unit_of(channel: str) -> str:
    """Unit of a channel's residuals; empty where it has none, or none that is known."""
    standard = STANDARD_CHANNELS.get(channel)
    return UNITS.get(channel, standard.unit if standard else "")


@dataclass(frozen=True)
class Forms:
    """Sums of squares in sigmas, for groups of windows (flights), channels and horizons; Q columns, the residual first."""

    groups: np.ndarray  # shape (F,)
    square: np.ndarray  # shape (F, C, H, Q, Q)
    count: np.ndarray  # samples, shape (F, C, H)
    floor: np.ndarray  # squares expected of sensor noise and of the initial state's uncertainty alone, shape (F, C, H)

    def error(self, combination: np.ndarray) -> np.ndarray:
        """Sum of squares of ``columns @ combination``, shape (F, C, H); ``combination`` (Q,) or (F, Q)."""
        v = np.broadcast_to(combination, (len(self.groups), self.square.shape[-1]))
        return np.einsum("fchij,fi,fj->fch", self.square, v, v, optimize=True)


def forms(windows: Sequence[Window], groups: Sequence[int], noise: Noise, columns: Sequence[np.ndarray], channels: int) -> Forms:
    """Build the quadratic forms.

    Args:
        groups: to which group (flight) each belongs.
        noise: for the sensor scales.
        columns: of each window, shape (N, Q), in the channels' units; the residual stands first.
        channels: number C of channels.
    """
    names = np.array(sorted(set(groups)))
    size = columns[0].shape[1]
    square = np.zeros((len(names), channels, len(HORIZONS), size, size))
    count, floor = np.zeros(square.shape[:3]), np.zeros(square.shape[:3])
    for window, group, column in zip(windows, groups, columns):
        f = int(np.searchsorted(names, group))
        left, expected, horizon = predicted(window, noise, column)
        for c in np.unique(window.channel):
            for h in range(len(HORIZONS)):
                rows = (window.channel == c) & (horizon == h)
                if rows.any():
                    square[f, c, h] += left[rows].T @ left[rows]
                    count[f, c, h] += rows.sum()
                    floor[f, c, h] += expected[rows].sum()
    return Forms(names, square, count, floor)


def left_ahead(window: Window, noise: Noise) -> np.ndarray:
    """Residuals of a window in sigmas once its initial state is fitted to its head, shape (N,); 0 in the head."""
    left, _, horizon = predicted(window, noise, window.residual[:, None])
    return np.where(horizon < 0, 0.0, left[:, 0])


def predicted(window: Window, noise: Noise, column: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Predict the end of a window from its head.

    Returns columns left after the fit of the initial state in sigmas, shape (N, Q), the square that noise is expected to leave there,
    shape (N,), and the horizon's index (-1 in the head).

    Args:
        window: of N samples.
        noise: for the sensor scales.
        column: in the channels' units, shape (N, Q).
    """
    sigma = window.sigma
    scale = noise.scale[window.channel]
    states = window.nuisance * window.nuisance_sd / sigma[:, None]
    column = column / sigma[:, None]
    begin, length = window.time.min(), np.ptp(window.time)
    fits = states.shape[1] > 0
    ahead = window.time - begin - (min(HEAD * length, HEAD_SECONDS) if fits else 0.0)
    head = (ahead <= 0.0) & fits
    weighted = (states[head] / scale[head, None] ** 2).T
    spread = np.linalg.inv(weighted @ states[head] + np.eye(states.shape[1]))
    left = column - states @ (spread @ (weighted @ column[head]))
    if window.correlated:
        root = _root(window, scale)
        expected = ((root - states @ (spread @ (weighted @ root[head]))) ** 2).sum(1) + ((states @ spread) ** 2).sum(1)
    else:  # what that is where noise is white
        expected = scale**2 + np.einsum("nd,de,ne->n", states, spread, states, optimize=True)
    horizon = np.where(head, -1, np.minimum(np.searchsorted(HORIZONS, ahead), len(HORIZONS) - 1))
    return left, expected, horizon


def _root(window: Window, scale: np.ndarray) -> np.ndarray:
    """Square root of the covariance of a window's noise in sigmas, shape (N, N)."""
    root = np.diag(scale)
    for rows, factor in window.correlated:
        for own in rows.T:
            root[np.ix_(own, own)] = scale[own[0]] * factor
    return root

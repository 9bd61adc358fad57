"""A flight that was copied counts once."""

from collections.abc import Sequence

import numpy as np

from visthrow.diagnose.models.interface import Window

EDGE = 6
"""Samples of one channel, of three components each, by which windows of a copied flight may differ."""

NOISY, COPIED = 0.3, 0.2
"""Median residual, in its deviation, without which nothing tells a copy; and the median difference of copies' residuals."""


def repeated_flights(windows: Sequence[Window]) -> dict[int, int]:
    """Find flights whose windows repeat those of an earlier flight, whatever their clocks say.

    The last window of a flight may be too short by a sample in one of them.

    Returns:
        Flight -> the earlier flight.
    """
    by_flight: dict[int, list[Window]] = {}
    for window in windows:
        by_flight.setdefault(window.flight, []).append(window)
    repeats: dict[int, int] = {}
    for flight, own in by_flight.items():
        for earlier, others in by_flight.items():
            if earlier >= flight:
                break
            if earlier not in repeats and abs(len(own) - len(others)) <= 1 and all(map(_same, own, others)):
                repeats[flight] = earlier
                break
    return repeats


def _same(a: Window, b: Window) -> bool:
    """Whether two windows hold the same measurements: noise of two flights never agrees to a fifth of its deviation.

    A clock set forward may move a sample at either end into or out of a window.
    """
    if abs(len(a.residual) - len(b.residual)) > EDGE * len(np.unique(a.channel)) or not len(a.residual):
        return False
    normal = [w.residual / w.sigma for w in (a, b)]
    return all(_alike(*[_rough(r[w.channel == c]) for r, w in zip(normal, (a, b))]) for c in np.unique(a.channel))


def _rough(residual: np.ndarray) -> np.ndarray:
    """Second differences of each component: the noise, without what the same data may be fitted with otherwise."""
    return (residual[6:] - 2.0 * residual[3:-3] + residual[:-6]) / np.sqrt(6.0)


def _alike(one: np.ndarray, other: np.ndarray) -> bool:
    if min(len(one), len(other)) <= EDGE or np.median(np.abs(one)) < NOISY:  # a simulation's record without noise
        return False
    pairs = [(one, other), *[(x[k:], y) for x, y in ((one, other), (other, one)) for k in range(3, EDGE + 1, 3)]]
    lengths = [min(len(x), len(y)) for x, y in pairs]
    return min(np.median(np.abs(x[:n] - y[:n])) for (x, y), n in zip(pairs, lengths)) < COPIED

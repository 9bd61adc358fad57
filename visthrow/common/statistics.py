"""Statistics of throws: hierarchical bootstrap, ratios, differences, bias against scatter.

NumPy alone.

Throws of one training run are not independent evidence about the recipe that trained it: another
seed may throw otherwise. Where several runs are given, a bootstrap sample draws runs first and then
throws within each (two levels); with one run the interval speaks of that run's throws alone.

Source: Efron and Tibshirani, "An Introduction to the Bootstrap", 1993, ch. 13 (percentile) and 14
(BCa); Davison and Hinkley, "Bootstrap Methods and their Application", 1997, sec. 3.8 (hierarchical
data)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy import ndarray

# bootstrap samples: the ends of a 95 % interval then vary by a few per cent of its width
DRAWS = 4000

LEVEL = 0.95

Groups = Sequence[ndarray]
"""One array of throws a training run, shape (N,) or (N, ...)."""


@dataclass(frozen=True)
class Interval:
    """An estimate with its bootstrap interval of :data:`LEVEL`."""

    value: float
    low: float
    high: float

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high

    def text(self, digits: int = 3, sign: bool = False) -> str:
        """``0.025 [0.023, 0.027]``."""
        form = f"{{:{'+' if sign else ''}.{digits}f}}"
        return f"{form.format(self.value)} [{form.format(self.low)}, {form.format(self.high)}]"


def _resample(groups: list[ndarray], rng: np.random.Generator, draws: int) -> ndarray:
    """Means of bootstrap samples, shape (draws, ...): runs drawn first, then throws within each."""
    count = len(groups)
    # means of resampled throws, for each run as many independent ones as it can be drawn
    by_run = []
    for group in groups:
        index = rng.integers(len(group), size=(draws * count, len(group)), dtype=np.int32)
        columns = group.reshape(len(group), -1).T
        means = np.stack([column[index].mean(1) for column in columns], axis=-1)
        by_run.append(means.reshape(draws, count, *group.shape[1:]))
    if count > 1:
        chosen = rng.integers(count, size=(draws, count))
    else:
        chosen = np.zeros((draws, 1), dtype=int)
    stacked = np.stack(by_run, axis=1)  # (draws, run, copy, ...)
    index = np.arange(draws)[:, None]
    return stacked[index, chosen, np.arange(count)[None]].mean(1)


def _require_throws(groups: Groups | ndarray) -> list[ndarray]:
    """List of runs that have throws; ValueError where there is nothing to average."""
    listed = [groups] if isinstance(groups, ndarray) else list(groups)
    groups_with_data = [np.asarray(group, dtype=float) for group in listed if len(group)]
    if not groups_with_data or any(not np.all(np.isfinite(group)) for group in groups_with_data):
        raise ValueError(
            f"{len(listed)} groups, {len(groups_with_data)} of them with throws; expected finite"
            " numbers in one or more"
        )
    return groups_with_data


def _interval(value: float, samples: ndarray) -> Interval:
    tail = 0.5 * (1.0 - LEVEL)
    low, high = np.quantile(samples, (tail, 1.0 - tail))
    return Interval(float(value), float(low), float(high))


def _mean(groups: list[ndarray]) -> ndarray:
    """Mean of the runs' means: each run counts the same."""
    return np.mean([group.mean(0) for group in groups], axis=0)


def mean(groups: Groups | ndarray, seed: int = 0, draws: int = DRAWS) -> Interval:
    """Mean over runs and throws, shape (N,) each, or one array for one run, with its interval by so
    many bootstrap samples.
    """
    groups_with_data = _require_throws(groups)
    samples = _resample(groups_with_data, np.random.default_rng(seed), draws)
    return _interval(_mean(groups_with_data), samples)


def difference(a: Groups | ndarray, b: Groups | ndarray, draws: int = DRAWS) -> Interval:
    """Mean of ``a`` minus mean of ``b``, independent throws."""
    return _compare_both(np.subtract, a, b, draws)


def _compare_both(
    function: np.ufunc, a: Groups | ndarray, b: Groups | ndarray, draws: int
) -> Interval:
    first = _require_throws(a)
    second = _require_throws(b)
    rng = np.random.default_rng(0)
    samples = function(_resample(first, rng, draws), _resample(second, rng, draws))
    return _interval(function(_mean(first), _mean(second)), samples)


def compare_pairs(a: ndarray, b: ndarray) -> Interval:
    """Mean of ``a - b`` where entry n of both met the same vehicle, wind and start; pairs with a
    failed throw are left out.

    Raises ValueError: no pair in which both landed.
    """
    differences = np.asarray(a, dtype=float) - np.asarray(b, dtype=float)
    return mean(differences[np.isfinite(differences)])


def ratio(a: Groups | ndarray, b: Groups | ndarray, draws: int = DRAWS) -> Interval:
    """Mean of ``a`` over mean of ``b``, independent throws; both positive."""
    return _compare_both(np.divide, a, b, draws)


def correlation(x: ndarray, y: ndarray) -> Interval:
    """Pearson's correlation of pairs with its interval over pairs.

    Raises ValueError: fewer than three pairs, or one side that never varies.
    """
    x = np.asarray(x, dtype=float)
    y = np.asarray(y, dtype=float)
    if len(x) != len(y) or len(x) < 3 or not (np.ptp(x) > 0.0 and np.ptp(y) > 0.0):
        raise ValueError(
            f"{len(x)} and {len(y)} numbers; expected three or more pairs, not all alike"
        )
    index = np.random.default_rng(0).integers(len(x), size=(DRAWS, len(x)))
    samples = _pearson(x[index], y[index])
    return _interval(_pearson(x[None], y[None])[0], samples[np.isfinite(samples)])


def _pearson(x: ndarray, y: ndarray) -> ndarray:
    """Row by row; NaN where a row of one side is constant."""
    x = x - x.mean(1, keepdims=True)
    y = y - y.mean(1, keepdims=True)
    norm = np.sqrt((x**2).sum(1) * (y**2).sum(1))
    return (x * y).sum(1) / np.where(norm > 0.0, norm, np.nan)


@dataclass(frozen=True)
class Bias:
    """The mean landing place and the scatter about it."""

    along: Interval  # mean miss along the throw, positive past the target [m]
    lateral: Interval  # to the left of it [m]
    offset: float  # length of the mean miss [m]
    scatter: float  # root mean square distance from the mean landing point [m]
    share: float  # of the mean square miss that the offset makes up [-]

    @property
    def direction(self) -> str:
        """Return the direction of the miss, if the interval excludes zero:

        "undershoots, lands left", or "no bias".
        """
        words = []
        if 0.0 not in self.along:
            words.append("overshoots" if self.along.value > 0.0 else "undershoots")
        if 0.0 not in self.lateral:
            words.append("left" if self.lateral.value > 0.0 else "right")
        return ", ".join(words) or "none that shows"


def bias(groups: Groups | ndarray) -> Bias:
    """Split misses of each run, shape (N, 2) [m], along the throw and to the left, into a common
    offset and scatter.

    Mean square = offset squared + scatter squared.
    """
    groups_with_data = _require_throws(groups)
    samples = _resample(groups_with_data, np.random.default_rng(0), DRAWS)
    center = _mean(groups_with_data)
    square = float(np.mean([(group**2).sum(1).mean() for group in groups_with_data]))
    offset = float(np.hypot(*center))
    along, lateral = (_interval(center[i], samples[:, i]) for i in range(2))
    scatter = float(np.sqrt(max(square - offset**2, 0.0)))
    return Bias(along, lateral, offset, scatter, offset**2 / square if square > 0.0 else 0.0)

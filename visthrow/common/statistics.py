"""Statistics of throws: hierarchical bootstrap, ratios, differences, bias and scatter.

It needs only NumPy.

Throws of one training run are not independent evidence about a training procedure, because another
seed may yield different throws. For several runs a bootstrap sample draws first runs and then
throws within each (two levels). For one run the interval only describes this run's throws.

Source: Efron and Tibshirani, "An Introduction to the Bootstrap", 1993, ch. 13 (percentile) and 14
(BCa); Davison and Hinkley, "Bootstrap Methods and their Application", 1997, sec. 3.8 (hierarchical
data)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy import ndarray

# number of bootstrap samples, for which the ends of a 95 % interval vary by a few per cent of its
# width
DRAWS = 4000

LEVEL = 0.95

Groups = Sequence[ndarray]
"""One array of throws for each training run, shape (N,) or (N, ...)."""


@dataclass(frozen=True)
class Interval:
    """An estimate with its bootstrap interval of :data:`LEVEL`."""

    value: float
    low: float
    high: float

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high

    def text(self, digits: int = 3, sign: bool = False) -> str:
        """Return the interval as text, such as ``0.025 [0.023, 0.027]``."""
        form = f"{{:{'+' if sign else ''}.{digits}f}}"
        return f"{form.format(self.value)} [{form.format(self.low)}, {form.format(self.high)}]"


def _resample(groups: list[ndarray], rng: np.random.Generator, draws: int) -> ndarray:
    """Return means of bootstrap samples, shape (draws, ...), which draw first runs and then throws
    within each.
    """
    count = len(groups)
    # means of resampled throws; a run needs as many independent ones as it can be drawn
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
    """Return the runs that have throws.

    Raises ValueError: no run has throws, or a number is not finite.
    """
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
    """Return the mean of the runs' means, so that each run has the same weight."""
    return np.mean([group.mean(0) for group in groups], axis=0)


def mean(groups: Groups | ndarray, seed: int = 0, draws: int = DRAWS) -> Interval:
    """Return the mean over runs and throws with its interval.

    Args:
        groups: throws of each run, shape (N,), or one array for one run.
        seed: seed of the bootstrap. draws: number of bootstrap samples.
    """
    groups_with_data = _require_throws(groups)
    samples = _resample(groups_with_data, np.random.default_rng(seed), draws)
    return _interval(_mean(groups_with_data), samples)


def difference(a: Groups | ndarray, b: Groups | ndarray, draws: int = DRAWS) -> Interval:
    """Return the mean of ``a`` minus the mean of ``b``, for independent throws."""
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
    """Return the mean of ``a - b`` over pairs with the same vehicle, wind and initial state,
    without pairs that include a failed throw.

    Raises ValueError: there is no pair in which both landed.
    """
    differences = np.asarray(a, dtype=float) - np.asarray(b, dtype=float)
    return mean(differences[np.isfinite(differences)])


def ratio(a: Groups | ndarray, b: Groups | ndarray, draws: int = DRAWS) -> Interval:
    """Return the mean of ``a`` divided by the mean of ``b``, for independent throws; both must be
    positive.
    """
    return _compare_both(np.divide, a, b, draws)


def correlation(x: ndarray, y: ndarray) -> Interval:
    """Return Pearson's correlation of pairs with its interval over pairs.

    Raises ValueError: fewer than three pairs, or one side is constant.
    """
    x = np.asarray(x, dtype=float)
    y = np.asarray(y, dtype=float)
    if len(x) != len(y) or len(x) < 3 or not (np.ptp(x) > 0.0 and np.ptp(y) > 0.0):
        raise ValueError(
            f"{len(x)} and {len(y)} numbers; expected three or more pairs that vary on both sides"
        )
    index = np.random.default_rng(0).integers(len(x), size=(DRAWS, len(x)))
    samples = _pearson(x[index], y[index])
    return _interval(_pearson(x[None], y[None])[0], samples[np.isfinite(samples)])


def _pearson(x: ndarray, y: ndarray) -> ndarray:
    """Return the correlation of each row; NaN if a row of one side is constant."""
    x = x - x.mean(1, keepdims=True)
    y = y - y.mean(1, keepdims=True)
    norm = np.sqrt((x**2).sum(1) * (y**2).sum(1))
    return (x * y).sum(1) / np.where(norm > 0.0, norm, np.nan)


@dataclass(frozen=True)
class Bias:
    """The mean landing point relative to the target, and the scatter about it."""

    along: Interval  # mean offset along the throw, positive beyond the target [m]
    lateral: Interval  # mean offset to the left [m]
    offset: float  # length of the mean offset [m]
    scatter: float  # root mean square distance from the mean landing point [m]
    share: float  # share of the mean offset in the mean square error [-]

    @property
    def direction(self) -> str:
        """Return the directions whose intervals exclude zero, such as "undershoots, left", or
        "none that shows".
        """
        words = []
        if 0.0 not in self.along:
            words.append("overshoots" if self.along.value > 0.0 else "undershoots")
        if 0.0 not in self.lateral:
            words.append("left" if self.lateral.value > 0.0 else "right")
        return ", ".join(words) or "none that shows"


def bias(groups: Groups | ndarray) -> Bias:
    """Split the landing errors of each run, shape (N, 2) [m], along the throw and to the left, into
    a common offset and scatter: mean square = offset squared + scatter squared.
    """
    groups_with_data = _require_throws(groups)
    samples = _resample(groups_with_data, np.random.default_rng(0), DRAWS)
    center = _mean(groups_with_data)
    square = float(np.mean([(group**2).sum(1).mean() for group in groups_with_data]))
    offset = float(np.hypot(*center))
    along, lateral = (_interval(center[i], samples[:, i]) for i in range(2))
    scatter = float(np.sqrt(max(square - offset**2, 0.0)))
    return Bias(along, lateral, offset, scatter, offset**2 / square if square > 0.0 else 0.0)

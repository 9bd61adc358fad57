"""Relation of two measurements of the same motion: delay, axes, sign, scale and correlation."""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyfit

from visthrow.logs.axes import EXCHANGES, MATRICES
from visthrow.logs.samples import Samples

REACH = 0.4  # largest delay in the search [s]
# largest distance of a ratio's logarithm from a unit's: noise dilutes, cables pull, filters smooth
_UNIT = 0.25
_LONGEST_GRID = 60_000  # samples; longer signals are sampled more coarsely

BLOCKS = 16  # parts of a signal; the scatter between them gives a delay's standard deviation
_ROUNDS = 5  # iterations in which blocks are weighted by their noise
_WIDTH = 0.04  # half the width of the narrowest parabola that is fitted to a peak [s]
_NATS = 10.0  # log-likelihood that a peak must have over its sides, so that it is not noise
# If the weighted correlation exceeds _TOGETHER, a block with more than _TUMBLE times the median
# residual holds another motion, such as a crash.
_TOGETHER = 0.7
_TUMBLE = 25.0
# ratio of the 95 % quantiles of Student's t, with 7 degrees of freedom (8 pairs of blocks), and of
# the normal distribution
_STUDENT = 2.365 / 1.960

# samples of a flight this far apart [s] count as independent where evidence is weighed
INDEPENDENT = 0.1

UNITS = {
    180 / np.pi: "one is in degrees",
    1000.0: "one is in thousandths",
    9.80665: "one is in g, or in tenths, as mm taken for cm",
    100.0: "one is in hundredths",
}
"""Ratio of the larger signal to the smaller one -> the wrong unit that it suggests."""


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
    nats: float  # evidence for that exchange over the axes as they are, less a penalty for 48


def relate(first: Samples, second: Samples, reach: float = REACH) -> Relation | None:
    """Relate two signals of one or three components; ``reach``: largest delay [s].

    Returns None if they overlap too little or do not move.
    """
    clocks = first.time, second.time
    if min(map(len, clocks)) < 2:
        return None
    start = max(time[0] for time in clocks) + reach
    end = min(time[-1] for time in clocks) - reach
    period = max(np.median(np.diff(time)) for time in clocks)
    period = max(period, (end - start) / _LONGEST_GRID)
    count = int((end - start) / period)
    if count < 50:
        return None
    steps = int(reach / period)
    places = np.arange(count)
    values = first.at(start + period * places)
    around = second.at(start + period * np.arange(-steps, count + steps))
    relation, follows = _relate(values, around, places, period, steps)
    if relation is not None and not np.all(follows):
        relation, _ = _relate(values[follows], around, places[follows], period, steps)
    return relation


def _relate(
    values: np.ndarray, around: np.ndarray, places: np.ndarray, period: float, steps: int
) -> tuple[Relation | None, np.ndarray]:
    """Relate two signals at some points of a grid, and find the points that agree with the rest.

    Args:
        values: of the first signal at the points, shape (N, A).
        around: of the second on the grid, extended by ``steps`` at both ends, shape (M, A).
        places: indices of the points on the grid, shape (N,).
        period: of the grid [s].
        steps: largest shift of the second signal.

    Returns:
        The relation, None if a signal does not move; and whether each point agrees, shape (N,).
    """
    count = len(places)
    centred = values - np.mean(values, axis=0)
    values = values - np.median(values, axis=0)
    usual = np.median(around[places + steps], axis=0)
    edges = np.linspace(0, count, BLOCKS, endpoint=False).astype(int)
    lags = 2 * steps + 1
    sums = np.zeros((2, lags, BLOCKS))
    cross = np.zeros((values.shape[1], len(usual), lags))
    norms = np.zeros(lags)
    power = np.sum(centred**2)
    for lag in range(lags):
        moved = around[places + lag]
        moved_centred = moved - np.mean(moved, axis=0)
        cross[:, :, lag] = centred.T @ moved_centred
        norms[lag] = np.sum(moved_centred**2)
        moved = moved - usual
        products = np.vecdot(values, moved), np.vecdot(moved, moved)
        sums[:, lag] = np.add.reduceat(products, edges, axis=1)
    follows = np.ones(count, bool)
    if power <= 0.0 or np.min(norms) <= 0.0:
        return None, follows
    powers = np.add.reduceat(np.sum(values**2, axis=1), edges)
    effective = max(count * min(1.0, period / INDEPENDENT), 10.0)
    narrowest = max(2, round(_WIDTH / period))
    blocks = _Blocks(powers, *sums, effective)
    offset, sd, residual, together = blocks.delay(narrowest)
    if together > _TOGETHER:
        sizes = np.diff(np.append(edges, count))
        follows = np.repeat(residual < _TUMBLE * np.median(residual), sizes)
    correlation = np.trace(cross) / np.sqrt(power * norms)
    lag = int(np.argmax(correlation))
    axes, best, best_lag = _best_axes(cross / np.sqrt(power * norms))
    plain, turned = (min(max(c, 0.0), 0.999) for c in (correlation[lag], best))
    nats = 0.5 * effective * np.log((1.0 - plain**2) / (1.0 - turned**2)) - np.log(len(EXCHANGES))
    relation = Relation(
        delay=(offset - steps) * period,
        delay_sd=min(sd, steps) * period,
        correlation=correlation[lag],
        scale=np.trace(cross[:, :, lag]) / power,
        axes=axes,
        axes_correlation=best,
        axes_delay=(best_lag - steps) * period,
        nats=nats,
    )
    return relation, follows


def _best_axes(correlations: np.ndarray) -> tuple[str, float, int]:
    """Return the exchange of axes in which two signals correlate best, their correlation and the
    index of the lag; ``correlations``: of their components by lag, shape (A, B, K).
    """
    exchanges, matrices = EXCHANGES, MATRICES
    if correlations.shape[0] != 3:
        exchanges, matrices = ("x", "-x"), np.array([[[1.0]], [[-1.0]]])
    scores = np.einsum("kij,jil->kl", matrices, correlations)
    k, lag = np.unravel_index(np.argmax(scores), scores.shape)
    return exchanges[k], scores[k, lag], lag


@dataclass(frozen=True)
class _Blocks:
    """Products of two signals by block, each with a noise level of its own.

    A block in which the signals disagree, such as a tumble, has a small weight."""

    xx: np.ndarray  # power of the first signal in each block, shape (K,)
    xy: np.ndarray  # its product with the second at each lag, shape (L, K)
    yy: np.ndarray  # power of the second, shape (L, K)
    independent: float  # number of independent samples

    def delay(self, half: int) -> tuple[float, float, np.ndarray, float]:
        """Return the lag at which the second signal follows the first best [steps].

        A parabola is fitted to the peak of the correlation. The scatter of its slope between blocks
        gives the lag's standard deviation, also for correlated noise, if its correlation time is
        shorter than two blocks. ``half``: half the width of the narrowest parabola [steps].

        Returns the lag, its standard deviation (infinite without a clear peak), the residual power
        of each block, shape (K,), and the weighted correlation."""
        xx, xy, yy = self.xx, self.xy, self.yy
        scale = np.sum(xy, axis=1) / max(np.sum(xx), 1e-300)
        for _ in range(_ROUNDS):
            squares = yy - 2.0 * scale[:, None] * xy + scale[:, None] ** 2 * xx
            residual = np.maximum(squares, self._floor)
            power = np.sum(xx / residual, axis=1)
            scale = np.sum(xy / residual, axis=1) / np.maximum(power, 1e-300)
        likelihood = np.where(scale > 0.0, np.sum(-0.5 * np.log(residual), axis=1), -np.inf)
        best = int(np.argmax(likelihood))
        cross, first, second = (np.sum(part / residual[best]) for part in (xy[best], xx, yy[best]))
        together = cross / max(np.sqrt(first * second), 1e-300)
        while 2 * half < len(likelihood):
            # Centre of the window with the largest mean likelihood. For a slow motion, the peak
            # within a narrow window would be noise.
            width = 2 * half + 1
            mean = np.convolve(likelihood, np.full(width, 1.0 / width), "valid")
            best = int(np.argmax(mean)) + half
            window = np.arange(best - half, best + half + 1)
            fits = [polyfit(window - best, curves[window], 2) for curves in (xy, yy)]
            vertex, sd = self._vertex(*fits, half)
            if np.isfinite(sd):
                return best + vertex, sd, residual[best], together
            half *= 2
        return float(best), np.inf, residual[best], together

    @property
    def _floor(self) -> float:
        """Smallest residual power of a block."""
        return 1e-6 * np.mean(self.yy)

    def _vertex(self, xy: np.ndarray, yy: np.ndarray, half: int) -> tuple[float, float]:
        """Return the peak of a correlation and its standard deviation [steps], infinite if noise
        alone may cause such a peak.

        The peak is found in the logarithm of the correlation. So neither noise nor a signal that is
        larger at one end shifts it.

        Args:
            xy: Parabola of the signals' product in each block, powers 0 to 2, shape (3, K).
            yy: Parabola of the second signal's power in each block, shape (3, K).
            half: Half the width of the parabolas [steps].
        """
        xx = self.xx
        vertex = 0.0
        for _ in range(_ROUNDS):
            # rows: value, slope and curvature of a parabola
            powers = np.array(
                [[1.0, vertex, vertex * vertex], [0.0, 1.0, 2.0 * vertex], [0.0, 0.0, 2.0]]
            )
            product = powers @ xy
            second = powers @ yy
            scale = max(np.sum(product[0]) / np.sum(xx), 0.0)
            residual = second[0] - 2.0 * scale * product[0] + scale**2 * xx
            weight = 1.0 / np.maximum(residual, self._floor)
            cross = product @ weight
            power = second @ weight
            if cross[0] <= 0.0 or power[0] <= 0.0:
                return vertex, np.inf
            slope = cross[1] / cross[0] - 0.5 * power[1] / power[0]
            bend = cross[2] / cross[0] - (cross[1] / cross[0]) ** 2
            bend -= 0.5 * (power[2] / power[0] - (power[1] / power[0]) ** 2)
            slopes = weight * (product[1] / cross[0] - 0.5 * second[1] / power[0])
            explained = min(cross[0] ** 2 / (power[0] * np.sum(weight * xx)), 0.999)
            # loss of log-likelihood at a distance of half the parabola's width
            nats = -0.5 * self.independent * bend * half**2 * explained / (1.0 - explained)
            if nats < _NATS or abs(vertex - slope / bend) > half:
                return vertex, np.inf
            vertex -= slope / bend
        return vertex, np.sqrt(variance_of_sum(slopes)) / -bend


def variance_of_sum(scores: np.ndarray) -> float:
    """Return the variance of the sum of zero-mean scores of blocks, shape (BLOCKS,), from their
    scatter, enlarged by Student's quantile.

    Noise may stay correlated for longer than a block. So neighbours are summed in pairs first, in
    both ways of pairing."""
    pairs = np.convolve(scores, [1.0, 1.0])
    scatter = 0.5 * np.sum(np.abs(pairs) ** 2) * BLOCKS / (BLOCKS - 2)
    return float(_STUDENT**2 * scatter)


def unit_hint(ratio: float) -> str:
    """Return the text on the wrong unit that a ratio of two measurements suggests; "" if none."""
    for factor, words in UNITS.items():
        if ratio and abs(abs(np.log(abs(ratio))) - np.log(factor)) < _UNIT:
            return words
    return ""

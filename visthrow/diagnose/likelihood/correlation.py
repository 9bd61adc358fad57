"""Correlated measurement noise, as filters and trackers leave it.

A share w of the variance is the output of a filter of first or second order (Matern 1/2 and 3/2);
the rest is white:

    c(t) = (1 - w) [t = 0] + w k(t / tau),   k_1(x) = exp(-x),   k_2(x) = (1 + x) exp(-x)

Every window gets the Cholesky factors of these correlations at its stamps, with which
:mod:`visthrow.diagnose.likelihood.marginal` whitens its columns. So evidence, thresholds and
intervals account for the correlations. Differences of neighbouring samples would not show the noise
at low frequencies, at which effects act. So time, share and order maximise the likelihood of whole
windows, with initial states, latent forces and every effect integrated out: no effect is mistaken
for noise.

Source: Rasmussen and Williams 2006, section 4.2.1 (kernels) and 5.4.1 (marginal likelihood).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np
from numpy import ndarray
from scipy.optimize import minimize
from scipy.special import expit, logit

from visthrow.diagnose.likelihood import noise_levels as noise
from visthrow.diagnose.likelihood.evidence import STRONG, VERY_STRONG
from visthrow.diagnose.likelihood.marginal import correlate_all, hidden_gram, residual_after_fit
from visthrow.diagnose.likelihood.threads import parallel_map
from visthrow.diagnose.models.model_interface import Window

T = TypeVar("T")

SUSPECT = 0.1
"""Correlation of neighbouring samples above which a channel is examined. For ten thousand white
samples its standard deviation is 0.01.
"""

LONGEST = 0.15
"""Longest correlation time [s]. A residual that lasts longer is a modelling error, not sensor
noise.
"""

SHARES = 0.5, 0.999
"""Limits of the correlated share of the variance. The white remainder keeps the inverse of the
correlations finite in double precision.
"""

START = np.array([[1.4, 3.0], [2.5, 3.0], [1.4, 5.0]])
"""Initial simplex of the search: logarithms of the time in sampling periods and of the share's
odds.
"""

# windows that the estimate uses; also the size of a sample that is tried before all windows are
LOOKED_AT = 8


@dataclass(frozen=True)
class Correlation:
    """Correlated noise of one channel."""

    time: float  # [s]
    share: float  # of the variance
    order: int  # of the filter: 1 or 2
    scale: float = 1.0  # factor on the stated sigma

    def at_lag(self, lag: ndarray) -> ndarray:
        """Return the correlation of samples ``lag`` [s] apart."""
        x = np.abs(lag) / self.time
        kernel = np.exp(-x)
        if self.order == 2:
            kernel = kernel * (1.0 + x)
        white = 1.0 - self.share
        return self.share * kernel + white * (lag == 0.0)


def components(window: Window, channel: int) -> ndarray | None:
    """Return the rows of a channel's samples in the order of time, shape (stamps, components); None
    where the components have different stamps.
    """
    rows = np.flatnonzero(window.channel == channel)
    time = window.time[rows]
    stamps, counts = np.unique(time, return_counts=True)
    if len(stamps) < 4 or np.any(counts != counts[0]):
        return None
    in_order = rows[np.argsort(time, kind="stable")]
    return in_order.reshape(len(stamps), counts[0])


def with_correlations(
    windows: Sequence[Window], correlations_of: Mapping[int, Correlation]
) -> list[Window]:
    """Add the correlations of the channels' noise to windows.

    ``windows``: with white noise; ``correlations_of``: by index of the channel."""
    if not correlations_of:
        return list(windows)
    return parallel_map(partial(_add_correlation, correlations_of=correlations_of), windows)


def _add_correlation(window: Window, correlations_of: Mapping[int, Correlation]) -> Window:
    factors = []
    sigma = window.sigma.copy()
    for channel, correlation in correlations_of.items():
        rows = components(window, channel)
        if rows is None:
            continue
        time = window.time[rows[:, 0]]
        alike = correlation.at_lag(time[:, None] - time)
        factors.append((rows, np.linalg.cholesky(alike)))
        sigma[rows] *= correlation.scale
    return replace(window, sigma=sigma, correlated=tuple(factors))


def correlations(
    windows: Sequence[Window], slabs: ndarray, channels: int
) -> dict[int, Correlation]:
    """Find the channels whose noise is correlated, and estimate the correlation.

    ``slabs``: prior deviation of each effect in its unit, shape (K,); ``channels``: number of the
    model's channels. Returns channel -> correlation, for noise that is surely not white."""
    free = [_free_effects(window, slabs) for window in few_of(windows)]
    bare = parallel_map(partial(hidden_gram, channels=channels), free)
    fits = noise.widely_fitted(free, bare)
    residuals = parallel_map(residual_after_fit, free, fits)
    correlations_of = {}
    for channel in range(channels):
        scale = _suspect_deviation(free, residuals, channel)
        if scale is None:
            continue
        best, nats = _likeliest(free, channels, correlations_of, channel, scale)
        if nats > VERY_STRONG:
            correlations_of[channel] = best
    return correlations_of


def few_of(items: Sequence[T]) -> list[T]:
    """Return :data:`LOOKED_AT` of the items, spread evenly."""
    places = np.linspace(0, len(items) - 1, LOOKED_AT).astype(int)
    return [items[i] for i in np.unique(places)]


def _free_effects(window: Window, slabs: ndarray) -> Window:
    """Return the window with its effects as nuisances, so that each is fitted in this window
    alone.
    """
    states = np.hstack((window.nuisance, window.effects))
    deviations = np.append(window.nuisance_sd, slabs)
    none = window.effects[:, :0]
    return replace(window, nuisance=states, nuisance_sd=deviations, effects=none)


def _suspect_deviation(
    windows: Sequence[Window], residuals: Sequence[ndarray], channel: int
) -> float | None:
    """Return the standard deviation of a channel's residual in multiples of the stated one; None
    where neighbouring samples are hardly correlated.
    """
    parts = []
    for window, residual in zip(windows, residuals):
        rows = components(window, channel)
        if rows is not None:
            parts.append(residual[rows] / window.sigma[rows])
    if not parts:
        return None
    together = np.concatenate([part.ravel() for part in parts])
    distant = noise.HUBER * noise.MAD_TO_SIGMA * np.median(np.abs(together))
    parts = [np.clip(part, -distant, distant) for part in parts]
    square = sum((part**2).sum() for part in parts)
    neighbours = sum((part[1:] * part[:-1]).sum() for part in parts)
    if neighbours <= SUSPECT * square:  # also where both are 0
        return None
    return np.sqrt(square / len(together))


def _likeliest(
    windows: Sequence[Window],
    channels: int,
    correlations_of: Mapping[int, Correlation],
    channel: int,
    scale: float,
) -> tuple[Correlation, float]:
    """Return the likeliest correlation of a channel, given those of other channels, and by how many
    nats it is ahead of white noise.

    Time and share trade off along a ridge. Of the guesses that are nearly as likely as the best,
    the one with the shortest time is returned."""
    steps = [np.diff(np.unique(w.time[w.channel == channel])) for w in windows]
    period = np.median(np.concatenate(steps))
    white = [Correlation(period, 0.0, 1, deviation) for deviation in (1.0, scale)]
    if period > LONGEST:
        return white[0], 0.0
    none = max(_likelihood(windows, channels, correlations_of, channel, w)[0] for w in white)
    tried = []
    levels = None

    def shortfall(place: ndarray, order: int) -> float:
        nonlocal levels
        guess = Correlation(period * np.exp(place[0]), expit(place[1]), order, scale)
        value, levels = _likelihood(windows, channels, correlations_of, channel, guess, levels)
        tried.append((value, replace(guess, scale=scale * levels.scale[channel])))
        return -value

    bounds = [(0.0, np.log(2.0 * LONGEST / period)), logit(SHARES)]
    order = min((1, 2), key=lambda order: shortfall(START[0], order))
    simplex = np.clip(START, *np.transpose(bounds))
    options = {"initial_simplex": simplex, "xatol": np.inf, "fatol": noise.ENOUGH_NATS}
    minimize(shortfall, simplex[0], (order,), "Nelder-Mead", bounds=bounds, options=options)
    best = max(value for value, _ in tried)
    near = [guess for value, guess in tried if value > best - STRONG and guess.time <= LONGEST]
    if not near:
        return white[0], 0.0
    return min(near, key=lambda guess: guess.time), best - none


def _likelihood(
    windows: Sequence[Window],
    channels: int,
    correlations_of: Mapping[int, Correlation],
    channel: int,
    guess: Correlation,
    start: noise.Noise | None = None,
) -> tuple[float, noise.Noise]:
    """Return the log marginal likelihood of windows for a guess of a channel's correlation, and the
    likeliest noise levels; ``start``: where the search for the levels begins.
    """
    correlated = with_correlations(windows, {**correlations_of, channel: guess})
    grams = parallel_map(partial(hidden_gram, channels=channels), correlated)
    shaped = correlate_all(grams, correlated, noise.CORRELATION_TIMES[1])
    levels, value = noise.roughly(shaped, start)
    return value, levels

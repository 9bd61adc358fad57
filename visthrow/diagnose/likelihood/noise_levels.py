"""Estimate noise levels: scales of sensor noise, and standard deviations of latent forces.

One bad window would spoil a plain maximum-likelihood fit. Three guards prevent this, and a test
plants a fault for each. Single samples far out lose weight (Huber). A window's latent forces may be
stronger or weaker than those of its phase: their variance has an inverse gamma prior, so the forces
have the heavy tails of a Student distribution. Every level is bounded."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy import ndarray

from visthrow.diagnose.likelihood.integrals import fit_windows, look
from visthrow.diagnose.likelihood.marginal import (
    TAIL,
    Gram,
    Noise,
    correlate_all,
    hidden_gram,
    residual_after_fit,
    without_effects,
)
from visthrow.diagnose.likelihood.threads import parallel_map
from visthrow.diagnose.models.model_interface import LATENT_BLOCKS, Indices, Window
from visthrow.logs.check.signals import MAD_TO_SIGMA

CORRELATION_TIMES = (0.15, 0.3, 0.6, 1.2, 2.4)
"""Correlation times of latent forces that :func:`fit` compares [s]: from one knot to longer than a
window.
"""

SCALE_BOUNDS = (0.3, 10.0)  # of a channel's sigma, relative to the stated one

LEVEL_LOW = 1e-2
LEVEL_HIGH = 1e4
"""Bounds of latent deviations, relative to the level at which they become visible.

A hundredth of that level is as good as 0: even thousands of knots together do not show it. Far
below it, gradients are lost in rounding.
"""

HUBER = 6.0  # distance in sigmas from which a sample loses weight
# a larger share beyond ``HUBER`` is no outlier but a modelling error, which must stay visible
HUBER_SHARE = 0.02
SHARE_BOUNDS = (0.1, 1e3)  # of a window's latent deviation, relative to its phase's

PRIOR_CURVATURE = (0.05, 2.0)
"""Limits of the curvature of the prior by the logarithm of a window's share, relative to that at a
share of 1. It is small for windows far from the others.
"""

CLEANINGS = 4  # rounds in which outliers lose weight
# latent deviation during the search for outliers, relative to the level at which it is visible
WIDE = 30.0

ITERATIONS = 40
ENOUGH_NATS = 0.2
"""The search for the levels ends with a step that promises less; about a twentieth of it
remains.
"""
ROUGHLY_NATS = 1.0  # the same while correlation times are compared
# largest decrease of a level's logarithm in one step: a step of the variance may lead below 0
LONGEST_FALL = 1.0
HALVINGS = 8
STALLED = 1e-3  # of a level: limits count as reached within this share of it


def fit(
    windows: Sequence[Window],
    grams: Sequence[Gram],
    start: Noise | None = None,
) -> tuple[Noise, list[Gram]]:
    """Estimate sensor scales, latent deviations by block and phase, and their correlation time.

    ``windows``: for the knots of the latent forces; ``grams``: of the windows, with ``factor`` the
    identity; ``start``: an earlier estimate, which gives the correlation time and the levels from
    which the search starts. Returns the levels, and the grams with their latent forces correlated
    accordingly."""
    if start is None and any(gram.latents for gram in grams):
        start = _likeliest(windows, grams)
    time = CORRELATION_TIMES[0] if start is None else start.correlation_time
    shaped = correlate_all(grams, windows, time)
    return maximise(shaped, start or _guess(shaped))[0], shaped


def _likeliest(windows: Sequence[Window], grams: Sequence[Gram]) -> Noise:
    """Return rough levels with the likeliest correlation time.

    The likelihood has one maximum over the correlation time, so the search climbs from the middle
    one."""
    bare = [without_effects(gram) for gram in grams]
    levels_of = {}

    def likely(i: int, noise: Noise | None) -> float:
        if i not in levels_of:
            shaped = correlate_all(bare, windows, CORRELATION_TIMES[i])
            begin = replace(noise or _guess(shaped), correlation_time=CORRELATION_TIMES[i])
            levels_of[i] = maximise(shaped, begin, ROUGHLY_NATS)
        return levels_of[i][1]

    best = len(CORRELATION_TIMES) // 2
    likely(best, None)
    for way in (-1, 1):
        while 0 <= best + way < len(CORRELATION_TIMES):
            noise, nats = levels_of[best]
            if likely(best + way, noise) <= nats:
                break
            best += way
    return levels_of[best][0]


def only(noise: Noise, grams: Sequence[Gram], windows: Indices) -> Noise:
    """Return the levels for some of the windows, whose ``grams`` these are; levels that are not
    known yet are guessed.
    """
    guess = _guess(grams).latent_sd
    levels = {key: noise.latent_sd.get(key, level) for key, level in guess.items()}
    return replace(noise, share=noise.share[list(windows)], latent_sd=levels)


def roughly(grams: Sequence[Gram], start: Noise | None = None) -> tuple[Noise, float]:
    """Return rough levels of grams with correlated latents, and their log-likelihood; ``start``:
    levels of similar grams, from which the search starts.
    """
    guess = only(start, grams, range(len(grams))) if start else _guess(grams)
    return maximise(grams, guess, ROUGHLY_NATS)


def _guess(grams: Sequence[Gram]) -> Noise:
    """Return the stated sensor noise, and latent forces at the level at which they become
    visible.
    """
    scale = np.ones(len(grams[0].count))
    visible = defaultdict(list)
    for gram in grams:
        for block, information in gram.visibility.items():
            if information > 0.0:  # else these forces have no effect on the window
                visible[block, gram.phase].append(1.0 / np.sqrt(information))
    medians = {key: np.median(levels) for key, levels in visible.items()}
    share = np.ones((len(grams), len(LATENT_BLOCKS)))
    return Noise(scale, medians, CORRELATION_TIMES[0], share)


@dataclass(frozen=True)
class _Layout:
    """The order of the search's parameters: the phases' levels, each window's share of them by
    block, sensor scales.

    A parameter without effect has a gradient of 0, and keeps its value."""

    keys: tuple[tuple[int, str], ...]  # (block, phase)
    phases: ndarray  # index of the level to which each share belongs, shape (W B,)
    # indices of each window's parameters: its phase's levels, scales, shares, shape (W, 2 B + C)
    places: ndarray

    @staticmethod
    def numbered(grams: Sequence[Gram], noise: Noise) -> "_Layout":
        """Number the parameters."""
        keys = tuple(sorted(noise.latent_sd))
        number = {key: i for i, key in enumerate(keys)}
        windows, blocks = noise.share.shape
        pairs = [(block, gram.phase) for gram in grams for block in range(blocks)]
        phases = np.array([number.get(pair, 0) for pair in pairs], dtype=int)
        shares = len(keys) + np.arange(len(phases))
        scales = len(keys) + len(phases) + np.arange(len(noise.scale))
        parts = (
            phases.reshape(windows, -1),
            np.tile(scales, (windows, 1)),
            shares.reshape(windows, -1),
        )
        return _Layout(keys, phases, np.hstack(parts))

    @property
    def shares(self) -> slice:
        """Return the range of the windows' shares among the parameters."""
        first = len(self.keys)
        return slice(first, first + len(self.phases))

    def pack(self, noise: Noise) -> ndarray:
        """Return the logarithms of all levels, shape (P,)."""
        levels = [noise.latent_sd[key] for key in self.keys]
        return np.log(np.concatenate((levels, noise.share.ravel(), noise.scale)))

    def unpack(self, x: ndarray, noise: Noise) -> Noise:
        """Return the levels from their logarithms; everything else is taken from ``noise``."""
        sizes = np.exp(x)
        shares = self.shares
        levels = dict(zip(self.keys, sizes.tolist()))
        share = sizes[shares].reshape(noise.share.shape)
        return replace(noise, scale=sizes[shares.stop :], share=share, latent_sd=levels)

    def limits(self, grams: Sequence[Gram]) -> tuple[ndarray, ndarray]:
        """Return the lowest and highest values of the parameters."""
        guess = _guess(grams).latent_sd
        visible = [guess[key] for key in self.keys]
        channels = len(grams[0].count)
        limits = []
        for level, share, scale in zip((LEVEL_LOW, LEVEL_HIGH), SHARE_BOUNDS, SCALE_BOUNDS):
            shares = np.full(len(self.phases), share)
            scales = np.full(channels, scale)
            limits.append(np.log(np.concatenate((np.multiply(level, visible), shares, scales))))
        return tuple(limits)


def maximise(
    grams: Sequence[Gram], noise: Noise, tolerance: float = ENOUGH_NATS
) -> tuple[Noise, float]:
    """Maximise the posterior probability of all levels' logarithms within their limits, by Fisher
    scoring.

    The expected curvature costs little more than the gradient, and a few evaluations suffice.
    ``noise``: where the search starts; ``tolerance``: the search ends with a step that promises
    less [nats]. Returns the levels and their log-likelihood."""
    layout = _Layout.numbered(grams, noise)
    low, high = layout.limits(grams)
    x = np.clip(layout.pack(noise), low, high)
    value, slope, curvature = _likelihood(grams, layout.unpack(x, noise), layout)
    for _ in range(ITERATIONS):
        step, promised = _scoring_step(layout, x, slope, curvature, low, high)
        if promised < tolerance:  # the step is taken without an evaluation
            return layout.unpack(x + step, noise), value + 0.5 * promised
        for _ in range(HALVINGS):
            levels = layout.unpack(x + step, noise)
            tried, its_slope, expected = _likelihood(grams, levels, layout)
            if tried > value:
                break
            step = step / 3.0
            promised = promised / 3.0
            if promised < tolerance:
                return layout.unpack(x, noise), value
        else:
            break
        x = x + step
        value = tried
        slope = its_slope
        curvature = expected
    return layout.unpack(x, noise), value


def _scoring_step(
    layout: _Layout,
    x: ndarray,
    slope: ndarray,
    curvature: ndarray,
    low: ndarray,
    high: ndarray,
) -> tuple[ndarray, float]:
    """Return Fisher's step of the variances within the limits, expressed in logarithms of the
    levels, and the gain that it promises [nats].

    Parameters held by a limit stay there while the others move. If a variance is far too small, the
    gradient by its logarithm vanishes, but the step of the variance itself is finite. A window's
    variance takes the steps of its phase's level and of its share together."""
    diagonal = np.diag(curvature)
    at_low = (x <= low + STALLED) & (slope < 0.0)
    at_high = (x >= high - STALLED) & (slope > 0.0)
    free = (diagonal > 0.0) & ~at_low & ~at_high
    step = np.zeros_like(x)
    if not np.any(free):
        return step, 0.0
    size = np.sqrt(diagonal[free])
    part = curvature[np.ix_(free, free)]
    part /= size[:, None]
    part /= size
    part.flat[:: len(part) + 1] += 1e-6
    right = slope[free] / size
    step[free] = np.linalg.solve(part, right) / size
    promised = slope @ step
    turned = _logarithms(step)
    whole = step[layout.shares] + step[layout.phases]
    turned[layout.shares] = _logarithms(whole) - turned[layout.phases]
    return np.clip(x + turned, low, high) - x, promised


def _logarithms(step: ndarray) -> ndarray:
    """Convert steps of variances, relative to them, into changes of the levels' logarithms."""
    return 0.5 * np.log1p(np.maximum(2.0 * step, np.expm1(-2.0 * LONGEST_FALL)))


def _likelihood(
    grams: Sequence[Gram], noise: Noise, layout: _Layout
) -> tuple[float, ndarray, ndarray]:
    """Return the log-likelihood with the prior of the windows' shares, its gradient by the
    parameters and its expected curvature.
    """
    values, slopes, curvatures = look(grams, noise)
    places = layout.places
    # a share moves a window as its phase's level does
    moved = np.append(np.arange(slopes.shape[1]), np.arange(noise.share.shape[1]))
    slope = np.zeros(places.max() + 1)
    np.add.at(slope, places, slopes[:, moved])
    curvature = np.zeros((len(slope), len(slope)))
    pairs = places[:, :, None], places[:, None]
    np.add.at(curvature, pairs, curvatures[:, moved[:, None], moved])
    inverse = noise.share.ravel() ** -2.0
    slope[layout.shares] += TAIL * (inverse - 1.0)
    diagonal = np.einsum("ii->i", curvature)  # a view
    diagonal[layout.shares] += 2.0 * TAIL * np.clip(inverse, *PRIOR_CURVATURE)
    return noise.log_prior + values.sum(), slope, curvature


def without_outliers(windows: Sequence[Window], grams: Sequence[Gram]) -> list[Window]:
    """Increase the sigma of outliers so that they lie at HUBER; windows without outliers are
    returned unchanged.

    Latent forces have a wide prior here. They can follow any missing effect, so a sample that they
    cannot follow is an outlier. ``grams``: of the windows, with ``factor`` the identity."""
    sigmas = [window.sigma for window in windows]
    windows_left = list(range(len(windows)))
    starts = list(windows)
    bare = [without_effects(gram) for gram in grams]
    for _ in range(CLEANINGS):
        fits = widely_fitted(starts, bare)
        residuals = parallel_map(residual_after_fit, starts, fits)
        looked_at = windows_left
        windows_left = []
        for w, residual in zip(looked_at, residuals):
            distance = _outlier_distances(windows[w], residual)
            if np.any(distance > 1.0):
                sigmas[w] = windows[w].sigma * np.maximum(distance, 1.0)
                windows_left.append(w)
        if not windows_left:
            break
        starts = [replace(windows[w], sigma=sigmas[w]) for w in windows_left]
        bare = parallel_map(partial(hidden_gram, channels=len(grams[0].count)), starts)
    return [_with_sigmas(window, sigma) for window, sigma in zip(windows, sigmas)]


def widely_fitted(windows: Sequence[Window], bare: Sequence[Gram]) -> list[ndarray]:
    """Fit initial states, in prior deviations, and latents at the knots, with wide priors of the
    latents.
    """
    time = CORRELATION_TIMES[0]
    shaped = correlate_all(bare, windows, time)
    share = np.zeros((len(bare), len(LATENT_BLOCKS)))
    for row, gram in zip(share, bare):
        for (block, _), level in _guess([gram]).latent_sd.items():
            row[block] = WIDE * level
    levels = {(block, gram.phase): 1.0 for gram in bare for block in gram.visibility}
    noise = Noise(np.ones(len(bare[0].count)), levels, time, share)
    fits, _ = fit_windows(shaped, noise)
    for fit, gram in zip(fits, shaped):
        latents = fit[gram.nuisances :]
        fit[gram.nuisances :] = gram.factor @ latents
    return fits


def _outlier_distances(window: Window, residual: ndarray) -> ndarray:
    """Return the distances of samples relative to that at which they become outliers, shape
    (N,).
    """
    normal = np.abs(residual) / window.sigma
    return normal / (HUBER * np.maximum(1.0, MAD_TO_SIGMA * np.median(normal)))


def _with_sigmas(window: Window, sigma: ndarray) -> Window:
    """Return the window with other sigmas if only a few of them differ, else unchanged."""
    share = (sigma > window.sigma).mean()
    if 0.0 < share <= HUBER_SHARE:
        return replace(window, sigma=sigma)
    return window

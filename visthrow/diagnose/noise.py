"""Noise levels: sensor noise from differences of neighbours, latent forces from the likelihood of all windows.

A pure fit of everything by maximum likelihood is pulled away by one bad window; hence three guards, each tested by a planted
fault: single samples far outside lose weight (Huber), a window whose latent forces are far above those of its phase gets a
level of its own, and every level is bounded.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from visthrow.diagnose.marginal import Gram, Noise, columns, correlated, gram_of, posterior
from visthrow.diagnose.model import LATENT_BLOCKS, Window

MAD_TO_SIGMA = 1.4826
THIRD_DIFFERENCE = np.sqrt(20.0)
"""Deviation of a third difference of white noise, in sigmas: the root of 1 + 9 + 9 + 1."""

CORRELATION_TIMES = (0.15, 0.6, 2.4)
"""Of latent forces [s]: from one knot to longer than a window, the candidates of :func:`fit`."""

SCALE_BOUNDS = (0.3, 10.0)
"""Of a channel's sigma against what the model said."""

LEVEL_RANGE = 1e4
"""Latent deviations stay within this factor of the level at which they become visible, both ways."""

HUBER = 6.0
"""Sigmas from which a sample loses weight."""

HUBER_SHARE = 0.02
"""More samples than this beyond ``HUBER`` are no outliers but a misfit, which must stay visible."""

BAD_NATS = 8.0
"""Log-likelihood that a window's own level must gain; that of chance stays below 4 in a hundred windows."""

BAD_SHARE = 0.34
"""Share of a phase's windows that may be bad; where more are, the phase is rough."""

FACTORS = tuple(2.5 * 1.6**k for k in range(18))
"""Of the phase's level that are tried for a bad window."""

CLEANINGS = 4
"""Rounds in which outliers lose weight."""

WIDE = 30.0
"""Latent forces while outliers are looked for, in the level at which they become visible."""

ITERATIONS = 40
ENOUGH_NATS, ENOUGH_SLOPE = 0.02, 0.3
"""A step that gains less, or a slope below [nats by the logarithm of a level], ends the search for the levels."""

ROUNDS = 10
"""Of levels of bad windows in turn with those of their phases; mostly one or two are needed."""


def highpass_sigma(values: np.ndarray) -> np.ndarray:
    """Standard deviation of white sensor noise on a smooth signal, unmoved by outliers.

    Third differences remove motion up to second order within four samples; their median absolute deviation is scaled to a
    normal distribution's sigma.

    Args:
        values: evenly sampled, shape (T,) or (T, D), T >= 4.

    Returns:
        Sigma in the values' unit, shape () or (D,).

    Source: diagnosis by high-pass differences; Rousseeuw and Croux 1993 for the median absolute deviation.
    """
    third = np.diff(np.asarray(values, dtype=float), n=3, axis=0)
    return MAD_TO_SIGMA * np.median(np.abs(third - np.median(third, axis=0)), axis=0) / THIRD_DIFFERENCE


def fit(windows: Sequence[Window], grams: Sequence[Gram], start: Noise | None = None) -> tuple[Noise, list[Gram]]:
    """Estimate sensor scales, latent deviations by block and phase, and their correlation time.

    Args:
        windows: for the knots of the latent forces.
        grams: of the windows, with ``factor`` the identity.
        start: an earlier estimate: its correlation time is kept, its levels are where the search starts.

    Returns:
        The levels, and the grams with correlated latent forces that belong to them.
    """
    times = CORRELATION_TIMES if start is None else (start.correlation_time,)
    if not any(gram.latents for gram in grams):
        times = times[:1]
    best: tuple[float, Noise, list[Gram]] | None = None
    for time in times:
        shaped = [correlated(gram, window, time) for gram, window in zip(grams, windows)]
        noise = start or (best[1] if best else _first_guess(shaped))
        noise, value = _maximise(shaped, replace(noise, correlation_time=time))
        if best is None or value > best[0]:
            best = value, noise, shaped
    _, noise, shaped = best
    for _ in range(ROUNDS):
        own = _own_levels(shaped, noise)
        if np.allclose(own, noise.own, rtol=0.5, equal_nan=True):
            break
        noise, _ = _maximise(shaped, replace(noise, own=own))
    return noise, shaped


def _first_guess(grams: Sequence[Gram]) -> Noise:
    """Sensor noise as stated, latent forces where they just become visible."""
    scale = np.ones(len(grams[0].count))
    visible: dict[tuple[int, str], list[float]] = {}
    for gram in grams:
        part = slice(gram.nuisances, gram.nuisances + gram.latents)
        curvature = np.diagonal(gram.inner.sum(0))[part]
        for block in np.unique(gram.latent_block):
            seen = curvature[gram.latent_block == block]
            visible.setdefault((int(block), gram.phase), []).append(1.0 / np.sqrt(max(np.median(seen), 1e-300)))
    return Noise(scale, {key: float(np.median(v)) for key, v in visible.items()}, CORRELATION_TIMES[0],
                 np.full((len(grams), len(LATENT_BLOCKS)), np.nan))  # fmt: skip


def _maximise(grams: Sequence[Gram], noise: Noise) -> tuple[Noise, float]:
    """Maximum likelihood of the logarithms of all levels, with exact gradients and explicit limits."""
    from scipy.optimize import minimize

    keys = sorted(noise.latent_sd)
    seen = np.flatnonzero(sum(gram.count for gram in grams) > 0)
    guess = _first_guess(grams).latent_sd
    start = np.log([noise.latent_sd[key] for key in keys] + [noise.scale[c] for c in seen])
    reach = np.log(LEVEL_RANGE)
    bounds = [(np.log(guess[key]) - reach, np.log(guess[key]) + reach) for key in keys]
    bounds += [tuple(np.log(SCALE_BOUNDS))] * len(seen)
    start = np.clip(start, [low for low, _ in bounds], [high for _, high in bounds])

    def levels(x: np.ndarray) -> Noise:
        scale = noise.scale.copy()
        scale[seen] = np.exp(x[len(keys) :])
        return replace(noise, scale=scale, latent_sd=dict(zip(keys, np.exp(x[: len(keys)]).tolist())))

    def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
        value, by_level, by_scale = _likelihood(grams, levels(x), keys)
        return -value, -np.concatenate((by_level, by_scale[seen]))

    tolerance = ENOUGH_NATS / max(1.0, abs(cost(start)[0]))
    options = {"maxiter": ITERATIONS, "maxcor": 10, "ftol": tolerance, "gtol": ENOUGH_SLOPE, "maxls": 20}
    result = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return levels(result.x), -float(result.fun)


def _likelihood(grams: Sequence[Gram], noise: Noise, keys: Sequence[tuple[int, str]]) -> tuple[float, np.ndarray, np.ndarray]:
    """Log-likelihood and its gradients by the logarithms of latent deviations and of sensor scales."""
    value, by_level, by_scale = 0.0, np.zeros(len(keys)), np.zeros(len(noise.scale))
    index = {key: i for i, key in enumerate(keys)}
    for w, gram in enumerate(grams):
        state = posterior(gram, noise, w)
        value += state.log_likelihood
        second = np.outer(state.mean, state.mean) + state.covariance
        excess = np.bincount(gram.latent_block, np.diagonal(second)[gram.nuisances :] - 1.0, len(LATENT_BLOCKS))
        for block in range(len(LATENT_BLOCKS)):
            if (block, gram.phase) in index and np.isnan(noise.own[w, block]):
                by_level[index[block, gram.phase]] += excess[block]
        level, size = noise.deviation(gram, w), len(state.mean)
        second *= np.outer(level, level)
        left = gram.square - 2.0 * gram.cross[:, :size] @ (level * state.mean)
        left += gram.inner[:, :size, :size].reshape(len(left), -1) @ second.ravel()
        by_scale += left / noise.scale**2 - gram.count
    return value, by_level, by_scale


def _own_levels(grams: Sequence[Gram], noise: Noise) -> np.ndarray:
    """Latent deviations of windows that stand far above their phase's, shape (windows, 3); NaN for all others."""
    own = np.full_like(noise.own, np.nan)
    for w, gram in enumerate(grams):
        for block in np.unique(gram.latent_block):
            own[w, block] = _own_level(gram, noise, w, int(block))
    for phase in {gram.phase for gram in grams}:
        of_phase = np.array([gram.phase == phase for gram in grams])
        many = np.isfinite(own[of_phase]).sum(0) > BAD_SHARE * of_phase.sum()  # what many windows have is the phase's own level
        own[np.ix_(of_phase, many)] = np.nan
    return own


def _own_level(gram: Gram, noise: Noise, window: int, block: int) -> float:
    shared = noise.latent_sd[block, gram.phase]

    def likelihood(level: float) -> float:
        own = noise.own.copy()
        own[window, block] = level
        return posterior(gram, replace(noise, own=own), window).log_likelihood

    plain = likelihood(shared)
    best, chosen = plain + BAD_NATS, np.nan
    for factor in FACTORS:
        value = likelihood(factor * shared)
        if value > best:
            best, chosen = value, factor * shared
        elif value < plain:
            break
    return chosen


def without_outliers(windows: Sequence[Window], floors: np.ndarray, channels: int) -> list[Window]:
    """Give single samples far outside a sigma that puts them at HUBER; windows with none are returned as they are.

    Latent forces have a wide prior here, so that a missing effect is followed and only what no force can do stands out.

    Args:
        windows: of the flights.
        floors: of the effects, shape (K,).
        channels: number of the model's channels.
    """
    return [_mended(window, floors, channels) for window in windows]


def _mended(window: Window, floors: np.ndarray, channels: int) -> Window:
    sigma = window.sigma
    for _ in range(CLEANINGS):
        gram = gram_of(replace(window, sigma=sigma), floors, channels)
        guess = _first_guess([gram])
        wide = replace(guess, latent_sd={key: WIDE * level for key, level in guess.latent_sd.items()})
        shaped = correlated(gram, window, wide.correlation_time)
        fitted = wide.deviation(shaped, 0) * posterior(shaped, wide, 0).mean
        fitted[gram.nuisances :] = shaped.factor @ fitted[gram.nuisances :]
        left = window.residual - columns(window, floors)[:, : len(fitted)] @ fitted
        normal = np.abs(left) / window.sigma
        far = normal / (HUBER * np.maximum(1.0, MAD_TO_SIGMA * np.median(normal)))
        if not np.any(far > 1.0):
            break
        sigma = window.sigma * np.maximum(far, 1.0)
    outliers = sigma > window.sigma
    return replace(window, sigma=sigma) if 0.0 < outliers.mean() <= HUBER_SHARE else window

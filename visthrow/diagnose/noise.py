"""Noise levels: sensor noise from differences of neighbours, latent forces from the likelihood of all windows.

A pure fit of everything by maximum likelihood is pulled away by one bad window; hence three guards, each tested by a planted
fault: single samples far outside lose weight (Huber), a window whose latent forces are far above those of its phase gets a
level of its own, and every level is bounded.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from visthrow.diagnose.marginal import (
    Gram,
    Noise,
    Posterior,
    columns,
    correlated,
    hidden_gram,
    posterior,
    without_effects,
)
from visthrow.diagnose.model import LATENT_BLOCKS, Window
from visthrow.diagnose.threads import each

MAD_TO_SIGMA = 1.4826
THIRD_DIFFERENCE = np.sqrt(20.0)
"""Deviation of a third difference of white noise, in sigmas: the root of 1 + 9 + 9 + 1."""

CORRELATION_TIMES = (0.15, 0.6, 2.4)
"""Of latent forces [s]: from one knot to longer than a window, the candidates of :func:`fit`."""

SCALE_BOUNDS = (0.3, 10.0)
"""Of a channel's sigma against what the model said."""

LEVEL_LOW, LEVEL_HIGH = 1e-2, 1e4
"""Latent deviations, in the level at which they become visible. A hundredth of it is as good as none: thousands of knots
together do not show it, and far below it slopes are lost in rounding."""

HUBER = 6.0
"""Sigmas from which a sample loses weight."""

HUBER_SHARE = 0.02
"""More samples than this beyond ``HUBER`` are no outliers but a misfit, which must stay visible."""

BAD_NATS = 8.0
"""Log-likelihood that a window's own level must gain; that of chance stays below 4 in a hundred windows."""

GOOD_NATS = 2.0
"""That a bad window's own level must still be worth, once the levels of all others have moved: less than it took, so that sets of
bad windows do not follow each other in a circle."""

BAD_SHARE = 0.34
"""Share of a phase's windows that may be bad; where more are, the phase is rough."""

FACTORS = tuple(2.5 * 1.6**k for k in range(18))
"""Of the phase's level that are tried for a bad window."""

CLEANINGS = 4
"""Rounds in which outliers lose weight."""

WIDE = 30.0
"""Latent forces while outliers are looked for, in the level at which they become visible."""

ITERATIONS = 40
ENOUGH_NATS = 0.02
"""A step that promises or brings less ends the search for the levels."""
LONGEST_FALL = 1.0
"""Of the logarithm of a level in one step: its variance may be predicted to fall below 0."""
HALVINGS = 8
STALLED = 1e-9
"""Of the step: limits and levels count as met within this."""

ROUNDS = 10
"""In which the windows that count as bad may change; mostly one or two are needed."""


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
    bare = [without_effects(gram) for gram in grams]
    best: tuple[float, Noise, list[Gram]] | None = None
    for time in times:
        shaped = each(lambda w: correlated(bare[w], windows[w], time), range(len(bare)))  # noqa: B023  waits for the result
        noise = start or (best[1] if best else _first_guess(shaped))
        noise, value = _maximise(shaped, replace(noise, correlation_time=time))
        if best is None or value > best[0]:
            best = value, noise, shaped
    noise = _with_own_levels(best[2], best[1])
    return noise, each(lambda w: correlated(grams[w], windows[w], noise.correlation_time), range(len(grams)))


def refit(grams: Sequence[Gram], start: Noise) -> Noise:
    """Estimate the levels anew, with the correlation time that the grams have been given.

    Args:
        grams: of the windows, with correlated latent forces.
        start: where the search starts.
    """
    bare = [without_effects(gram) for gram in grams]
    noise, _ = _maximise(bare, start)
    return _with_own_levels(bare, noise)


def _with_own_levels(grams: Sequence[Gram], noise: Noise) -> Noise:
    """The levels with those of bad windows, until the same windows count as bad: then all levels are at their best together."""
    common: set[tuple[str, int]] = set()
    for _ in range(ROUNDS):
        own = _own_levels(grams, noise, common)
        if np.all(np.isfinite(own) == np.isfinite(noise.own)):
            break
        noise, _ = _maximise(grams, replace(noise, own=own))
    return noise


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
    """Maximum likelihood of the logarithms of all levels, with exact gradients and explicit limits.

    By Fisher scoring: the expected curvature costs nothing beside the gradient, and a few looks at all windows suffice.
    """
    keys, bad = sorted(noise.latent_sd), np.argwhere(np.isfinite(noise.own))
    seen = np.flatnonzero(sum(gram.count for gram in grams) > 0)
    guess = _first_guess(grams).latent_sd
    visible = np.log([guess[key] for key in keys] + [guess[int(block), grams[w].phase] for w, block in bad])
    latents, first_own = len(visible), len(keys)
    levels_now = [noise.latent_sd[key] for key in keys] + [noise.own[w, block] for w, block in bad]
    x = np.log(levels_now + [noise.scale[c] for c in seen])
    low = np.concatenate((np.log(LEVEL_LOW) + visible, np.full(len(seen), np.log(SCALE_BOUNDS[0]))))
    high = np.concatenate((np.log(LEVEL_HIGH) + visible, np.full(len(seen), np.log(SCALE_BOUNDS[1]))))
    x = np.clip(x, low, high)

    def levels(x: np.ndarray) -> Noise:
        scale, own = noise.scale.copy(), noise.own.copy()
        scale[seen] = np.exp(x[latents:])
        own[tuple(bad.T)] = np.exp(x[first_own:latents])
        return replace(noise, scale=scale, latent_sd=dict(zip(keys, np.exp(x[:first_own]).tolist())), own=own)

    def look(x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        value, by_level, by_scale, curvature = _likelihood(grams, levels(x), keys)
        chosen = np.concatenate((np.arange(latents), latents + seen))
        return value, np.concatenate((by_level, by_scale))[chosen], curvature[np.ix_(chosen, chosen)]

    value, slope, curvature = look(x)
    for _ in range(ITERATIONS):
        step, promised = _scoring_step(x, slope, curvature, low, high)
        if promised < ENOUGH_NATS:
            break
        for _ in range(HALVINGS):
            tried, its_slope, expected = look(x + step)
            if tried > value:
                break
            step = step / 3.0
        else:
            break
        gained, x, value, slope, curvature = tried - value, x + step, tried, its_slope, expected
        if gained < ENOUGH_NATS:
            break
    return levels(x), value


def _scoring_step(
    x: np.ndarray, slope: np.ndarray, curvature: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, float]:
    """Fisher's step of the variances within the limits, as logarithms of levels, and the nats that it promises.

    What a limit holds back stays there, and the others move without it. A variance far too small shows in no likelihood's
    logarithm, but its own step is finite.
    """
    known = np.diag(curvature)
    free = (known > 0.0) & ~((x <= low + STALLED) & (slope < 0.0)) & ~((x >= high - STALLED) & (slope > 0.0))
    step = np.zeros_like(x)
    if not np.any(free):
        return step, 0.0
    size = np.sqrt(known[free])
    part = curvature[np.ix_(free, free)] / np.outer(size, size)
    step[free] = np.linalg.solve(part + 1e-6 * np.eye(len(part)), slope[free] / size) / size
    promised = float(slope @ step)
    step = np.where(step > 0.0, 0.5 * np.log1p(2.0 * np.maximum(step, 0.0)), np.maximum(step, -LONGEST_FALL))
    return np.clip(x + step, low, high) - x, promised


def _likelihood(
    grams: Sequence[Gram], noise: Noise, keys: Sequence[tuple[int, str]]
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """Log-likelihood, its gradients by the logarithms of latent deviations and of sensor scales, and its expected curvature.

    The deviations are those of ``keys`` and after them bad windows' own, in the order of ``np.argwhere(np.isfinite(noise.own))``.
    The curvature (Fisher's, of [levels, scales]) is exact among the levels; what the scales share with the fitted columns is
    given to the channels by their part in them.
    """
    index = {key: i for i, key in enumerate(keys)}
    bad = np.isfinite(noise.own)
    count = len(keys) + int(bad.sum())
    own_at = len(keys) - 1 + np.cumsum(bad).reshape(bad.shape)
    value, slope, curvature = 0.0, np.zeros(count + len(noise.scale)), np.zeros((count + len(noise.scale),) * 2)
    for w, found in enumerate(each(lambda w: _window_likelihood(grams[w], noise, w), range(len(grams)))):
        at = [own_at[w, b] if bad[w, b] else index.get((b, grams[w].phase), -1) for b in range(len(LATENT_BLOCKS))]
        blocks = np.flatnonzero(np.array(at) >= 0)
        rows = np.array([at[b] for b in blocks] + list(range(count, len(slope))), dtype=int)
        chosen = np.concatenate((blocks, len(LATENT_BLOCKS) + np.arange(len(noise.scale))))
        value += found[0]
        slope[rows] += found[1][chosen]
        curvature[np.ix_(rows, rows)] += found[2][np.ix_(chosen, chosen)]
    return value, slope[:count], slope[count:], curvature


def _window_likelihood(gram: Gram, noise: Noise, window: int) -> tuple[float, np.ndarray, np.ndarray]:
    """One window's share of :func:`_likelihood`: value, gradient and curvature by [blocks, scales]."""
    state = posterior(gram, noise, window)
    level, n, blocks = noise.deviation(gram, window), gram.nuisances, len(LATENT_BLOCKS)
    second = np.outer(state.mean, state.mean)
    second += state.covariance
    by_block = np.bincount(gram.latent_block, np.diagonal(second)[n:] - 1.0, blocks)
    scaled = state.covariance * level
    scaled *= level[:, None]
    second *= level
    second *= level[:, None]
    weight, size = noise.scale**-2.0, len(level)
    left = gram.square - 2.0 * gram.cross[:, :size] @ (level * state.mean) + gram.hidden @ second.ravel()
    taken = weight * (gram.hidden @ scaled.ravel())  # degrees of freedom that the columns take from each channel
    member = gram.latent_block[:, None] == np.arange(blocks)
    squared = state.covariance[n:] ** 2
    known = np.eye(size)[n:, n:] - state.covariance[n:, n:]
    curvature = np.zeros((blocks + len(weight),) * 2)
    curvature[:blocks, :blocks] = 2.0 * member.T @ known**2 @ member
    shared = member.T @ (np.diagonal(state.covariance)[n:] - squared.sum(1))
    curvature[:blocks, blocks:] = 2.0 * np.outer(shared, taken / max(taken.sum(), 1e-300))
    curvature[blocks:, :blocks] = curvature[:blocks, blocks:].T
    curvature[blocks:, blocks:] = np.diag(2.0 * np.maximum(gram.count - taken, 0.0))
    return state.log_likelihood, np.concatenate((by_block, left * weight - gram.count)), curvature


def _own_levels(grams: Sequence[Gram], noise: Noise, common: set[tuple[str, int]]) -> np.ndarray:
    """Latent deviations of windows that stand far above their phase's, shape (windows, 3); NaN for all others.

    Args:
        grams: of the windows.
        noise: levels so far. A window that counts as bad stays so unless its phase's level does nearly as well.
        common: (phase, block)s whose windows have one level; those are added of which many windows stand out, for good: the
            phase's level rises to theirs, and were they let out again it would fall.
    """
    found = each(lambda w: _own_levels_of(grams[w], noise, w), range(len(grams)))
    own = np.array(found).reshape(noise.own.shape)
    for phase in sorted({gram.phase for gram in grams}):
        of_phase = np.array([gram.phase == phase for gram in grams])
        many = np.isfinite(own[of_phase]).sum(0) > BAD_SHARE * of_phase.sum()
        common |= {(phase, int(block)) for block in np.flatnonzero(many)}
        shared = [block for block in range(own.shape[1]) if (phase, block) in common]
        own[np.ix_(of_phase, shared)] = np.nan
    return own


def _own_levels_of(gram: Gram, noise: Noise, window: int) -> np.ndarray:
    """Of one window, shape (3,)."""
    own, state = np.full(len(LATENT_BLOCKS), np.nan), posterior(gram, noise, window)
    level = noise.deviation(gram, window)[gram.nuisances :]
    for block in np.unique(gram.latent_block):
        at = gram.nuisances + np.flatnonzero(gram.latent_block == block)
        used, shared = level[gram.latent_block == block][0], noise.latent_sd[int(block), gram.phase]
        own[block] = _own_level(state, at, used, shared, bool(np.isfinite(noise.own[window, block])))
    return own


def _own_level(state: Posterior, at: np.ndarray, used: float, shared: float, bad: bool) -> float:
    """A level that explains one block of a window far better than its phase's; NaN where there is none.

    A window that counts as bad keeps the level that was found for it unless its phase's is within ``GOOD_NATS``.

    The block's posterior precision is 1 + used^2 R, with R what the window says of unit forces: its eigenvalues give the
    likelihood of every level at once.

    Args:
        state: of the window.
        at: of the block's coefficients.
        used: level that the posterior rests on.
        shared: level of the phase.
        bad: whether ``used`` is the window's own level.
    """
    precision = np.linalg.inv(state.covariance[np.ix_(at, at)])
    said, turn = np.linalg.eigh(precision - np.eye(len(at)))
    said = np.maximum(said, 0.0)
    score = (turn.T @ (precision @ state.mean[at])) ** 2
    share = (np.array([1.0, used / shared, *FACTORS]) * shared / used)[:, None] ** 2
    values = 0.5 * np.sum(share * score / (1.0 + share * said) - np.log1p(share * said), axis=1)
    plain, now, values = values[0], values[1], values[2:]
    if bad:
        return float(used) if used > shared and now > plain + GOOD_NATS else np.nan
    below = np.flatnonzero(values < plain)
    values = values[: below[0]] if len(below) else values
    if not len(values) or values.max() <= plain + BAD_NATS:
        return np.nan
    return float(FACTORS[int(np.argmax(values))] * shared)


def without_outliers(windows: Sequence[Window], channels: int) -> list[Window]:
    """Give single samples far outside a sigma that puts them at HUBER; windows with none are returned as they are.

    Latent forces have a wide prior here, so that a missing effect is followed and only what no force can do stands out.

    Args:
        windows: of the flights.
        channels: number of the model's channels.

    Raises:
        DiagnoseError: As :func:`visthrow.diagnose.marginal.gram_of`.
    """
    return each(lambda window: _mended(window, channels), windows)


def _mended(window: Window, channels: int) -> Window:
    sigma, bare = window.sigma, replace(window, effects=window.effects[:, :0])
    for _ in range(CLEANINGS):
        gram = hidden_gram(replace(window, sigma=sigma), channels)
        guess = _first_guess([gram])
        wide = replace(guess, latent_sd={key: WIDE * level for key, level in guess.latent_sd.items()})
        shaped = correlated(gram, window, wide.correlation_time)
        fitted = wide.deviation(shaped, 0) * posterior(shaped, wide, 0).mean
        fitted[gram.nuisances :] = shaped.factor @ fitted[gram.nuisances :]
        left = window.residual - columns(bare, np.zeros(0)) @ fitted
        normal = np.abs(left) / window.sigma
        far = normal / (HUBER * np.maximum(1.0, MAD_TO_SIGMA * np.median(normal)))
        if not np.any(far > 1.0):
            break
        sigma = window.sigma * np.maximum(far, 1.0)
    outliers = sigma > window.sigma
    return replace(window, sigma=sigma) if 0.0 < outliers.mean() <= HUBER_SHARE else window

"""From windows of residuals to what they say about the effects: information and score of every
flight.

Initial states b and latent forces a are integrated out. With U = [X, G], prior covariance P of (b,
a) and sensor noise W^-1,

    V = W^-1 + U P U',   V^-1 = W - W U (P^-1 + U'W U)^-1 U'W   (Woodbury)

so a window of thousands of samples becomes a few inner products (:class:`Gram`), and a change of
noise levels costs one small factorisation. Where noise is correlated
(:mod:`visthrow.diagnose.likelihood.correlation`), they are those of whitened columns. The latent
forces of one block and axis are an Ornstein-Uhlenbeck process at the knots; its Cholesky factor is
multiplied into G once, after which P is diagonal.

Effects are measured in floors throughout: theta = 1 is the size below which an effect does not
matter."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy import ndarray
from scipy.linalg import lapack

from visthrow.common.errors import DiagnoseError
from visthrow.diagnose.likelihood.threads import parallel_map
from visthrow.diagnose.models.model_interface import Window

TAIL = 6.0
"""Degrees of freedom of the latent forces' scale mixture: from window to window their deviation
varies by some 30 %, and a window in which something happened may have ten times as much at the
price of 11 nats.
"""


ROUNDING = 1e-10
"""Share of an effect's squares that has to be left once initial states and latent forces took
theirs: what is less is the difference of numbers that are equal to their last digits, and says
nothing.
"""

NEGATIVE = 1e-3
"""Largest negative eigenvalue of the information, relative to its diagonal, that rounding leaves:
some 1e-13 of an effect's squares, of which `ROUNDING` are left at least.
"""


@dataclass(frozen=True)
class Gram:
    """Weighted inner products of one window's columns, by channel; D nuisances, L latents, K
    effects, P = D + L + K.

    The columns stand in the order nuisances (times their prior deviation), latents, effects (times
    their floors)."""

    flight: int
    phase: str
    count: ndarray  # samples of each of the model's C channels, shape (C,)
    inner: ndarray  # Z' Z / sigma^2, shape (C, P, P)
    cross: ndarray  # Z' r / sigma^2, shape (C, P)
    square: ndarray  # r' r / sigma^2, shape (C,)
    nuisances: int
    latent_block: ndarray  # shape (L,)
    # what stands between unit latents and knots: G_used = G @ factor, shape (L, L)
    factor: ndarray
    visibility: Mapping[
        int, float
    ]  # latent block -> median inner product of its columns with themselves
    log_sigma: float = 0.0  # sum over all samples: grams whose outliers have other weights compare

    @property
    def latents(self) -> int:
        """Number of latent-force coefficients."""
        return len(self.latent_block)


@dataclass(frozen=True)
class Noise:
    """Levels of sensor noise and latent forces."""

    scale: ndarray  # of each channel's sigma, shape (C,)
    latent_sd: Mapping[tuple[int, str], float]  # (block, phase) -> deviation [N, N m, N]
    correlation_time: float  # of the latent forces [s]
    # latent deviation of each window and block in its phase's, shape (windows, 3)
    share: ndarray

    @property
    def log_prior(self) -> float:
        """Return the log prior of the windows' shares: their squares follow an inverse gamma
        distribution; 0 where all are 1.
        """
        square = self.share**2
        nats = np.log(square) + 1.0 / square - 1.0
        return float(-0.5 * TAIL * nats.sum())


@dataclass(frozen=True)
class Statistics:
    """Everything that F flights say about K effects, in floors, about the linearisation point
    ``theta``.
    """

    flights: ndarray  # their numbers, shape (F,)
    information: ndarray  # S' V^-1 S, shape (F, K, K)
    score: ndarray  # S' V^-1 r, shape (F, K)
    square: ndarray  # r' V^-1 r + log det V, shape (F,)
    samples: ndarray  # shape (F,)
    theta: ndarray  # shape (K,)

    @cached_property
    def absolute(self) -> ndarray:
        """Scores about theta = 0, shape (F, K)."""
        return self.score + self.information @ self.theta

    @cached_property
    def absolute_square(self) -> ndarray:
        """``square`` of the residuals extrapolated to theta = 0, shape (F,)."""
        curved = self.information @ self.theta
        return self.square + 2.0 * self.score @ self.theta + curved @ self.theta

    def only(self, keep: ndarray) -> "Statistics":
        """Return the statistics of some flights; ``keep`` is a mask or indices into ``flights``."""
        return replace(
            self,
            flights=self.flights[keep],
            information=self.information[keep],
            score=self.score[keep],
            square=self.square[keep],
            samples=self.samples[keep],
        )


def columns(window: Window, floors: ndarray) -> ndarray:
    """The columns [X, G, S] of a window as :class:`Gram` scales them, shape (N, P)."""
    latent = window.latent if window.latent.size else np.zeros((len(window.residual), 0))
    states = window.nuisance * window.nuisance_sd
    return np.hstack((states, latent, window.effects * floors))


def gram_of(window: Window, floors: ndarray, channels: int) -> Gram:
    """Reduce a window to its inner products.

    ``window``: with finite residuals and derivatives; ``floors``: of the effects, shape (K,);
    ``channels``: number C of the model's channels. Raises DiagnoseError: the window's arrays do not
    fit together, or hold NaN or infinity."""
    check(window, len(floors), channels)
    return _inner_products(window, columns(window, floors), channels)


def hidden_gram(window: Window, channels: int) -> Gram:
    """Return the Gram matrix of a window without its effects.

    Raises DiagnoseError: as :func:`gram_of`.
    """
    return gram_of(replace(window, effects=window.effects[:, :0]), np.zeros(0), channels)


def without_effects(gram: Gram) -> Gram:
    """Return a Gram matrix of nuisances and latents alone."""
    size = gram.nuisances + gram.latents
    inner = np.ascontiguousarray(gram.inner[:, :size, :size])
    return replace(gram, inner=inner, cross=gram.cross[:, :size])


def whitened(window: Window, values: ndarray) -> ndarray:
    """Columns in sigmas, shape (N, P), turned into some whose noise is white, in place."""
    for rows, factor in window.correlated:
        group = values[rows].reshape(len(rows), -1)
        white = lapack.dtrtrs(factor, group, lower=1)[0]
        values[rows] = white.reshape(*rows.shape, -1)
    return values


def _inner_products(window: Window, z: ndarray, channels: int) -> Gram:
    z = whitened(window, z / window.sigma[:, None])
    r = whitened(window, (window.residual / window.sigma)[:, None])[:, 0]
    size = z.shape[1]
    inner = np.zeros((channels, size, size))
    cross = np.zeros((channels, size))
    square = np.zeros(channels)
    for c in np.unique(window.channel):
        rows = window.channel == c
        white = z[rows]
        residual = r[rows]
        inner[c] = white.T @ white
        cross[c] = residual @ white
        square[c] = residual @ residual
    count = np.bincount(window.channel, minlength=channels).astype(float)
    blocks = np.asarray(window.latent_block, dtype=int)
    states = window.nuisance.shape[1]
    log_sigma = float(np.log(window.sigma).sum())
    for rows, factor in window.correlated:
        log_sigma += rows.shape[1] * float(np.log(np.diag(factor)).sum())
    return Gram(
        window.flight,
        window.phase,
        count,
        inner,
        cross,
        square,
        states,
        blocks,
        np.eye(len(blocks)),
        _information_by_block(inner, states, blocks),
        log_sigma,
    )


def _information_by_block(inner: ndarray, begin: int, blocks: ndarray) -> dict[int, float]:
    """See :class:`Gram`, with ``begin`` the first latent column."""
    squares = np.diagonal(inner, axis1=1, axis2=2).sum(0)[begin : begin + len(blocks)]
    return {
        block: float(np.median(squares[blocks == block])) for block in np.unique(blocks).tolist()
    }


def check(window: Window, effects: int, channels: int) -> None:
    """Refuse a window whose arrays do not fit together.

    Raises DiagnoseError: they do not, or hold NaN or infinity.
    """
    n = len(window.residual)
    where = f"window of flight {window.flight}, phase {window.phase}"
    shapes = {
        "time": window.time.shape[:1],
        "channel": window.channel.shape,
        "sigma": window.sigma.shape,
        "effects": window.effects.shape[:1],
        "nuisance": window.nuisance.shape[:1],
    }
    wrong = {name: shape for name, shape in shapes.items() if shape != (n,)}
    if wrong or window.effects.shape[1] != effects:
        raise DiagnoseError(
            f"{where}: {n} residuals and {effects} effects, but {wrong or window.effects.shape}"
        )
    if n and (window.channel.max() >= channels or not np.all(window.sigma > 0.0)):
        raise DiagnoseError(
            f"{where}: a channel index above {channels - 1}, or a sigma that is not above 0"
        )
    if not finite(window):
        raise DiagnoseError(f"{where}: a residual or a derivative is not finite")


def finite(window: Window) -> bool:
    """Whether a window was simulated."""
    arrays = window.residual, window.effects, window.nuisance, window.latent
    return all(np.all(np.isfinite(array)) for array in arrays)


def correlated(gram: Gram, window: Window, time: float) -> Gram:
    """Multiply the Cholesky factor of Ornstein-Uhlenbeck latents into a Gram whose factor is still
    the identity.

    ``window``: for the knots; ``time``: correlation time [s]; latent forces at knots dt apart
    correlate by exp(-dt/time)."""
    if not gram.latents:
        return gram
    factor = knot_factor(window, time)
    knots = len(factor)
    groups = gram.latents // knots
    part = slice(gram.nuisances, gram.nuisances + gram.latents)
    channels, size = gram.cross.shape
    inner = gram.inner.copy()
    rows = factor.T @ inner[:, part].reshape(channels, groups, knots, size)
    inner[:, part] = rows.reshape(channels, -1, size)
    columns_of = inner[:, :, part].reshape(-1, knots) @ factor
    inner[:, :, part] = columns_of.reshape(channels, size, -1)
    cross = gram.cross.copy()
    turned = cross[:, part].reshape(-1, knots) @ factor
    cross[:, part] = turned.reshape(channels, -1)
    visibility = _information_by_block(inner, gram.nuisances, gram.latent_block)
    whole = np.kron(np.eye(groups), factor)
    return replace(gram, inner=inner, cross=cross, factor=whole, visibility=visibility)


def knot_factor(window: Window, time: float) -> ndarray:
    """Cholesky factor of the latents of one group of a window, which is that of all others; see
    :func:`correlated`.
    """
    group = window.latent_block.astype(int) * 3 + window.latent_axis.astype(int)
    knots = _knots(group, window.latent_time)
    stamps = window.latent_time[:knots]
    members = group[:knots]
    lag = np.abs(stamps[:, None] - stamps)
    alike = np.where(members[:, None] == members, np.exp(-lag / time), 0.0)
    return np.linalg.cholesky(alike + 1e-9 * np.eye(knots))


def _knots(group: ndarray, time: ndarray) -> int:
    """Knots of groups that follow one another with the same ones each; where they do not, all
    latents are one.
    """
    count = int(np.count_nonzero(group == group[0]))
    if len(group) % count:
        return len(group)
    groups = group.reshape(-1, count)
    times = time.reshape(-1, count)
    alike = np.all(groups == groups[:, :1]) and np.all(times == times[0])
    return count if alike else len(group)


def grams_of(windows: Sequence[Window], floors: ndarray, channels: int) -> list[Gram]:
    """Reduce windows to their inner products, see :func:`gram_of`."""
    return parallel_map(partial(gram_of, floors=floors, channels=channels), windows)


def correlated_of(grams: Sequence[Gram], windows: Sequence[Window], time: float) -> list[Gram]:
    """Correlate the latent forces of all windows, see :func:`correlated`."""
    return parallel_map(partial(correlated, time=time), grams, windows)


def with_residuals(
    grams: Sequence[Gram],
    windows: Sequence[Window],
    floors: ndarray,
    residuals: Sequence[ndarray],
) -> list[Gram]:
    """Return Gram matrices with other residuals, see :func:`with_residual`."""
    return parallel_map(partial(with_residual, floors=floors), grams, windows, residuals)


def with_residual(gram: Gram, window: Window, residual: ndarray, floors: ndarray) -> Gram:
    """Return a Gram matrix of the same derivatives with the residuals of another size of the
    effects.
    """
    count = len(residual)
    channels = len(gram.count)
    white = whitened(window, (residual / window.sigma)[:, None])[:, 0]
    weighted = np.zeros((count, channels))
    weighted[np.arange(count), window.channel] = _unwhitened(window, white) / window.sigma
    by_state = (window.nuisance.T @ weighted).T * window.nuisance_sd
    by_latent = np.zeros((channels, 0))
    if gram.latents:
        by_latent = (window.latent.T @ weighted).T @ gram.factor
    by_effect = (window.effects.T @ weighted).T * floors
    square = np.bincount(window.channel, white**2, channels)
    return replace(gram, cross=np.hstack((by_state, by_latent, by_effect)), square=square)


def _unwhitened(window: Window, white: ndarray) -> ndarray:
    """Transpose of :func:`whitened`, of one column, shape (N,)."""
    out = white.copy()
    for rows, factor in window.correlated:
        out[rows] = lapack.dtrtrs(factor, white[rows], lower=1, trans=1)[0]
    return out


def residual_after_fit(window: Window, fit: ndarray) -> ndarray:
    """Return the residual after a fit of initial state in prior deviations and latents at the
    knots, shape (D + L,); shape (N,).
    """
    states = window.nuisance.shape[1]
    residual = window.residual - window.nuisance @ (window.nuisance_sd * fit[:states])
    if len(fit) > states:
        residual = residual - window.latent @ fit[states:]
    return residual


@dataclass(frozen=True)
class WindowStatistics:
    """One window's share of :class:`Statistics`."""

    information: ndarray  # shape (K, K)
    score: ndarray  # shape (K,)
    square: float


@dataclass(frozen=True)
class LatentStatistics(WindowStatistics):
    """A window's statistics, with those of its latent forces as if they were effects."""

    latent_information: ndarray  # G' V^-1 G, shape (L, L)
    latent_score: ndarray  # G' V^-1 r, shape (L,)
    latent_effects: ndarray  # G' V^-1 S, shape (L, K)


def gather(grams: Sequence[Gram], parts: Sequence[WindowStatistics], theta: ndarray) -> Statistics:
    """Add up windows by flight.

    ``theta``: linearisation point in floors, shape (K,). Raises DiagnoseError: information came out
    negative beyond rounding."""
    flights, row = np.unique([gram.flight for gram in grams], return_inverse=True)
    size = len(theta)
    information = np.zeros((len(flights), size, size))
    samples = np.zeros(len(flights))
    squares = np.zeros(size)
    for i, gram, part in zip(row, grams, parts):
        information[i] += part.information
        samples[i] += gram.count.sum()
        begin = gram.cross.shape[1] - size
        squares += np.diagonal(gram.inner, axis1=1, axis2=2)[:, begin:].sum(0)
    silent = np.diagonal(information.sum(0)) < ROUNDING * squares
    information[:, silent] = 0.0
    information[:, :, silent] = 0.0
    total = information.sum(0)
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(total), 1e-300))
    lowest = np.linalg.eigvalsh(total * np.outer(scale, scale)).min(initial=0.0)
    if lowest < -NEGATIVE:
        raise DiagnoseError(
            f"information has the eigenvalue {lowest:.1e} relative to its diagonal; the derivatives"
            " are broken"
        )
    if lowest < 0.0:
        # rounding, which wide priors of several named effects would turn into evidence; what says
        # nothing of an effect stays silent
        information -= 2.0 * lowest * information * np.eye(size)
    none = np.zeros((len(flights), size))
    silenced = Statistics(flights, information, none, np.zeros(len(flights)), samples, none[0])
    return rescored(silenced, grams, parts, theta)


def rescored(
    statistics: Statistics,
    grams: Sequence[Gram],
    parts: Sequence[WindowStatistics],
    theta: ndarray,
) -> Statistics:
    """Return statistics of windows with other residuals: their information stays.

    ``statistics``: of the same windows; ``theta``: linearisation point in floors, shape (K,).
    """
    which = np.searchsorted(statistics.flights, [gram.flight for gram in grams])
    score = np.zeros_like(statistics.score)
    square = np.zeros_like(statistics.square)
    np.add.at(score, which, [part.score for part in parts])
    np.add.at(square, which, [part.square for part in parts])
    score[:, np.diagonal(statistics.information.sum(0)) == 0.0] = 0.0
    return replace(statistics, score=score, square=square, theta=np.array(theta, dtype=float))

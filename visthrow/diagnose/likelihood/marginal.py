"""Reduce windows of residuals to the information and score of each flight about the effects.

Initial states b and latent forces a are integrated out. With U = [X, G], prior covariance P of (b,
a) and sensor noise W^-1,

    V = W^-1 + U P U',   V^-1 = W - W U (P^-1 + U'W U)^-1 U'W   (Woodbury)

so a window of thousands of samples is reduced to a few inner products (:class:`Gram`), and new
noise levels cost one small factorisation. Where noise is correlated
(:mod:`visthrow.diagnose.likelihood.correlation`), the columns are whitened first. The latent forces
of one block and axis are an Ornstein-Uhlenbeck process at the knots. G is multiplied by its
Cholesky factor once; then P is diagonal.

Sizes of effects are in floors: theta = 1 is the negligible size."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy import ndarray
from scipy.linalg import lapack

from visthrow.common.errors import DiagnoseError
from visthrow.diagnose.likelihood.threads import parallel_map
from visthrow.diagnose.models.model_interface import Indices, Window

TAIL = 6.0
"""Degrees of freedom of the latent forces' scale mixture. Their standard deviation varies by some
30 % between windows; ten times as much in one window costs 11 nats.
"""

ROUNDING = 1e-10
"""Smallest share of an effect's sum of squares that initial states and latent forces may leave. A
smaller share is the difference of numbers that agree to their last digits, and carries no
information.
"""

NEGATIVE = 1e-3
"""Largest negative eigenvalue of the information, relative to its diagonal, that rounding can
cause: some 1e-13 of an effect's sum of squares, of which at least `ROUNDING` remains.
"""


@dataclass(frozen=True)
class Gram:
    """Weighted inner products of one window's columns, by channel; D nuisances, L latents, K
    effects, P = D + L + K.

    The order of the columns is: nuisances (times their prior deviation), latents, effects (times
    their floors)."""

    flight: int
    phase: str
    count: ndarray  # samples of each of the model's C channels, shape (C,)
    inner: ndarray  # Z' Z / sigma^2, shape (C, P, P)
    cross: ndarray  # Z' r / sigma^2, shape (C, P)
    square: ndarray  # r' r / sigma^2, shape (C,)
    nuisances: int
    latent_block: ndarray  # shape (L,)
    # from independent latents to the forces at the knots: G_used = G @ factor, shape (L, L)
    factor: ndarray
    # sum over all samples; makes grams comparable whose outliers have different weights
    log_sigma: float = 0.0

    @property
    def latents(self) -> int:
        """Return the number of latent-force coefficients."""
        return len(self.latent_block)

    @cached_property
    def visibility(self) -> dict[int, float]:
        """Return the median inner product of each latent block's columns with themselves."""
        latents = slice(self.nuisances, self.hidden)
        squares = np.diagonal(self.inner, axis1=1, axis2=2).sum(0)[latents]
        return {
            block: np.median(squares[self.latent_block == block])
            for block in np.unique(self.latent_block).tolist()
        }

    @property
    def hidden(self) -> int:
        """Return the number of columns that are integrated out: nuisances and latents."""
        return self.nuisances + self.latents


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
    """Sufficient statistics of F flights (or windows, or groups of either) about K effects, in
    floors, at the linearisation point ``theta``.
    """

    flights: ndarray  # number of each row's flight or group, shape (F,)
    information: ndarray  # S' V^-1 S, shape (F, K, K)
    score: ndarray  # S' V^-1 r, shape (F, K)
    square: ndarray  # r' V^-1 r + log det V, shape (F,)
    samples: ndarray  # shape (F,)
    theta: ndarray  # shape (K,), or that of each row, shape (F, K)
    days: Indices = ()  # of each flight; none where the logs do not say

    @cached_property
    def absolute(self) -> "Statistics":
        """Return the statistics at theta = 0."""
        return self.extrapolate(np.zeros(self.score.shape[1]))

    def extrapolate(self, theta: ndarray) -> "Statistics":
        """Return the statistics extrapolated to other sizes: the same for all rows, shape (K,), or
        those of each row, shape (F, K).
        """
        change = np.broadcast_to(self.theta - theta, self.score.shape)
        score = self.score + (self.information @ change[..., None])[..., 0]
        square = self.square + ((self.score + score) * change).sum(1)
        return replace(self, score=score, square=square, theta=theta)

    def first(self, count: int) -> "Statistics":
        """Return the statistics of the first effects alone, with the others at their sizes."""
        return replace(
            self,
            information=self.information[:, :count, :count],
            score=self.score[:, :count],
            theta=self.theta[..., :count],
        )

    def only(self, keep: ndarray) -> "Statistics":
        """Return the statistics of some rows; ``keep`` is a mask or indices."""
        return self._with_rows(self.flights[keep], lambda values: values[keep])

    def sum_by(self, groups: Indices) -> "Statistics":
        """Add up the rows of each group; ``groups``: the group of each row, shape (F,)."""
        numbers = np.unique(groups)
        members = np.equal.outer(numbers, groups).astype(float)
        return self._with_rows(numbers, lambda values: np.tensordot(members, values, 1))

    def _with_rows(self, flights: ndarray, change: Callable[[ndarray], ndarray]) -> "Statistics":
        information = change(self.information)
        score = change(self.score)
        square = change(self.square)
        return Statistics(flights, information, score, square, change(self.samples), self.theta)


def columns(window: Window, floors: ndarray) -> ndarray:
    """Return the columns [X, G, S] of a window, scaled as in :class:`Gram`, shape (N, P)."""
    latent = window.latent if window.latent.size else np.zeros((len(window.residual), 0))
    states = window.nuisance * window.nuisance_sd
    return np.hstack((states, latent, window.effects * floors))


def gram_of(window: Window, floors: ndarray, channels: int) -> Gram:
    """Reduce a window to its inner products.

    ``window``: with finite residuals and derivatives; ``floors``: of the effects, shape (K,);
    ``channels``: number C of the model's channels. Raises DiagnoseError: the window's arrays do not
    fit together, or hold NaN or infinity."""
    check(window, len(floors), channels)
    z = whiten(window, columns(window, floors) / window.sigma[:, None])
    r = whiten(window, (window.residual / window.sigma)[:, None])[:, 0]
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
    log_sigma = np.log(window.sigma).sum()
    for rows, factor in window.correlated:
        log_sigma += rows.shape[1] * np.log(np.diag(factor)).sum()
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
        log_sigma,
    )


def hidden_gram(window: Window, channels: int) -> Gram:
    """Return the Gram matrix of a window without its effects.

    Raises DiagnoseError: as :func:`gram_of`.
    """
    return gram_of(replace(window, effects=window.effects[:, :0]), np.zeros(0), channels)


def without_effects(gram: Gram) -> Gram:
    """Return the Gram matrix of nuisances and latents alone."""
    inner = np.ascontiguousarray(gram.inner[:, : gram.hidden, : gram.hidden])
    return replace(gram, inner=inner, cross=gram.cross[:, : gram.hidden])


def merge_channels(gram: Gram, scale: ndarray) -> Gram:
    """Return a Gram matrix that has one channel for all samples, weighted by their noise.

    ``scale``: of each channel's sigma, shape (C,)."""
    weight = scale**-2.0
    return replace(
        gram,
        count=np.array([gram.count.sum()]),
        inner=np.tensordot(weight, gram.inner, 1)[None],
        cross=(weight @ gram.cross)[None],
        square=np.array([weight @ gram.square]),
        log_sigma=gram.log_sigma + gram.count @ np.log(scale),
    )


def with_latent_effects(gram: Gram) -> Gram:
    """Return a Gram matrix in which the latents are repeated as effects, after the others."""
    columns = np.r_[: len(gram.cross[0]), gram.nuisances : gram.hidden]
    inner = gram.inner[:, columns[:, None], columns]
    return replace(gram, inner=inner, cross=gram.cross[:, columns])


def whiten(window: Window, values: ndarray) -> ndarray:
    """Whiten columns in sigmas, shape (N, P), in place, and return them."""
    for rows, factor in window.correlated:
        group = values[rows].reshape(len(rows), -1)
        white = lapack.dtrtrs(factor, group, lower=1)[0]
        values[rows] = white.reshape(*rows.shape, -1)
    return values


def check(window: Window, effects: int, channels: int) -> None:
    """Check the arrays of a window.

    Raises DiagnoseError: their shapes disagree, or they hold NaN or infinity.
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
    if n and (window.channel.max() >= channels or not (window.sigma > 0.0).all()):
        raise DiagnoseError(
            f"{where}: a channel index above {channels - 1}, or a sigma that is not above 0"
        )
    knots = np.unique(window.latent_time)
    groups = len(window.latent_time) // max(len(knots), 1)
    if not np.array_equal(window.latent_time, np.tile(knots, groups)):
        raise DiagnoseError(f"{where}: latent forces differ in their knots, or in the knots' order")
    if not finite(window):
        raise DiagnoseError(f"{where}: a residual or a derivative is not finite")


def finite(window: Window) -> bool:
    """Return whether the simulation of a window stayed finite."""
    arrays = window.residual, window.effects, window.nuisance, window.latent
    return all(np.all(np.isfinite(array)) for array in arrays)


def correlate(gram: Gram, window: Window, time: float) -> Gram:
    """Correlate the latent forces of a Gram matrix whose ``factor`` is the identity.

    ``window``: for the knots; ``time``: correlation time [s]. Latent forces at knots dt apart
    correlate by exp(-dt/time)."""
    if not gram.latents:
        return gram
    of_axis = knot_factor(window, time)
    axes = gram.latents // len(of_axis)
    factor = np.kron(np.eye(axes), of_axis)
    part = slice(gram.nuisances, gram.hidden)
    inner = gram.inner.copy()
    for half in (inner[:, part], np.swapaxes(inner, 1, 2)[:, part]):
        blocks = half.reshape(len(inner), axes, len(of_axis), -1)  # a view
        blocks[:] = of_axis.T @ blocks
    cross = gram.cross.copy()
    cross[:, part] = cross[:, part] @ factor
    return replace(gram, inner=inner, cross=cross, factor=factor)


def knot_factor(window: Window, time: float) -> ndarray:
    """Return the Cholesky factor of a window's latents of one block and axis; all blocks and axes
    share it. See :func:`correlate`.
    """
    knots = np.unique(window.latent_time)
    lag = np.abs(knots[:, None] - knots)
    return np.linalg.cholesky(np.exp(-lag / time) + 1e-9 * np.eye(len(knots)))


def grams_of(windows: Sequence[Window], floors: ndarray, channels: int) -> list[Gram]:
    """Reduce windows to their inner products, see :func:`gram_of`."""
    return parallel_map(partial(gram_of, floors=floors, channels=channels), windows)


def correlate_all(grams: Sequence[Gram], windows: Sequence[Window], time: float) -> list[Gram]:
    """Correlate the latent forces of all windows, see :func:`correlate`."""
    return parallel_map(partial(correlate, time=time), grams, windows)


def with_residuals(
    grams: Sequence[Gram],
    windows: Sequence[Window],
    floors: ndarray,
    residuals: Sequence[ndarray],
) -> list[Gram]:
    """Replace the residuals of Gram matrices, see :func:`with_residual`."""
    return parallel_map(partial(with_residual, floors=floors), grams, windows, residuals)


def with_residual(gram: Gram, window: Window, residual: ndarray, floors: ndarray) -> Gram:
    """Return a Gram matrix with another residual and the same derivatives."""
    count = len(residual)
    channels = len(gram.count)
    white = whiten(window, (residual / window.sigma)[:, None])[:, 0]
    weighted = np.zeros((channels, count))
    weighted[window.channel, np.arange(count)] = _unwhiten(window, white) / window.sigma
    by_state = weighted @ window.nuisance * window.nuisance_sd
    by_latent = np.zeros((channels, 0))
    if gram.latents:
        by_latent = weighted @ window.latent @ gram.factor
    by_effect = weighted @ window.effects * floors
    square = np.bincount(window.channel, white**2, channels)
    return replace(gram, cross=np.hstack((by_state, by_latent, by_effect)), square=square)


def _unwhiten(window: Window, white: ndarray) -> ndarray:
    """Apply the transpose of :func:`whiten` to one column, shape (N,)."""
    out = white.copy()
    for rows, factor in window.correlated:
        out[rows] = lapack.dtrtrs(factor, white[rows], lower=1, trans=1)[0]
    return out


def residual_after_fit(window: Window, fit: ndarray) -> ndarray:
    """Return the residual that a fit leaves, shape (N,); ``fit``: initial state in prior deviations
    and latents at the knots, shape (D + L,).
    """
    states = window.nuisance.shape[1]
    residual = window.residual - window.nuisance @ (window.nuisance_sd * fit[:states])
    if len(fit) > states:
        residual = residual - window.latent @ fit[states:]
    return residual


def without_rounding(information: ndarray, grams: Sequence[Gram]) -> ndarray:
    """Set information that is mere rounding to 0, and make the sum positive; shape (W, K, K).

    Raises DiagnoseError: the sum has a negative eigenvalue beyond rounding."""
    size = information.shape[1]
    squares = np.zeros(size)
    for gram in grams:
        part = np.diagonal(gram.inner, axis1=1, axis2=2)[:, gram.hidden :].sum(0)
        squares[: len(part)] += part
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
        # Wide priors of several selected effects would turn this rounding into evidence.
        # Information of 0 stays 0.
        diagonal = np.arange(size)
        information[:, diagonal, diagonal] *= 1.0 - 2.0 * lowest
    return information

"""Windows side by side: what noise levels are worth in all of them at once, on the CPU's cores.

The same algebra as :mod:`visthrow.diagnose.likelihood.marginal`, for grams that are padded to one
size, in batches that fit a core's cache."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy import ndarray
from scipy.linalg import lapack

from visthrow.common.errors import DiagnoseError
from visthrow.diagnose.likelihood.marginal import (
    Gram,
    Noise,
    Statistics,
    without_rounding,
)
from visthrow.diagnose.likelihood.threads import parallel_map
from visthrow.diagnose.models.model_interface import LATENT_BLOCKS

T = TypeVar("T")

# relative growth of the normal equations' diagonal where they are positive definite but for
# rounding
ROUNDING = 1e-10

BATCH = 8  # windows of a batch
BLOCKS = len(LATENT_BLOCKS)


@dataclass(frozen=True)
class _Batch:
    """W windows, of n columns [X, G] at most; padded columns are 0."""

    windows: ndarray  # rows of the noise's shares, shape (W,)
    grams: list[Gram]
    hidden: ndarray  # inner products of the columns, shape (W, C, n, n)
    cross: ndarray  # shape (W, C, n)
    square: ndarray  # shape (W, C)
    count: ndarray  # shape (W, C)
    log_sigma: ndarray  # shape (W,)
    member: ndarray  # 1 where a column is of a block, shape (W, n, B)
    initial: ndarray  # 1 where it is one of the initial state, shape (W, n)


@dataclass(frozen=True)
class _Shape:
    """A batch at some noise levels, whatever its residuals are."""

    weight: ndarray  # of the channels, shape (C,)
    level: ndarray  # prior deviation of the columns, shape (W, n)
    # inverse of the lower Cholesky factor L of 1 + P^1/2 U' W U P^1/2, shape (W, n, n)
    root: ndarray
    log_det: ndarray  # of V, shape (W,)


def integrals(grams: Sequence[Gram], noise: Noise) -> "Integrals":
    """Integrate initial states and latent forces out of windows.

    Raises DiagnoseError: as :meth:`Stack.fitted`; information came out negative beyond rounding.
    """
    return Integrals(Stack(grams), grams, noise)


class Stack:
    """Some windows' inner products of initial states and latent forces."""

    def __init__(self, grams: Sequence[Gram], windows: Sequence[int] | None = None):
        """Pad the windows to one size.

        ``grams``: of the windows, with or without effects; ``windows``: of each gram, the row of
        the noise's shares; default: their order."""
        rows = np.arange(len(grams)) if windows is None else np.asarray(windows, dtype=int)
        self._sizes = [gram.hidden for gram in grams]
        order = sorted(range(len(grams)), key=self._sizes.__getitem__)
        self.order = [order[first : first + BATCH] for first in range(0, len(order), BATCH)]
        parts = [[grams[w] for w in members] for members in self.order]
        self.batches = parallel_map(self._batch, parts, [rows[m] for m in self.order])

    def _batch(self, grams: list[Gram], windows: ndarray) -> _Batch:
        count = len(grams)
        n = max(gram.hidden for gram in grams)
        member = np.zeros((count, n, BLOCKS))
        initial = np.zeros((count, n))
        for w, gram in enumerate(grams):
            latents = np.arange(gram.nuisances, gram.hidden)
            member[w, latents, gram.latent_block] = 1.0
            initial[w, : gram.nuisances] = 1.0
        cross, _, square = _residual_products(grams, n, 0)
        counts = np.stack([gram.count for gram in grams])
        log_sigma = np.array([gram.log_sigma for gram in grams])
        parts = [gram.inner[:, : gram.hidden, : gram.hidden] for gram in grams]
        hidden = _padded(parts, (counts.shape[1], n, n))
        return _Batch(windows, grams, hidden, cross, square, counts, log_sigma, member, initial)

    def fitted(self, noise: Noise) -> tuple[list[ndarray], ndarray]:
        """Most probable initial state and unit latent forces of each window, shape (D + L,), and
        the log-likelihood of its residuals, but for the powers of 2 pi, shape (W,).

        Raises DiagnoseError: the normal equations are not positive definite, which only broken
        derivatives can cause."""

        def fit(batch: _Batch) -> tuple[ndarray, ndarray]:
            shape = _shape(batch, noise)
            mean, value = _solved(shape, batch)
            return shape.level * mean, value

        fits, values = (_by_window(self.order, part) for part in zip(*self._of_batches(fit)))
        return [fit[:size] for fit, size in zip(fits, self._sizes)], np.array(values)

    def look(self, noise: Noise) -> tuple[ndarray, ndarray, ndarray]:
        """Log-likelihood, its gradient and expected curvature by the logarithms of the windows' own
        levels.

        Raises DiagnoseError: as :meth:`fitted`. Returns values (W,); gradients (W, B + C) by the B
        blocks' deviations and the C channels' scales; curvatures (W, B + C, B + C). What the
        scales share with the fitted columns is given to the channels by their part in them."""
        parts = self._of_batches(lambda batch: _looked(batch, noise))
        return tuple(np.array(_by_window(self.order, column)) for column in zip(*parts))

    def _of_batches(self, function) -> list[tuple[ndarray, ...]]:
        return parallel_map(function, self.batches)


def _padded(parts: Sequence[ndarray], shape: tuple[int, ...]) -> ndarray:
    """Arrays one beside the other, each padded with zeros to one shape; shape (arrays, *shape)."""
    out = np.zeros((len(parts), *shape))
    for row, part in zip(out, parts):
        row[tuple(map(slice, part.shape))] = part
    return out


def _by_window(order: Sequence[Sequence[int]], parts: Sequence[Sequence[T]]) -> list[T]:
    """Return values of batches in the order of their windows."""
    values = {}
    for members, part in zip(order, parts):
        values |= zip(members, part)
    return [values[w] for w in sorted(values)]


def _levels(batch: _Batch, noise: Noise) -> ndarray:
    """Deviation of each window's latent forces by block, shape (W, B)."""
    levels = np.zeros((len(batch.grams), BLOCKS))
    for row, gram in zip(levels, batch.grams):
        row[:] = [noise.latent_sd.get((block, gram.phase), 0.0) for block in range(BLOCKS)]
    return levels * noise.share[batch.windows]


def _shape(batch: _Batch, noise: Noise) -> _Shape:
    latent_level = batch.member @ _levels(batch, noise)[:, :, None]
    level = batch.initial + latent_level[..., 0]
    weight = noise.scale**-2.0
    normal = _weighed(weight, batch.hidden)
    normal *= level[:, :, None]
    normal *= level[:, None]
    _diagonal(normal)[:] += 1.0
    factor = _factors(normal, batch.grams)
    log_diagonal = np.log(_diagonal(factor)).sum(-1)
    log_det = 2.0 * (log_diagonal + batch.log_sigma + batch.count @ np.log(noise.scale))
    root = np.stack([lapack.dtrtri(one, lower=1)[0] for one in factor])
    return _Shape(weight, level, root, log_det)


def _diagonal(matrices: ndarray) -> ndarray:
    """Return a view of the diagonals of matrices, shape (W, n)."""
    return np.einsum("wii->wi", matrices)


def _factors(normal: ndarray, grams: Sequence[Gram]) -> ndarray:
    """Return the lower Cholesky factors of windows' normal equations, shape (W, n, n)."""
    try:
        return np.linalg.cholesky(normal)
    except np.linalg.LinAlgError:
        return np.stack([_factor(one, gram) for one, gram in zip(normal, grams)])


def _factor(normal: ndarray, gram: Gram) -> ndarray:
    """Return the lower Cholesky factor of a window's normal equations.

    Levels of many orders of magnitude, as a search for them may try, leave the identity below
    rounding: then the diagonal grows a little."""
    for growth in (0.0, ROUNDING):
        try:
            return np.linalg.cholesky(normal + growth * np.diag(np.diag(normal)))
        except np.linalg.LinAlgError:
            continue
    where = f"window of flight {gram.flight}, phase {gram.phase}"
    raise DiagnoseError(f"{where}: the normal equations are singular")


def _solved(shape: _Shape, batch: _Batch) -> tuple[ndarray, ndarray]:
    """Return the mean of [b, a] in prior deviations under a batch's residuals, shape (W, n), and
    their log-likelihood but for the powers of 2 pi, shape (W,).
    """
    right = shape.level * (shape.weight @ batch.cross)
    projected = shape.root @ right[:, :, None]
    mean = shape.root.mT @ projected
    explained = np.square(projected).sum((1, 2))
    square = batch.square @ shape.weight - explained
    return mean[..., 0], -0.5 * (square + shape.log_det)


def _weighed(weight: ndarray, inner: ndarray) -> ndarray:
    """Sum over the channels, shape (W, i, j)."""
    count, channels, *shape = inner.shape
    total = weight @ inner.reshape(count, channels, -1)
    return total.reshape(count, *shape)


def _curved(shape: _Shape, batch: _Batch) -> tuple[ndarray, ndarray, ndarray]:
    """Posterior variances of [b, a] (W, n), what these leave of each channel's squares (W, C), and
    curvature by [blocks, scales].
    """
    covariance = shape.root.mT @ shape.root
    variance = _diagonal(covariance).copy()
    count, channels = batch.count.shape
    in_blocks = batch.member.mT
    scaled = covariance * shape.level[:, :, None] * shape.level[:, None]
    spread = np.einsum("wcij,wij->wc", batch.hidden, scaled)
    # Degrees of freedom that the columns take from each channel; rounding of huge derivatives is
    # kept from taking others.
    taken = np.clip(shape.weight * spread, 0.0, batch.count)
    squared = np.square(covariance, out=covariance)
    shared = in_blocks @ (variance - squared.sum(-1))[:, :, None]
    _diagonal(squared)[:] = (1.0 - variance) ** 2
    part = taken / np.maximum(taken.sum(-1, keepdims=True), 1e-300)
    mixed = 2.0 * shared * part[:, None]
    remaining = np.maximum(batch.count - taken, 0.0)
    curvature = np.zeros((count, BLOCKS + channels, BLOCKS + channels))
    curvature[:, :BLOCKS, :BLOCKS] = 2.0 * in_blocks @ squared @ batch.member
    curvature[:, :BLOCKS, BLOCKS:] = mixed
    curvature[:, BLOCKS:, :BLOCKS] = mixed.mT
    _diagonal(curvature[:, BLOCKS:, BLOCKS:])[:] = 2.0 * remaining
    return variance, spread, curvature


def _looked(batch: _Batch, noise: Noise) -> tuple[ndarray, ndarray, ndarray]:
    """Value, gradient and curvature by [blocks, scales]."""
    shape = _shape(batch, noise)
    variance, spread, curvature = _curved(shape, batch)
    mean, value = _solved(shape, batch)
    excess = variance + mean**2 - 1.0
    by_block = batch.member.mT @ excess[:, :, None]
    moved = (shape.level * mean)[:, :, None]
    bent = (moved.mT[:, None] @ batch.hidden)[:, :, 0] @ moved
    mixed = batch.cross @ moved
    square = batch.square - 2.0 * mixed[..., 0] + bent[..., 0] + spread
    by_scale = square * shape.weight - batch.count
    return value, np.concatenate((by_block[..., 0], by_scale), -1), curvature


def _residual_products(
    grams: Sequence[Gram], hidden: int, effects: int
) -> tuple[ndarray, ndarray, ndarray]:
    """Return the products of residuals with the columns that are integrated out, shape (W, C,
    hidden), with the first effects, shape (W, C, effects), and with themselves, shape (W, C).
    """
    square = np.stack([gram.square for gram in grams])
    of_hidden = np.zeros((*square.shape, hidden))
    of_effects = np.zeros((*square.shape, effects))
    for w, gram in enumerate(grams):
        of_hidden[w, :, : gram.hidden] = gram.cross[:, : gram.hidden]
        part = gram.cross[:, gram.hidden :][:, :effects]
        of_effects[w, :, : part.shape[1]] = part
    return of_hidden, of_effects, square


@dataclass(frozen=True)
class _Integrated:
    """The remainder of a batch's effects; of windows with fewer of them, the last are 0."""

    shape: _Shape
    # L^-1 P^1/2 U' W S, with L of the posterior's precision, shape (W, n, K)
    half: ndarray
    information: ndarray  # shape (W, K, K)

    def of_residuals(self, grams: Sequence[Gram]) -> tuple[ndarray, ndarray]:
        """Return scores, shape (W, K), and squares, shape (W,), with the residuals of grams of the
        same derivatives.
        """
        hidden, effects, square = _residual_products(grams, *self.half.shape[1:])
        weight = self.shape.weight
        right = self.shape.level * (weight @ hidden)
        projected = self.shape.root @ right[:, :, None]
        explained = self.half.mT @ projected
        part = self.shape.log_det - np.square(projected).sum((1, 2))
        return weight @ effects - explained[..., 0], square @ weight + part


class Integrals:
    """The part of windows' statistics that no residual changes."""

    def __init__(self, stack: Stack, grams: Sequence[Gram], noise: Noise):
        """Integrate at some noise levels; ``grams``: of the stack."""
        self._order = stack.order
        count = max(len(gram.cross[0]) - gram.hidden for gram in grams)
        self._parts = parallel_map(lambda batch: _integrated(batch, noise, count), stack.batches)
        parts = [part.information for part in self._parts]
        self._information = without_rounding(self._by_window(parts), grams)
        self._flights = np.array([gram.flight for gram in grams])
        self._samples = np.array([gram.count.sum() for gram in grams])

    @property
    def log_dets(self) -> ndarray:
        """Return the log determinant of each window's V, shape (W,)."""
        return self._by_window([part.shape.log_det.tolist() for part in self._parts])

    def _by_window(self, parts: Sequence[Sequence]) -> ndarray:
        return np.array(_by_window(self._order, parts))

    def statistics(self, grams: Sequence[Gram], theta: ndarray) -> Statistics:
        """Return the statistics of windows with the residuals of grams of the same derivatives.

        ``theta``: where these residuals are, in floors; the sizes of further effects are 0."""
        pairs = zip(self._order, self._parts)
        parts = [part.of_residuals([grams[w] for w in members]) for members, part in pairs]
        score, square = map(self._by_window, zip(*parts))
        score[:, np.diagonal(self._information.sum(0)) == 0.0] = 0.0
        sizes = np.zeros(score.shape[1])
        sizes[: len(theta)] = theta
        fixed = self._flights, self._information
        return Statistics(*fixed, score, square, self._samples, sizes)


def _integrated(batch: _Batch, noise: Noise, count: int) -> _Integrated:
    """Integrate a batch of windows; ``count``: most effects of any window."""
    shape = _shape(batch, noise)
    _, channels, n = batch.cross.shape

    def weighed(parts: Sequence[ndarray], height: int) -> ndarray:
        return _weighed(shape.weight, _padded(parts, (channels, height, count)))

    right = weighed([g.inner[:, : g.hidden, g.hidden :] for g in batch.grams], n)
    effects = weighed([g.inner[:, g.hidden :, g.hidden :] for g in batch.grams], count)
    scaled = shape.level[:, :, None] * right
    half = shape.root @ scaled
    reduced = effects - half.mT @ half
    return _Integrated(shape, half, 0.5 * (reduced + reduced.mT))

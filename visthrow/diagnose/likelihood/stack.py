"""Windows side by side: what noise levels are worth in all of them at once, on the CPU's cores or
where the simulation runs.

The same algebra as :mod:`visthrow.diagnose.likelihood.marginal`, for grams that are padded to one
size: on a GPU in one batch, on a CPU in batches that fit its cache."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from numpy import ndarray
from scipy.linalg import lapack

from visthrow.common.errors import DiagnoseError
from visthrow.diagnose.likelihood.marginal import (
    Gram,
    LatentStatistics,
    Noise,
    Statistics,
    WindowStatistics,
    gather,
    rescored,
)
from visthrow.diagnose.likelihood.threads import parallel_map
from visthrow.diagnose.likelihood.transfer import all_to_host, side_by_side
from visthrow.diagnose.models.model_interface import LATENT_BLOCKS

T = TypeVar("T")

# relative growth of the normal equations' diagonal where they are positive definite but for
# rounding
ROUNDING = 1e-10

BATCH = 8  # windows of a batch on the CPU
BLOCKS = len(LATENT_BLOCKS)


@dataclass(frozen=True)
class _Batch:
    """W windows, of n columns [X, G] at most; padded columns are 0."""

    windows: ndarray  # rows of the noise's shares, shape (W,)
    grams: list[Gram]
    hidden: torch.Tensor  # inner products of the columns, shape (W, C, n, n)
    cross: torch.Tensor  # shape (W, C, n)
    square: torch.Tensor  # shape (W, C)
    count: torch.Tensor  # shape (W, C)
    log_sigma: torch.Tensor  # shape (W,)
    member: torch.Tensor  # 1 where a column is of a block, shape (W, n, B)
    initial: torch.Tensor  # 1 where it is one of the initial state, shape (W, n)


@dataclass(frozen=True)
class _Shape:
    """A batch at some noise levels, whatever its residuals are."""

    weight: torch.Tensor  # of the channels, shape (C,)
    level: torch.Tensor  # prior deviation of the columns, shape (W, n)
    factor: torch.Tensor  # lower Cholesky factor of 1 + P^1/2 U' W U P^1/2, shape (W, n, n)
    log_det: torch.Tensor  # of V, shape (W,)


def integrals(
    grams: Sequence[Gram], noise: Noise, device: str = "cpu", *, latents: bool = False
) -> "Integrals":
    """Integrate initial states out of windows, and latent forces unless they are asked for.

    Raises DiagnoseError: as :meth:`Stack.values`.
    """
    return Stack(grams, device).integrals(noise, latents)


def statistics(grams: Sequence[Gram], noise: Noise, device: str = "cpu") -> list[LatentStatistics]:
    """Return the statistics of windows, with those of their latent forces at the knots as if they
    were effects.
    """
    whole = integrals(grams, noise, device, latents=True)
    return parallel_map(_of_latents, whole.shares(grams), grams)


def _of_latents(share: WindowStatistics, gram: Gram) -> LatentStatistics:
    latents = slice(gram.latents)
    effects = slice(gram.latents, None)
    whole = share.information
    # from unit latents to knots
    inverse = lapack.dtrtri(gram.factor, lower=1)[0] if gram.latents else gram.factor
    plain = whole[effects, effects], share.score[effects], share.square
    information = inverse.T @ whole[latents, latents] @ inverse
    score = inverse.T @ share.score[latents]
    cross = inverse.T @ whole[latents, effects]
    return LatentStatistics(*plain, information, score, cross)


class Stack:
    """Some windows' inner products of initial states and latent forces."""

    def __init__(
        self, grams: Sequence[Gram], device: str = "cpu", windows: Sequence[int] | None = None
    ):
        """Pad and move.

        ``grams``: of the windows, with or without effects; ``windows``: of each gram, the row of
        the noise's shares; default: their order."""
        rows = np.arange(len(grams)) if windows is None else np.asarray(windows, dtype=int)
        self.device = device
        size = BATCH if device == "cpu" else max(len(grams), 1)
        self._sizes = [gram.nuisances + gram.latents for gram in grams]
        order = sorted(range(len(grams)), key=self._sizes.__getitem__)
        self._order = [order[first : first + size] for first in range(0, len(order), size)]
        parts = [[grams[w] for w in members] for members in self._order]
        self._batches = parallel_map(self._padded, parts, [rows[m] for m in self._order])

    def _padded(self, grams: list[Gram], windows: ndarray) -> _Batch:
        sizes = [gram.nuisances + gram.latents for gram in grams]
        count = len(grams)
        channels = len(grams[0].count)
        n = max(sizes)
        cross = np.zeros((count, channels, n))
        member = np.zeros((count, n, BLOCKS))
        initial = np.zeros((count, n))
        for w, (gram, size) in enumerate(zip(grams, sizes)):
            latents = np.arange(gram.nuisances, size)
            cross[w, :, :size] = gram.cross[:, :size]
            member[w, latents, gram.latent_block] = 1.0
            initial[w, : gram.nuisances] = 1.0
        square = np.stack([gram.square for gram in grams])
        counts = np.stack([gram.count for gram in grams])
        log_sigma = np.array([gram.log_sigma for gram in grams])
        arrays = cross, square, counts, log_sigma, member, initial
        tensors = [torch.from_numpy(array).to(self.device) for array in arrays]
        parts = [gram.inner[:, :size, :size] for gram, size in zip(grams, sizes)]
        hidden = side_by_side(parts, (channels, n, n), self.device)
        return _Batch(windows, grams, hidden, *tensors)

    def values(self, noise: Noise) -> ndarray:
        """Log-likelihood of each window's residuals, but for the powers of 2 pi, shape (W,).

        Raises DiagnoseError: the normal equations are not positive definite, which only broken
        derivatives can cause."""

        def solve(batch: _Batch) -> tuple[torch.Tensor]:
            _, value = _solved(_shape(batch, noise), batch)
            return (value,)

        parts = [values for (values,) in self._of_batches(solve)]
        return np.array(_by_window(self._order, parts))

    def fitted(self, noise: Noise) -> list[ndarray]:
        """Most probable initial state and unit latent forces of each window, shape (D + L,).

        Raises DiagnoseError: as :meth:`values`.
        """

        def fit(batch: _Batch) -> tuple[torch.Tensor]:
            shape = _shape(batch, noise)
            mean, _ = _solved(shape, batch)
            return (shape.level * mean,)

        parts = [rows for (rows,) in self._of_batches(fit)]
        return [row[:size] for row, size in zip(_by_window(self._order, parts), self._sizes)]

    def look(self, noise: Noise) -> tuple[ndarray, ndarray, ndarray]:
        """Log-likelihood, its gradient and expected curvature by the logarithms of the windows' own
        levels.

        Raises DiagnoseError: as :meth:`values`. Returns values (W,); gradients (W, B + C) by the B
        blocks' deviations and the C channels' scales; curvatures (W, B + C, B + C). What the
        scales share with the fitted columns is given to the channels by their part in them."""
        parts = self._of_batches(lambda batch: _looked(batch, noise))
        return tuple(np.array(_by_window(self._order, column)) for column in zip(*parts))

    def integrals(self, noise: Noise, latents: bool) -> "Integrals":
        """See :func:`integrals`."""
        parts = parallel_map(lambda batch: _integrated(batch, noise, latents), self._batches)
        return Integrals(self._order, parts)

    def _of_batches(self, function) -> list[tuple[ndarray, ...]]:
        return parallel_map(lambda batch: tuple(all_to_host(function(batch))), self._batches)


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
    by_block = batch.square.new_tensor(_levels(batch, noise))
    latent_level = batch.member @ by_block[:, :, None]
    level = batch.initial + latent_level[..., 0]
    scale = batch.square.new_tensor(noise.scale)
    weight = scale**-2.0
    normal = _weighed(weight, batch.hidden)
    normal *= level[:, :, None]
    normal *= level[:, None]
    normal.diagonal(dim1=1, dim2=2).add_(1.0)
    factor, failed = torch.linalg.cholesky_ex(normal)
    if torch.any(failed):
        # Levels of many orders of magnitude, as a search for them may try, leave the identity below
        # rounding.
        normal.diagonal(dim1=1, dim2=2).mul_(1.0 + ROUNDING * (failed[:, None] > 0))
        factor, failed = torch.linalg.cholesky_ex(normal)
        if torch.any(failed):
            gram = batch.grams[int(torch.nonzero(failed)[0, 0])]
            where = f"window of flight {gram.flight}, phase {gram.phase}"
            raise DiagnoseError(f"{where}: the normal equations are singular")
    log_diagonal = factor.diagonal(dim1=1, dim2=2).log().sum(-1)
    log_det = 2.0 * (log_diagonal + batch.log_sigma + batch.count @ scale.log())
    return _Shape(weight, level, factor, log_det)


def _solved(shape: _Shape, batch: _Batch) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the mean of [b, a] in prior deviations under a batch's residuals, shape (W, n), and
    their log-likelihood but for the powers of 2 pi, shape (W,).
    """
    right = shape.level * (shape.weight @ batch.cross)
    projected = torch.linalg.solve_triangular(shape.factor, right[:, :, None], upper=False)
    mean = torch.linalg.solve_triangular(shape.factor.mT, projected, upper=True)
    explained = projected.square().sum((1, 2))
    square = batch.square @ shape.weight - explained
    return mean[..., 0], -0.5 * (square + shape.log_det)


def _inverse(factor: torch.Tensor) -> torch.Tensor:
    """Inverse of matrices whose lower Cholesky factors these are; on a GPU torch's function takes
    them one by one.
    """
    if not factor.is_cuda:  # it comes by columns, beside all else by rows; it is symmetric
        return torch.cholesky_inverse(factor).mT
    unit = torch.eye(factor.shape[1], dtype=factor.dtype, device=factor.device)
    factor_inverse = torch.linalg.solve_triangular(factor, unit, upper=False)
    return factor_inverse.mT @ factor_inverse


def _weighed(weight: torch.Tensor, inner: torch.Tensor) -> torch.Tensor:
    """Sum over the channels, shape (W, i, j)."""
    count, channels, *shape = inner.shape
    total = weight @ inner.reshape(count, channels, -1)
    return total.reshape(count, *shape)


def _curved(shape: _Shape, batch: _Batch) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Posterior variances of [b, a] (W, n), what these leave of each channel's squares (W, C), and
    curvature by [blocks, scales].
    """
    covariance = _inverse(shape.factor)
    variance = covariance.diagonal(dim1=1, dim2=2).clone()
    count, channels = batch.count.shape
    in_blocks = batch.member.mT
    scaled = covariance * shape.level[:, :, None] * shape.level[:, None]
    # as products of matrices they take ten times as long on a GPU
    spread = (batch.hidden * scaled[:, None]).sum((2, 3))
    # Degrees of freedom that the columns take from each channel; rounding of huge derivatives is
    # kept from taking others.
    taken = torch.minimum(torch.clamp(shape.weight * spread, min=0.0), batch.count)
    squared = covariance.square_()
    shared = in_blocks @ (variance - squared.sum(-1))[:, :, None]
    squared.diagonal(dim1=1, dim2=2).copy_((1.0 - variance) ** 2)
    part = taken / torch.clamp(taken.sum(-1, keepdim=True), min=1e-300)
    mixed = 2.0 * shared * part[:, None]
    remaining = torch.clamp(batch.count - taken, min=0.0)
    curvature = shape.level.new_zeros(count, BLOCKS + channels, BLOCKS + channels)
    curvature[:, :BLOCKS, :BLOCKS] = 2.0 * in_blocks @ squared @ batch.member
    curvature[:, :BLOCKS, BLOCKS:] = mixed
    curvature[:, BLOCKS:, :BLOCKS] = mixed.mT
    curvature[:, BLOCKS:, BLOCKS:].diagonal(dim1=1, dim2=2).copy_(2.0 * remaining)
    return variance, spread, curvature


def _looked(batch: _Batch, noise: Noise) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
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
    return value, torch.cat((by_block[..., 0], by_scale), -1), curvature


@dataclass(frozen=True)
class _Integrated:
    """The remainder of the last J columns of a batch."""

    own_columns: list[ndarray]  # which of the J columns are a window's own
    shape: _Shape
    weight: ndarray  # of the channels, shape (C,)
    # L^-1 P^1/2 U' W times the columns, with L of the posterior's precision, shape (W, n, J)
    half: torch.Tensor
    information: list[ndarray]  # of each window

    def shares(self, grams: Sequence[Gram]) -> list[WindowStatistics]:
        """Return the windows' statistics with the residuals of grams of the same derivatives."""
        weight = self.weight
        count, n, columns = self.half.shape
        hidden = np.zeros((count, n))
        effects = np.zeros((count, columns))
        for w, (gram, kept_columns) in enumerate(zip(grams, self.own_columns)):
            cross = weight @ gram.cross
            size = gram.nuisances + gram.latents
            hidden[w, :size] = cross[:size]
            effects[w, kept_columns] = cross[len(cross) - len(kept_columns) :]
        right = self.shape.level * torch.from_numpy(hidden).to(self.half.device)
        projected = torch.linalg.solve_triangular(self.shape.factor, right[:, :, None], upper=False)
        explained = self.half.mT @ projected
        square = self.shape.log_det - projected.square().sum((1, 2))
        explained, square = all_to_host((explained[..., 0], square))
        results = []
        for w, gram in enumerate(grams):
            score = (effects[w] - explained[w])[self.own_columns[w]]
            whole = float(weight @ gram.square + square[w])
            results.append(WindowStatistics(self.information[w], score, whole))
        return results


class Integrals:
    """The part of windows' statistics that no residual changes; it stays on the device."""

    def __init__(self, order: Sequence[Sequence[int]], batches: Sequence[_Integrated]):
        """Keep it; ``order``: numbers of each batch's windows."""
        self._order = order
        self._parts = batches
        self._gathered: Statistics | None = None  # by flights, with the first residuals

    @property
    def log_dets(self) -> list[float]:
        """Return the log determinant of each window's V."""
        return _by_window(self._order, [part.shape.log_det.tolist() for part in self._parts])

    def shares(self, grams: Sequence[Gram]) -> list[WindowStatistics]:
        """Return the windows' statistics with the residuals of grams of the same derivatives."""
        parts = []
        for members, part in zip(self._order, self._parts):
            parts.append(part.shares([grams[w] for w in members]))
        return _by_window(self._order, parts)

    def statistics(self, grams: Sequence[Gram], theta: ndarray) -> Statistics:
        """Return the statistics of flights with the residuals of grams of the same derivatives.

        ``theta``: where these residuals are, in floors, shape (K,). Raises DiagnoseError: as
        :func:`~visthrow.diagnose.likelihood.marginal.gather`."""
        shares = self.shares(grams)
        if self._gathered is not None:
            return rescored(self._gathered, grams, shares, theta)
        self._gathered = gather(grams, shares, theta)
        return self._gathered


def _integrated(batch: _Batch, noise: Noise, latents: bool) -> _Integrated:
    shape = _shape(batch, noise)
    _, channels, n = batch.cross.shape
    sizes = [gram.nuisances + gram.latents for gram in batch.grams]
    inner = [gram.inner for gram in batch.grams]
    width = len(batch.grams[0].inner[0]) - sizes[0]

    def weighed(parts: Sequence[ndarray], height: int) -> torch.Tensor:
        device = str(batch.square.device)
        return _weighed(shape.weight, side_by_side(parts, (channels, height, width), device))

    right = weighed([part[:, :size, size:] for part, size in zip(inner, sizes)], n)
    effects = weighed([part[:, size:, size:] for part, size in zip(inner, sizes)], width)
    if latents:
        hidden = _weighed(shape.weight, batch.hidden)
        above = torch.cat((hidden, right), 2)
        below = torch.cat((right.mT, effects), 2)
        right = above
        effects = torch.cat((above, below), 1)
    scaled = shape.level[:, :, None] * right
    half = torch.linalg.solve_triangular(shape.factor, scaled, upper=False)
    reduced = effects - half.mT @ half
    whole = (0.5 * (reduced + reduced.mT)).cpu().numpy()
    columns = [np.arange(width)] * len(sizes)
    if latents:
        begins = [gram.nuisances for gram in batch.grams]
        columns = [np.r_[begin:size, n : n + width] for begin, size in zip(begins, sizes)]
    information = [values[np.ix_(rows, rows)] for values, rows in zip(whole, columns)]
    return _Integrated(columns, shape, noise.scale**-2.0, half, information)

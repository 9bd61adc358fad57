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

from visthrow.common.errors import DiagnoseError
from visthrow.diagnose.likelihood.marginal import (
    Gram,
    Noise,
    Statistics,
    without_rounding,
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


def integrals(grams: Sequence[Gram], noise: Noise, device: str = "cpu") -> "Integrals":
    """Integrate initial states and latent forces out of windows.

    Raises DiagnoseError: as :meth:`Stack.fitted`; information came out negative beyond rounding.
    """
    return Integrals(Stack(grams, device), grams, noise)


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
        self._sizes = [gram.hidden for gram in grams]
        order = sorted(range(len(grams)), key=self._sizes.__getitem__)
        self.order = [order[first : first + size] for first in range(0, len(order), size)]
        parts = [[grams[w] for w in members] for members in self.order]
        self.batches = parallel_map(self._padded, parts, [rows[m] for m in self.order])

    def _padded(self, grams: list[Gram], windows: ndarray) -> _Batch:
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
        arrays = cross, square, counts, log_sigma, member, initial
        tensors = [torch.from_numpy(array).to(self.device) for array in arrays]
        parts = [gram.inner[:, : gram.hidden, : gram.hidden] for gram in grams]
        hidden = side_by_side(parts, (counts.shape[1], n, n), self.device)
        return _Batch(windows, grams, hidden, *tensors)

    def fitted(self, noise: Noise) -> tuple[list[ndarray], ndarray]:
        """Most probable initial state and unit latent forces of each window, shape (D + L,), and
        the log-likelihood of its residuals, but for the powers of 2 pi, shape (W,).

        Raises DiagnoseError: the normal equations are not positive definite, which only broken
        derivatives can cause."""

        def fit(batch: _Batch) -> tuple[torch.Tensor, torch.Tensor]:
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
        return parallel_map(lambda batch: tuple(all_to_host(function(batch))), self.batches)


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
    weight: ndarray  # of the channels, shape (C,)
    # L^-1 P^1/2 U' W S, with L of the posterior's precision, shape (W, n, K)
    half: torch.Tensor
    information: ndarray  # shape (W, K, K)

    def of_residuals(self, grams: Sequence[Gram]) -> tuple[ndarray, ndarray]:
        """Return scores, shape (W, K), and squares, shape (W,), with the residuals of grams of the
        same derivatives.
        """
        hidden, effects, square = _residual_products(grams, *self.half.shape[1:])
        right = self.shape.level * torch.from_numpy(self.weight @ hidden).to(self.half.device)
        projected = torch.linalg.solve_triangular(self.shape.factor, right[:, :, None], upper=False)
        explained = self.half.mT @ projected
        part = self.shape.log_det - projected.square().sum((1, 2))
        explained, part = all_to_host((explained[..., 0], part))
        return self.weight @ effects - explained, square @ self.weight + part


class Integrals:
    """The part of windows' statistics that no residual changes; it stays on the device."""

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
    device = str(batch.square.device)

    def weighed(parts: Sequence[ndarray], height: int) -> torch.Tensor:
        return _weighed(shape.weight, side_by_side(parts, (channels, height, count), device))

    right = weighed([g.inner[:, : g.hidden, g.hidden :] for g in batch.grams], n)
    effects = weighed([g.inner[:, g.hidden :, g.hidden :] for g in batch.grams], count)
    scaled = shape.level[:, :, None] * right
    half = torch.linalg.solve_triangular(shape.factor, scaled, upper=False)
    reduced = effects - half.mT @ half
    information = (0.5 * (reduced + reduced.mT)).cpu().numpy()
    return _Integrated(shape, noise.scale**-2.0, half, information)

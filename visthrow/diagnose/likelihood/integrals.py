"""Fit the initial states and latent forces of windows, or integrate them out, at given noise
levels.

The formulas are those of :mod:`visthrow.diagnose.likelihood.marginal`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy import ndarray
from scipy.linalg import lapack

from visthrow.common.errors import DiagnoseError
from visthrow.diagnose.likelihood.marginal import Gram, Noise, Statistics, without_rounding
from visthrow.diagnose.likelihood.threads import parallel_map
from visthrow.diagnose.models.model_interface import LATENT_BLOCKS

# relative growth of the normal equations' diagonal where rounding made them singular
ROUNDING = 1e-10

BLOCKS = len(LATENT_BLOCKS)


@dataclass(frozen=True)
class _Shape:
    """The factorised normal equations of a window at given noise levels; n columns [X, G].

    They do not depend on the residuals."""

    weight: ndarray  # of the channels, shape (C,)
    level: ndarray  # prior deviation of the columns, shape (n,)
    # inverse of the lower Cholesky factor L of 1 + P^1/2 U' W U P^1/2, shape (n, n)
    root: ndarray
    log_det: float  # of V

    def project(self, gram: Gram) -> ndarray:
        """Return L^-1 P^1/2 U' W r of a window's residuals, shape (n,)."""
        cross = self.weight @ gram.cross[:, : gram.hidden]
        part = self.root @ (self.level * cross)
        return part

    def square(self, gram: Gram) -> float:
        """Return r' V^-1 r + log det V of a window's residuals."""
        explained = np.square(self.project(gram)).sum()
        return self.weight @ gram.square - explained + self.log_det


def fit_windows(grams: Sequence[Gram], noise: Noise) -> tuple[list[ndarray], ndarray]:
    """Fit the initial states and latent forces of windows.

    ``noise``: with the shares of these windows. Returns the most probable initial state and
    independent latents of each, shape (D + L,), and the log-likelihood of its residuals without the
    powers of 2 pi, shape (W,).

    Raises DiagnoseError: the normal equations are not positive definite, which only broken
    derivatives can cause."""

    fits = []
    values = []
    for gram, shape in zip(grams, _shapes(grams, noise)):
        fits.append(shape.level * (shape.root.T @ shape.project(gram)))
        values.append(-0.5 * shape.square(gram))
    return fits, np.array(values)


def look(grams: Sequence[Gram], noise: Noise) -> tuple[ndarray, ndarray, ndarray]:
    """Return the log-likelihood of each window, its gradient and its expected curvature with
    respect to the logarithms of the window's noise levels.

    Raises DiagnoseError: as :func:`fit_windows`. Returns values (W,); gradients (W, B + C) by the
    standard deviations of B blocks and the scales of C channels; curvatures (W, B + C, B + C). The
    coupling of scales and fitted columns is divided among the channels by their degrees of
    freedom."""

    parts = map(_evaluate, grams, _shapes(grams, noise))
    return tuple(map(np.array, zip(*parts)))


def _shapes(grams: Sequence[Gram], noise: Noise) -> list[_Shape]:
    """Factorise the normal equations of windows."""
    return [_shape(gram, share, noise) for gram, share in zip(grams, noise.share)]


def _shape(gram: Gram, share: ndarray, noise: Noise) -> _Shape:
    """Factorise a window's normal equations; ``share``: its latent deviations relative to those of
    its phase, shape (B,).
    """
    levels = [noise.latent_sd.get((block, gram.phase), 0.0) for block in range(BLOCKS)]
    of_latents = (levels * share)[gram.latent_block]
    level = np.append(np.ones(gram.nuisances), of_latents)
    weight = noise.scale**-2.0
    normal = np.einsum("c,cij->ij", weight, _inner(gram)) * level * level[:, None]
    factor = _factor(normal + np.eye(len(level)), gram)
    log_diagonal = np.log(np.diag(factor)).sum()
    log_det = 2.0 * (log_diagonal + gram.log_sigma + gram.count @ np.log(noise.scale))
    root = lapack.dtrtri(factor.T, overwrite_c=1)[0].T  # LAPACK's arrays are ordered by columns
    return _Shape(weight, level, root, log_det)


def _inner(gram: Gram) -> ndarray:
    """Return the inner products of the columns that are integrated out, shape (C, n, n)."""
    return gram.inner[:, : gram.hidden, : gram.hidden]


def _factor(normal: ndarray, gram: Gram) -> ndarray:
    """Return the lower Cholesky factor of a window's normal equations.

    The search for noise levels may try extreme ones, beside which the identity is lost in rounding.
    Then the diagonal is increased a little."""
    for _ in range(2):
        try:
            return np.linalg.cholesky(normal)
        except np.linalg.LinAlgError:
            normal = normal + ROUNDING * np.diag(np.diag(normal))
    where = f"window of flight {gram.flight}, phase {gram.phase}"
    raise DiagnoseError(f"{where}: the normal equations are singular")


def _evaluate(gram: Gram, shape: _Shape) -> tuple[float, ndarray, ndarray]:
    """Return value, gradient and curvature by [blocks, scales]."""
    inner = _inner(gram)
    covariance = shape.root.T @ shape.root
    variance = np.diag(covariance)
    # contribution of the posterior variances of [b, a] to each channel's sum of squares
    spread = np.einsum("cij,ij->c", inner, covariance * np.outer(shape.level, shape.level))
    # Degrees of freedom that the columns take from each channel, limited because of rounding where
    # derivatives are huge.
    taken = np.clip(shape.weight * spread, 0.0, gram.count)
    in_blocks = np.zeros((BLOCKS, len(variance)))
    in_blocks[gram.latent_block, np.arange(gram.nuisances, gram.hidden)] = 1.0
    mean = shape.root.T @ shape.project(gram)
    moved = shape.level * mean
    bent = inner @ moved @ moved
    square = gram.square - 2.0 * gram.cross[:, : gram.hidden] @ moved + bent + spread
    by_block = in_blocks @ (variance + mean**2 - 1.0)
    gradient = np.append(by_block, square * shape.weight - gram.count)
    squared = np.square(covariance)
    shared = in_blocks @ (variance - squared.sum(1))
    np.fill_diagonal(squared, (1.0 - variance) ** 2)
    part = taken / max(taken.sum(), 1e-300)
    curvature = np.diag(np.append(np.zeros(BLOCKS), 2.0 * (gram.count - taken)))
    curvature[:BLOCKS, :BLOCKS] = 2.0 * in_blocks @ squared @ in_blocks.T
    curvature[:BLOCKS, BLOCKS:] = 2.0 * np.outer(shared, part)
    curvature[BLOCKS:, :BLOCKS] = curvature[:BLOCKS, BLOCKS:].T
    return -0.5 * shape.square(gram), gradient, curvature


class Integrals:
    """The part of windows' statistics that does not depend on the residuals."""

    def __init__(self, grams: Sequence[Gram], noise: Noise):
        """Integrate initial states and latent forces out; ``noise``: as in :func:`fit_windows`.

        Raises DiagnoseError: as :func:`fit_windows`, or the information is negative beyond
        rounding."""
        self._shapes = _shapes(grams, noise)
        self._halves, of_windows = zip(*parallel_map(_reduce, grams, self._shapes))
        count = max(map(len, of_windows))
        # windows with fewer effects have zeros for the last ones
        information = np.zeros((len(grams), count, count))
        for row, reduced in zip(information, of_windows):
            row[: len(reduced), : len(reduced)] = reduced
        self._information = without_rounding(information, grams)
        self._flights = np.array([gram.flight for gram in grams])
        self._samples = np.array([gram.count.sum() for gram in grams])

    @property
    def log_dets(self) -> ndarray:
        """Return the log determinant of each window's V, shape (W,)."""
        return np.array([shape.log_det for shape in self._shapes])

    def statistics(self, grams: Sequence[Gram], theta: ndarray) -> Statistics:
        """Return the statistics of windows with other residuals; ``grams``: with the same
        derivatives.

        ``theta``: sizes at which these residuals were simulated, in floors; 0 for effects
        beyond."""
        score = np.zeros(self._information.shape[:2])
        for row, gram, shape, half in zip(score, grams, self._shapes, self._halves):
            effects = shape.weight @ gram.cross[:, gram.hidden :]
            row[: len(effects)] = effects - half.T @ shape.project(gram)
        score[:, np.diagonal(self._information.sum(0)) == 0.0] = 0.0
        square = np.array([shape.square(gram) for gram, shape in zip(grams, self._shapes)])
        sizes = np.zeros(score.shape[1])
        sizes[: len(theta)] = theta
        return Statistics(self._flights, self._information, score, square, self._samples, sizes)


def _reduce(gram: Gram, shape: _Shape) -> tuple[ndarray, ndarray]:
    """Return the whitened inner products of a window's integrated columns and its effects,
    L^-1 P^1/2 U' W S, shape (n, K), and the information about the effects, shape (K, K).
    """
    effects = np.einsum("c,cij->ij", shape.weight, gram.inner[:, :, gram.hidden :])
    half = shape.root @ (shape.level[:, None] * effects[: gram.hidden])
    information = effects[gram.hidden :] - half.T @ half
    return half, 0.5 * (information + information.T)

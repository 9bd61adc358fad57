"""Express terms of laws (:mod:`visthrow.diagnose.models.law_terms`) by latent forces, which are
piecewise linear between knots.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy import ndarray
from scipy.interpolate import CubicSpline

from sim.effects.effect import Effect
from visthrow.diagnose.models.law_terms import JOINT, KnotValues, Term, carries, loads
from visthrow.diagnose.models.model_interface import LATENT_BLOCKS, Window

FINE = 8  # points between two knots at which a curve is evaluated


@lru_cache(maxsize=64)
def interpolation_matrix(count: int) -> ndarray:
    """Return the matrix from values at the knots to the coefficients of hat functions that
    approximate the smooth curve through these values best, shape (k, k).

    Linear interpolation of the values themselves cuts the curve's corners: it would lose an eighth
    of a force that oscillates at 2 Hz."""
    if count < 3:
        return np.eye(count)
    fine = (np.arange(FINE * (count - 1)) + 0.5) / FINE
    hats = np.maximum(1.0 - np.abs(fine[:, None] - np.arange(count)), 0.0)
    curve = CubicSpline(np.arange(count), np.eye(count), bc_type="natural")(fine)
    return np.linalg.lstsq(hats, curve, rcond=None)[0]


def through_latents(window: Window, quantities: KnotValues, block: str) -> ndarray:
    """Return the matrix from a block's force or torque at the knots to latent-force coefficients.

    Shape (L, 3 k); component i at knot j is column 3 j + i. Rows of other latent blocks are 0.
    """
    size = 3 * len(quantities["time"])
    if block != JOINT:
        return _hats(window, quantities["time"], block)
    units = np.eye(size).reshape(-1, 3, size)
    total = np.zeros((len(window.latent_block), size))
    for name, values in loads(block, quantities, units).items():
        total += _hats(window, quantities["time"], name) @ values.reshape(size, size)
    return total


def _hats(window: Window, time: ndarray, block: str) -> ndarray:
    """Return the interpolation weights of one latent block."""
    out = np.zeros((len(window.latent_block), len(time), 3))
    rows = np.flatnonzero(window.latent_block == LATENT_BLOCKS.index(block))
    nearest = np.abs(window.latent_time[rows, None] - time).argmin(axis=1)
    out[rows, :, window.latent_axis[rows].astype(int)] = interpolation_matrix(len(time))[nearest]
    return out.reshape(len(out), -1)


@dataclass(frozen=True)
class TermEffect(Effect):
    """A term of a law as an effect; its size is the term's coefficient."""

    term: Term | None = None
    price: float = 0.0  # penalty beyond the threshold [nats]

    def __post_init__(self) -> None:
        """Skip the check of bounds: a coefficient has none."""


def forces(window: Window, effects: Sequence[TermEffect]) -> ndarray:
    """Return the latent-force coefficients of a window that equal each term with a coefficient of
    1, shape (L, T).
    """
    out = np.zeros((len(window.latent_block), len(effects)))
    quantities = KnotValues(window.knots)
    for i, effect in enumerate(effects):
        if carries(window.latent_block, effect.term.block):
            values = effect.term.read(quantities).ravel()
            out[:, i] = through_latents(window, quantities, effect.term.block) @ values
    return out

"""Terms of laws (:mod:`visthrow.diagnose.models.law_terms`) as coefficients of latent forces,
which are hats at the knots.
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

FINE = 8  # points between two knots at which a curve is looked at


@lru_cache(maxsize=64)
def between(count: int) -> ndarray:
    """Coefficients of hats at the knots that come nearest to the smooth curve through values at the
    knots, shape (k, k).

    A hat each of the values themselves cuts the curve's corners: of a force that swings at 2 Hz an
    eighth were lost."""
    if count < 3:
        return np.eye(count)
    fine = (np.arange(FINE * (count - 1)) + 0.5) / FINE
    hats = np.maximum(1.0 - np.abs(fine[:, None] - np.arange(count)), 0.0)
    curve = CubicSpline(np.arange(count), np.eye(count), bc_type="natural")(fine)
    return np.linalg.lstsq(hats, curve, rcond=None)[0]


def through_latents(window: Window, quantities: KnotValues, block: str) -> ndarray:
    """Latent-force coefficients that what a block exerts at the knots stands for.

    Returns shape (L, 3 k): by component i at knot j in column 3 j + i; of other latent blocks 0.
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
    out[rows, :, window.latent_axis[rows].astype(int)] = between(len(time))[nearest]
    return out.reshape(len(out), -1)


@dataclass(frozen=True)
class TermEffect(Effect):
    """A term as an effect of a model; its size is the coefficient."""

    term: Term | None = None
    price: float = 0.0  # of its name, beyond the threshold [nats]

    def __post_init__(self) -> None:
        """Accept any bounds: a coefficient has none."""


def forces(window: Window, effects: Sequence[TermEffect]) -> ndarray:
    """Latent forces at a window's knots that a coefficient of 1 of each term stands for, shape (L,
    T).
    """
    out = np.zeros((len(window.latent_block), len(effects)))
    quantities = KnotValues(window.knots)
    for i, effect in enumerate(effects):
        if carries(window.latent_block, effect.term.block):
            values = effect.term.read(quantities).ravel()
            out[:, i] = through_latents(window, quantities, effect.term.block) @ values
    return out

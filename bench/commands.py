"""Command sequences that plants fly while they are timed."""

import numpy as np

from sim.hybrid import HybridSim
from sim.params import GRAVITY, PlantParams
from visthrow.task import ActionParams

KINDS = {
    "hover": "hover thrust within 10 %, body rates within 0.5 rad/s",
    "full": "thrust and body rates anywhere within the policy's limits",
}
"""Every command is drawn anew for each environment and control period, so that neighbours take
different branches.
"""


def draw(
    kind: str, plant: PlantParams, limits: ActionParams, steps: int, count: int, seed: int = 0
) -> np.ndarray:
    """Collective thrust [N] and body rates [rad/s], float32, shape (steps, count, 4)."""
    a = np.random.default_rng(seed).random((steps, count, 4), dtype=np.float32)
    a *= 2.0
    a -= 1.0
    if kind == "hover":
        weight = GRAVITY * plant.total_mass
        a[..., 0] = weight * (1.0 + 0.1 * a[..., 0])
        a[..., 1:] *= 0.5
        return a
    a[..., 0] = limits.max_thrust * (0.5 * (a[..., 0] + 1.0)) ** 2
    a[..., 1:] *= np.asarray(limits.max_rate, dtype=np.float32)
    return a


def shares(sim: HybridSim) -> dict[str, float]:
    """Shares of environments whose last control step fell back to the first stage somewhere, and
    that failed.
    """
    status = sim.get("status")
    return {
        "fallback": float(np.mean((status & 2) != 0)),
        "failed": float(np.mean((status & 1) != 0)),
    }

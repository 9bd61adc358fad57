"""Forces on the payload besides gravity and the rope, and how it leaves.

Equations: :class:`sim.params.RopeParams` and :class:`sim.params.ReleaseParams`.
"""

import numpy as np

from sim.params import GRAVITY, ReleaseParams, RopeParams


def force(
    rope: RopeParams, drag: float, velocity_w: np.ndarray, wind_w: np.ndarray, along_w: np.ndarray, lift_w: np.ndarray,
    hanging: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return the force on the payload [N], world frame, shape (E, 3).

    Args:
        rope: coefficients of downwash and friction.
        drag: 1/2 rho C_d A [kg/m].
        velocity_w: of the payload [m/s], shape (E, 3).
        wind_w: [m/s], shape (E, 3).
        along_w: direction of the rope's last segment, shape (E, 3).
        lift_w: force of the rotors on the vehicle [N], shape (E, 3).
        hanging: shape (E,), bool.
    """
    through = velocity_w - wind_w
    total = -drag * np.linalg.norm(through, axis=1, keepdims=True) * through
    across = velocity_w - np.sum(velocity_w * along_w, axis=1, keepdims=True) * along_w
    return total - hanging[:, None] * (rope.swing_damping * across + rope.downwash * lift_w)


def lag(params: ReleaseParams, pull: np.ndarray, payload_mass: np.ndarray) -> np.ndarray:
    """Return the time from the latch to the separation [s], shape (E,), from the rope's pull at the latch [N]."""
    return params.lag + params.lag_tension * (pull - payload_mass * GRAVITY)


def kick(params: ReleaseParams, along_w: np.ndarray) -> np.ndarray:
    """Return the speed that the mechanism gives [m/s], shape (E, 3); the rope shares it."""
    return np.array(params.kick_w) + params.kick_along * along_w

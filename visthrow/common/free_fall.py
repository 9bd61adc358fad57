"""Free fall without drag, for NumPy arrays and torch tensors."""

from typing import Any

import numpy as np

GRAVITY = 9.81  # acceleration of free fall [m/s^2]; a test holds it equal to the simulator's


def fall_time(height: Any, climb: Any, floor: float = 0.0) -> Any:
    """Return the time until a body reaches the ground [s].

    Args:
        height: height above the ground [m], an array or tensor of any shape.
        climb: upward velocity [m/s], same shape.
        floor: lower limit of the radicand [m^2/s^2], which is negative if the body never reaches
            the height of the ground.
    """
    radicand = (climb * climb + 2.0 * GRAVITY * height).clip(floor)
    root = np.sqrt(radicand) if isinstance(radicand, np.ndarray | np.generic) else radicand.sqrt()
    return (climb + root) / GRAVITY


def free_flight(pos_w: Any, vel_w: Any, time: Any) -> Any:
    """Return positions of bodies [m], shape (..., 3), after a time [s], a number or shape
    (..., 1).
    """
    path = pos_w + time * vel_w
    path[..., 2:] -= 0.5 * GRAVITY * time**2
    return path

"""Convert the policy's output to a command: collective thrust, body rates and release.

Onboard-safe; works on tensors, and on arrays of one vehicle.

The policy outputs five numbers, of which the first four are clipped to [-1, 1]. Thrust is quadratic
in the first, ``c = max_thrust ((1 + a) / 2)^2``: it is a throttle proportional to the motors'
speed, so it covers the vehicle's whole range, with hover near the middle. Rates are ``max_rate a``.
The fifth is the release latch's input. The paper does not state the scaling."""

import torch
from torch import Tensor

from camera.arrays import Array, library

COMMANDS = 4
ACTIONS = 5


def clip_action(action: Array) -> Array:
    """Return the action clipped to [-1, 1], shape (E, 5), as it is stored as the previous
    action.
    """
    return action.clip(-1.0, 1.0)


def command_from_action(action: Array, max_thrust: float | Tensor, max_rate: Array) -> Array:
    """Return the command of a clipped action.

    Args:
        action: normalised, shape (E, 5) or (E, 4); it is clipped again, as noise may have been
            added.
        max_thrust: collective thrust at +1 [N]; one number for all, or shape (E, 1).
        max_rate: body rates at +-1 [rad/s], shape (3,).

    Returns:
        Collective thrust [N] and body rates [rad/s], shape (E, 4).
    """
    bounded = action[:, :COMMANDS].clip(-1.0, 1.0)
    throttle = 0.5 * (bounded[:, :1] + 1.0)
    parts = [max_thrust * throttle * throttle, bounded[:, 1:] * max_rate]
    return library(action).concatenate(parts, -1)


def action_from_command(command: Tensor, max_thrust: float, max_rate: Tensor) -> Tensor:
    """Return the normalised action, shape (E, 4), of a command [N, rad/s], shape (E, 4); the
    inverse of :func:`command_from_action` within the limits.
    """
    throttle = (command[:, :1].clamp(0.0, max_thrust) / max_thrust).sqrt()
    return torch.cat([2.0 * throttle - 1.0, (command[:, 1:] / max_rate).clamp(-1.0, 1.0)], dim=-1)


def wants_release(action: Array, threshold: float) -> Array:
    """Return whether the fifth output is above the threshold and trips the latch, bool, shape
    (E,).
    """
    return action[:, COMMANDS] > threshold


def hover_action(weight: float, max_thrust: float) -> list[float]:
    """Return the action of a hover with a weight [N] and no release, which serves as the previous
    action when a policy starts.
    """
    return [2.0 * (weight / max_thrust) ** 0.5 - 1.0, 0.0, 0.0, 0.0, -1.0]

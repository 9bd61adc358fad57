"""From the policy's output to a command: collective thrust, body rates, release.

Onboard-safe; on tensors, and on arrays of one vehicle.

The policy puts out five numbers; the first four are clipped to [-1, 1]. Thrust is quadratic in the
first, ``c = max_thrust ((1 + a) / 2)^2``: the number is a throttle proportional to the motors'
speed, so the whole range of the vehicle is within reach and hover lies near the middle. Rates are
``max_rate a``. The fifth is the release latch's input. Not in the paper, which leaves the scaling
open."""

import torch
from torch import Tensor

from camera.arrays import Array, library

COMMANDS = 4
ACTIONS = 5


def clip_action(action: Array) -> Array:
    """Normalised action within [-1, 1], shape (E, 5): what is remembered as the previous action."""
    return action.clip(-1.0, 1.0)


def command_from_action(action: Array, max_thrust: float | Tensor, max_rate: Array) -> Array:
    """Command of a clipped action.

    Args:
        action: normalised, shape (E, 5) or (E, 4); noise may carry it slightly past 1 and is
            clipped again.
        max_thrust: collective thrust at +1 [N]; one for all, or shape (E, 1).
        max_rate: body rates at +-1 [rad/s], shape (3,).

    Returns:
        Collective thrust [N] and body rates [rad/s], shape (E, 4).
    """
    bounded = action[:, :COMMANDS].clip(-1.0, 1.0)
    throttle = 0.5 * (bounded[:, :1] + 1.0)
    parts = [max_thrust * throttle * throttle, bounded[:, 1:] * max_rate]
    return library(action).concatenate(parts, -1)


def action_from_command(command: Tensor, max_thrust: float, max_rate: Tensor) -> Tensor:
    """Normalised action, shape (E, 4), of a command [N, rad/s], shape (E, 4); the inverse of the
    above within limits.
    """
    throttle = (command[:, :1].clamp(0.0, max_thrust) / max_thrust).sqrt()
    return torch.cat([2.0 * throttle - 1.0, (command[:, 1:] / max_rate).clamp(-1.0, 1.0)], dim=-1)


def wants_release(action: Array, threshold: float) -> Array:
    """Whether the latch trips: the fifth output above the threshold, bool, shape (E,)."""
    return action[:, COMMANDS] > threshold


def hover_action(weight: float, max_thrust: float) -> list[float]:
    """Return the action of hover under a weight [N] with the latch at rest: what stands as the
    previous action when a policy starts.
    """
    return [2.0 * (weight / max_thrust) ** 0.5 - 1.0, 0.0, 0.0, 0.0, -1.0]

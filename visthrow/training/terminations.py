"""Ends of an episode (the paper, Sec. III-C). Every function returns bool tensors over the batch, shape (E,)."""

import math

import torch
from torch import Tensor

from sim.arrays.state import COLLISION, NONFINITE
from visthrow.task import BoundsParams


def out_of_bounds(p: BoundsParams, pos_w: Tensor) -> Tensor:
    """Vehicle outside the altitude or the horizontal bounds. pos_w: [m], shape (E, 3)."""
    height = pos_w[:, 2]
    return (height < p.altitude[0]) | (height > p.altitude[1]) | (pos_w[:, :2].square().sum(-1) > p.horizontal**2)


def tilted(p: BoundsParams, rot_wb: Tensor) -> Tensor:
    """Body z further from the vertical than allowed. rot_wb: shape (E, 3, 3)."""
    return rot_wb[:, 2, 2] < math.cos(math.radians(p.tilt_deg))


def payload_above(pos_w: Tensor, payload_w: Tensor) -> Tensor:
    """Payload higher than the vehicle."""
    return payload_w[:, 2] > pos_w[:, 2]


def payload_on_ground(payload_w: Tensor, landing_height: float) -> Tensor:
    """Payload down while still attached; not in the paper, whose bounds leave it open."""
    return payload_w[:, 2] < landing_height


def broken(status: Tensor) -> Tensor:
    """Simulator put the environment back from a bad state."""
    return torch.bitwise_and(status, NONFINITE) != 0


def collided(status: Tensor) -> Tensor:
    """Payload touched the vehicle."""
    return torch.bitwise_and(status, COLLISION) != 0


def negative(
    p: BoundsParams,
    pos_w: Tensor,
    rot_wb: Tensor,
    payload_w: Tensor,
    status: Tensor,
    latched: Tensor,
    time: Tensor,
    landing_height: float,
) -> Tensor:
    """All negative ends. Once the latch has tripped only collision and leaving the bounds end an episode early.

    Args:
        p: bounds.
        pos_w, payload_w: [m], shape (E, 3). rot_wb: shape (E, 3, 3).
        status: bits of :mod:`sim.arrays.state`, shape (E,).
        latched: shape (E,), bool. time: since the start [s], shape (E,).
        landing_height: [m].
    """
    always = out_of_bounds(p, pos_w) | collided(status) | broken(status)
    carrying = (
        tilted(p, rot_wb)
        | payload_above(pos_w, payload_w)
        | payload_on_ground(payload_w, landing_height)
        | (time > p.time_limit - 1e-6)
    )
    return always | (carrying & ~latched)

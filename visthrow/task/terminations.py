"""Conditions that end a throw, in training episodes and in flights on any plant.

A throw begins in ``ThrowEnv._begin`` (:mod:`visthrow.training.env.throw_env`) or in a phase of
:mod:`visthrow.throws.flight_loop`. The functions take and return tensors or NumPy arrays over the
batch, shape (E,) or (E, 3).

Source: the paper, Section III-C."""

import math
from functools import reduce
from operator import or_
from typing import TypeVar

import numpy as np
from torch import Tensor

from sim.kernels.state import COLLISION, NONFINITE
from visthrow.task import BoundsParams

Array = TypeVar("Array", Tensor, np.ndarray)


def out_of_bounds(p: BoundsParams, pos_w: Array) -> dict[str, Array]:
    """Return message -> whether the vehicle is outside a bound of position, shape (E,).
    pos_w: [m], shape (E, 3).
    """
    height = pos_w[:, 2]
    low, high = p.altitude
    outside = (height < low) | (height > high)
    far = (pos_w[:, :2] ** 2).sum(-1) > p.horizontal**2
    return {
        f"the vehicle left its altitude bounds of {low:g} to {high:g} m": outside,
        f"the vehicle went further than {p.horizontal:g} m": far,
    }


def ends_while_carrying(
    p: BoundsParams,
    pos_w: Array,
    upright: Array,
    payload_w: Array,
    time: Array | float,
    landing_height: float,
) -> dict[str, Array]:
    """Return message -> whether a throw ends before the latch trips, shape (E,). The paper does not
    state that a payload on the ground ends the throw.

    Args:
        p: bounds. landing_height: [m].
        pos_w, payload_w: [m], shape (E, 3). upright: vertical component of the body's z axis, shape
            (E,).
        time: time since the start [s], shape (E,) or one number for all.
    """
    steepest = math.cos(math.radians(p.tilt_deg))
    return {
        "the vehicle tilted too far": upright < steepest,
        "the payload rose above the vehicle": payload_w[:, 2] > pos_w[:, 2],
        "the payload touched the ground before the release": payload_w[:, 2] < landing_height,
        f"no release within {p.time_limit:g} s": time > p.time_limit - 1e-6,
    }


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
    """Return whether an episode ends in a failure, shape (E,), bool.

    After the latch has tripped only a collision, a non-finite state or leaving the bounds is a
    failure.

    Args:
        p, pos_w, payload_w, time, landing_height: see :func:`ends_while_carrying`.
        rot_wb: shape (E, 3, 3).
        status: bits of :mod:`sim.kernels.state`, shape (E,). latched: shape (E,), bool.
    """
    failed = (status & (COLLISION | NONFINITE)) != 0
    always = reduce(or_, out_of_bounds(p, pos_w).values()) | failed
    carrying = ends_while_carrying(p, pos_w, rot_wb[:, 2, 2], payload_w, time, landing_height)
    early = reduce(or_, carrying.values()) & ~latched
    return always | early

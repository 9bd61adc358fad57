"""Forces on the payload besides its weight and the rope. Equations: :class:`sim.params.RopeParams`."""

from types import SimpleNamespace
from typing import Any

import warp as wp

from sim.quadrotor import aero
from sim.structs import Types

LOADS = frozenset({"payload_drag", "push"})
"""Extensions that push at the payload."""


@wp.func
def drag_force(rope: Any, air_vel_w: Any):
    """Drag of the air [N], world frame, on the payload that moves through it at ``air_vel_w`` [m/s]."""
    return -(rope.payload_drag * wp.length(air_vel_w)) * air_vel_w


def build_payload(t: Types, extensions: frozenset[str]) -> SimpleNamespace:
    """Functions of the payload's air for a choice of extensions.

    Returns:
        Namespace of Warp functions ``force(rope, air, vel_w)`` [N] (zero, and not to be called, without any of
        :data:`LOADS`) and ``flight_acceleration(rope, air, vel_w, gravity)`` [m/s^2] of the payload alone in flight.
    """
    Rope, Air, vec3, real = t.Rope, t.Air, t.vec3, t.real
    air_velocity = aero.in_wind if "wind" in extensions else aero.still_air

    @wp.func
    def none(rope: Rope, air: Air, vel_w: vec3):
        return vec3()

    @wp.func
    def drag(rope: Rope, air: Air, vel_w: vec3):
        return drag_force(rope, air_velocity(air, vel_w))

    @wp.func
    def push(rope: Rope, air: Air, vel_w: vec3):
        return air.payload_push_w

    @wp.func
    def drag_and_push(rope: Rope, air: Air, vel_w: vec3):
        return drag_force(rope, air_velocity(air, vel_w)) + air.payload_push_w

    choice = ("payload_drag" in extensions, "push" in extensions)
    force = {(False, False): none, (True, False): drag, (False, True): push, (True, True): drag_and_push}[choice]

    @wp.func
    def flight_acceleration(rope: Rope, air: Air, vel_w: vec3, gravity: vec3):
        return gravity + force(rope, air, vel_w) * (real(1.0) / rope.payload_mass)

    return SimpleNamespace(force=force, flight_acceleration=flight_acceleration)

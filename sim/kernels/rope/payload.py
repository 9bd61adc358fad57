"""Forces on the payload besides its weight and the rope. Equations: :class:`sim.params.RopeParams`."""

from types import SimpleNamespace
from typing import Any

import warp as wp

from sim.kernels.quadrotor import aero
from sim.kernels.structs import Types

LOADS = frozenset({"payload_drag", "swing_damping", "downwash", "push"})
"""Extensions that push at the payload."""


@wp.func
def drag_force(rope: Any, air_vel_w: Any):
    """Drag of the air [N], world frame, on the payload that moves through it at ``air_vel_w`` [m/s]."""
    return -(rope.payload_drag * wp.length(air_vel_w)) * air_vel_w


@wp.func
def no_spin(rope: Any, force: Any, air_vel_w: Any):
    """Force on a payload that flies through the air without spin or seam."""
    return force


@wp.func
def spin_force(rope: Any, force: Any, air_vel_w: Any):
    """Air's force on the payload [N], world frame, with the side force and the lift of a ball that spins."""
    zero = air_vel_w[0] - air_vel_w[0]
    side = type(air_vel_w)(-air_vel_w[1], air_vel_w[0], zero)
    across = wp.normalize(side)
    return force + wp.length(air_vel_w) * (rope.payload_side * side + rope.payload_lift * wp.cross(air_vel_w, across))


def build_flight(t: Types, payload: SimpleNamespace, laws: SimpleNamespace):
    """Return ``flight_acceleration(rope, air, vel_w, gravity)`` [m/s^2] of the payload alone, laws on it included."""
    Rope, Air, vec3, real, in_flight = t.Rope, t.Air, t.vec3, t.real, laws.in_flight

    @wp.func
    def flight_acceleration(rope: Rope, air: Air, vel_w: vec3, gravity: vec3):
        return gravity + (payload.free(rope, air, vel_w) + in_flight(air, vel_w)) * (real(1.0) / rope.payload_mass)

    return flight_acceleration


def build_payload(t: Types, extensions: frozenset[str]) -> SimpleNamespace:
    """Functions of the payload's forces for a choice of extensions.

    Returns:
        Namespace of Warp functions ``hanging(rope, air, vel_w, along_w, jet_w)`` [N] (``along_w`` the last segment's
        direction, ``jet_w`` the force of the rotors on the air [N]) and ``free(rope, air, vel_w)`` [N] in flight.
    """
    Rope, Air, vec3 = t.Rope, t.Air, t.vec3
    air_velocity = aero.in_wind if "wind" in extensions else aero.still_air

    @wp.func
    def nothing(rope: Rope, air: Air, force: vec3, vel_w: vec3, along_w: vec3, jet_w: vec3):
        return force

    @wp.func
    def add_drag(rope: Rope, air: Air, force: vec3, vel_w: vec3, along_w: vec3, jet_w: vec3):
        return force + drag_force(rope, air_velocity(air, vel_w))

    @wp.func
    def add_friction(rope: Rope, air: Air, force: vec3, vel_w: vec3, along_w: vec3, jet_w: vec3):
        return force - rope.swing_damping * (vel_w - wp.dot(vel_w, along_w) * along_w)

    @wp.func
    def add_jet(rope: Rope, air: Air, force: vec3, vel_w: vec3, along_w: vec3, jet_w: vec3):
        return force + rope.downwash * jet_w

    @wp.func
    def add_push(rope: Rope, air: Air, force: vec3, vel_w: vec3, along_w: vec3, jet_w: vec3):
        return force + air.payload_push_w

    drag = add_drag if "payload_drag" in extensions else nothing
    friction = add_friction if "swing_damping" in extensions else nothing
    jet = add_jet if "downwash" in extensions else nothing
    push = add_push if "push" in extensions else nothing
    spin = spin_force if "payload_spin" in extensions else no_spin

    @wp.func
    def hanging(rope: Rope, air: Air, vel_w: vec3, along_w: vec3, jet_w: vec3):
        force = push(rope, air, drag(rope, air, vec3(), vel_w, along_w, jet_w), vel_w, along_w, jet_w)
        return jet(rope, air, friction(rope, air, force, vel_w, along_w, jet_w), vel_w, along_w, jet_w)

    @wp.func
    def free(rope: Rope, air: Air, vel_w: vec3):
        none = vec3()
        dragged = spin(rope, drag(rope, air, none, vel_w, none, none), air_velocity(air, vel_w))
        return push(rope, air, dragged, vel_w, none, none)

    return SimpleNamespace(hanging=hanging, free=free)

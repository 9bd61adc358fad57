"""Forces on the payload other than weight and rope.

Equations: :class:`sim.params.RopeParams`.
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from sim.kernels.structs import Types

# extensions with a force on the payload
LOADS = frozenset({"payload_drag", "swing_damping", "downwash", "push"})


@wp.func
def drag(rope: Any, air: Any, vel_w: Any):
    """Return the drag of the payload [N], world frame."""
    air_vel_w = vel_w - air.wind_w
    return -(rope.payload_drag * wp.length(air_vel_w)) * air_vel_w


@wp.func
def hanging_force(rope: Any, air: Any, vel_w: Any, along_w: Any, jet_w: Any):
    """Return the force [N] on a payload on the rope; ``along_w``: direction of the last segment;
    ``jet_w``: force of the rotors on the air [N].
    """
    force = drag(rope, air, vel_w) + air.payload_push_w
    force -= rope.swing_damping * (vel_w - wp.dot(vel_w, along_w) * along_w)
    return force + rope.downwash * jet_w


@wp.func
def free_force(rope: Any, air: Any, vel_w: Any):
    """Return the force [N] on a payload in flight, with side force and lift due to its spin."""
    air_vel_w = vel_w - air.wind_w
    side = type(vel_w)(-air_vel_w[1], air_vel_w[0], air_vel_w[0] - air_vel_w[0])
    lift = wp.cross(air_vel_w, wp.normalize(side))
    spin = wp.length(air_vel_w) * (rope.payload_side * side + rope.payload_lift * lift)
    return drag(rope, air, vel_w) + spin + air.payload_push_w


def build_flight(t: Types, laws: SimpleNamespace):
    """Return ``flight_acceleration(rope, air, vel_w, gravity)`` [m/s^2] of the payload alone, which
    includes the laws.
    """

    @wp.func
    def flight_acceleration(rope: Any, air: Any, vel_w: Any, gravity: Any):
        return gravity + (free_force(rope, air, vel_w) + laws.in_flight(air, vel_w)) * (
            t.real(1.0) / rope.payload_mass
        )

    return flight_acceleration

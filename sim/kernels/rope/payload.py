"""Forces on the payload besides its weight and the rope.

Equations: :class:`sim.params.RopeParams`.
"""

from types import SimpleNamespace

import warp as wp

from sim.kernels.structs import Types

# extensions that push at the payload
LOADS = frozenset({"payload_drag", "swing_damping", "downwash", "push"})


def build_flight(t: Types, payload: SimpleNamespace, laws: SimpleNamespace):
    """Return ``flight_acceleration(rope, air, vel_w, gravity)`` [m/s^2] of the payload alone, laws
    on it included.
    """
    Rope = t.Rope
    Air = t.Air
    vec3 = t.vec3
    real = t.real
    in_flight = laws.in_flight

    @wp.func
    def flight_acceleration(rope: Rope, air: Air, vel_w: vec3, gravity: vec3):
        return gravity + (payload.free(rope, air, vel_w) + in_flight(air, vel_w)) * (
            real(1.0) / rope.payload_mass
        )

    return flight_acceleration


def build_payload(t: Types, extensions: frozenset[str]) -> SimpleNamespace:
    """Functions of the payload's forces for a choice of extensions.

    Returns a namespace of Warp functions ``hanging(rope, air, vel_w, along_w, jet_w)`` [N]
    (``along_w`` the last segment's direction, ``jet_w`` the force of the rotors on the air [N]) and
    ``free(rope, air, vel_w)`` [N] in flight."""
    Rope = t.Rope
    Air = t.Air
    vec3 = t.vec3

    @wp.func
    def through_air(air: Air, vel_w: vec3):
        return vel_w - air.wind_w if wp.static("wind" in extensions) else vel_w

    @wp.func
    def drag(rope: Rope, air: Air, vel_w: vec3):
        force = vec3()
        if wp.static("payload_drag" in extensions):
            air_vel_w = through_air(air, vel_w)
            force += -(rope.payload_drag * wp.length(air_vel_w)) * air_vel_w
        return force

    @wp.func
    def hanging(rope: Rope, air: Air, vel_w: vec3, along_w: vec3, jet_w: vec3):
        force = drag(rope, air, vel_w)
        if wp.static("push" in extensions):
            force += air.payload_push_w
        if wp.static("swing_damping" in extensions):
            force -= rope.swing_damping * (vel_w - wp.dot(vel_w, along_w) * along_w)
        if wp.static("downwash" in extensions):
            force += rope.downwash * jet_w
        return force

    @wp.func
    def free(rope: Rope, air: Air, vel_w: vec3):
        force = drag(rope, air, vel_w)
        if wp.static("payload_spin" in extensions):  # side force and lift of a ball that spins
            air_vel_w = through_air(air, vel_w)
            side = vec3(-air_vel_w[1], air_vel_w[0], air_vel_w[0] - air_vel_w[0])
            lift = wp.cross(air_vel_w, wp.normalize(side))
            force += wp.length(air_vel_w) * (rope.payload_side * side + rope.payload_lift * lift)
        if wp.static("push" in extensions):
            force += air.payload_push_w
        return force

    return SimpleNamespace(hanging=hanging, free=free)

"""Aerodynamics of the vehicle: rotor and body drag, rotor inflow.

Equations: :class:`sim.params.AeroParams`.
"""

from typing import Any

import warp as wp


@wp.func
def aero_rotor_drag(p: Any, vel_b: Any, rate_b: Any, thrust: Any):
    """Return force [N] and torque [N m] of the air in addition to thrust and drag torque of the
    rotors in still air, both in the body frame, about the centre of mass.

    Args:
        p: vehicle.
        vel_b: velocity of the centre of mass through the air [m/s], body frame.
        rate_b: body rate [rad/s].
        thrust: of each rotor in still air [N], shape (4,).
    """
    a = p.aero
    force = (
        -wp.cw_mul(type(vel_b)(a.drag_x, a.drag_y, a.drag_z), vel_b)
        - a.parasitic * wp.length(vel_b) * vel_b
    )
    zero = a.inflow - a.inflow
    total = zero
    torque = vel_b - vel_b
    for i in range(4):
        arm = type(vel_b)(p.rotors.x[i], p.rotors.y[i], p.rotors.z)
        hub = vel_b + wp.cross(rate_b, arm)
        lift = thrust[i] * (
            -a.inflow * hub[2] + a.translational_lift * (hub[0] * hub[0] + hub[1] * hub[1])
        )
        drag_torque = p.thrust.torque_ratio * thrust[i] * (-a.torque_inflow * hub[2])
        force[2] = force[2] + lift
        torque = (
            torque
            + wp.cross(arm, type(vel_b)(zero, zero, lift))
            + type(vel_b)(zero, zero, p.rotors.spin[i] * drag_torque)
        )
        total = total + thrust[i]
    torque = torque + a.flapping * total * type(vel_b)(-vel_b[1], vel_b[0], zero)
    return force, torque


@wp.func
def aero_none(p: Any, vel_b: Any, rate_b: Any, thrust: Any):
    """Return no force and no torque (the ablation)."""
    none = vel_b - vel_b
    return none, none

"""Composer: rotor thrusts, torques and aerodynamics to one body wrench.

Equations: :class:`sim.params.VehicleParams`.
"""

from typing import Any

import warp as wp


@wp.func
def compose(
    p: Any,
    rate_b: Any,
    thrust: Any,
    torque: Any,
    motor_speed: Any,
    motor_rate: Any,
    aero_force: Any,
    aero_torque: Any,
):
    """Return the net force [N] and torque [N m] on the vehicle, body frame, about the centre of
    mass, without gravity.

    The rotors' gyroscopic torque ``-w x h e_z`` is perpendicular to the rate and does no work.
    """
    zero = rate_b[0] - rate_b[0]
    force = aero_force
    total_torque = aero_torque
    momentum = zero
    for i in range(4):
        force[2] = force[2] + thrust[i]
        yaw = p.rotors.spin[i] * (torque[i] + p.rotors.inertia * motor_rate[i])
        total_torque = total_torque + type(rate_b)(
            p.rotors.y[i] * thrust[i], -p.rotors.x[i] * thrust[i], yaw
        )
        momentum = momentum - p.rotors.inertia * p.rotors.spin[i] * motor_speed[i]
    total_torque = total_torque - wp.cross(rate_b, type(rate_b)(zero, zero, momentum))
    return force, total_torque

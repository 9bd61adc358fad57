"""Thrust and drag torque of the rotors, from motor speed and battery voltage.

Equations: :class:`sim.params.ThrustParams`.
"""

from typing import Any

import warp as wp


@wp.func
def rotor_thrust(p: Any, motor_speed: Any, voltage: Any):
    """Return the thrust of each rotor [N], shape (4,), without individual gains."""
    scale = type(voltage)(1.0) + p.thrust.voltage_coefficient * (
        voltage - p.battery.reference_voltage
    )
    return (p.thrust.k_f * wp.cw_mul(motor_speed, motor_speed) + p.thrust.k_1 * motor_speed) * scale


@wp.func
def rotor_thrust_scaled(p: Any, motor_speed: Any, voltage: Any):
    """Return the thrust of each rotor [N], shape (4,), with individual gains."""
    return wp.cw_mul(p.thrust.gain, rotor_thrust(p, motor_speed, voltage))


@wp.func
def near_ground(p: Any, air: Any, height: Any, thrust: Any):
    """Return the thrust of each rotor [N], shape (4,), in ground effect at a height [m].

    Equation: :class:`sim.params.AirParams`.
    """
    quarter = type(height)(0.25)
    one = type(height)(1.0)
    ratio = quarter * p.rotors.radius / wp.max(height, type(height)(0.5) * p.rotors.radius)
    return thrust * (one + air.ground_effect * (one / (one - ratio * ratio) - one))


@wp.func
def rotor_torque(p: Any, thrust: Any):
    """Return the magnitude of each rotor's drag torque [N m], shape (4,)."""
    return p.thrust.torque_ratio * thrust

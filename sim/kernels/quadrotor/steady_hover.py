"""Steady hover of actuators, filters, battery and command queue, from which every episode
starts.
"""

from typing import Any

import warp as wp

from sim.kernels.quadrotor.battery import open_circuit_voltage
from sim.kernels.structs import Types
from sim.params import VehicleParams


@wp.func
def hover_speed(p: Any, thrust: Any, voltage: Any):
    """Return the motor speed [rad/s] at which a rotor has a thrust [N] at a voltage [V], by the
    inverse of the complete thrust map.
    """
    one = type(thrust)(1.0)
    two = type(thrust)(2.0)
    t = p.thrust
    thrust_at_reference = thrust / (
        one + t.voltage_coefficient * (voltage - p.battery.reference_voltage)
    )
    return (wp.sqrt(t.k_1 * t.k_1 + two * two * t.k_f * thrust_at_reference) - t.k_1) / (
        two * t.k_f
    )


@wp.func
def hover_voltage(p: Any, used: Any, thrust: Any, speed: Any):
    """Return the steady terminal voltage [V] in hover, the upper root of ``u^2 - u_oc u + R P =
    0``.
    """
    power = p.battery.idle_power + thrust * speed * p.thrust.torque_ratio / p.battery.efficiency
    source = open_circuit_voltage(p, used)
    root = source * source - type(thrust)(4.0) * p.battery.resistance * power
    return type(thrust)(0.5) * (source + wp.sqrt(wp.max(root, root - root)))


def build_steady_hover(t: Types, vehicle: VehicleParams, State: type):
    """Build ``set_steady_hover(p, state, env, thrust, used)`` for a struct of state arrays.

    It sets motors, filters, battery and queue of an environment to hover with a collective thrust
    [N] and a fraction ``used`` of the charge used. The body rate must have been set before."""
    real = t.real
    zero = real(0.0)
    vec4 = t.vec4
    ideal = vehicle.battery.kind == "ideal"

    @wp.func
    def set_steady_hover(p: t.Vehicle, state: State, env: int, thrust: real, used: real):
        voltage = p.battery.reference_voltage
        charge_used = used
        if wp.static(ideal):
            charge_used = real(0.0)
        else:
            # speed and voltage depend weakly on each other: an iteration gains three digits
            for _ in range(4):
                voltage = hover_voltage(
                    p, used, thrust, hover_speed(p, thrust / real(4.0), voltage)
                )
        speed = hover_speed(p, thrust / real(4.0), voltage)
        state.motor_speed[env] = vec4(speed, speed, speed, speed)
        state.integral[env] = t.vec3()
        state.setpoint[env] = state.rate_b[env]
        state.gyro[env] = state.rate_b[env]
        state.charge_used[env] = charge_used
        state.voltage[env] = voltage
        for k in range(state.queue.shape[0]):
            state.queue[k, env] = vec4(thrust, zero, zero, zero)

    return set_steady_hover

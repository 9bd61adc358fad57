"""Actuators, filters, battery and command queue of a vehicle in steady hover: where every episode
starts.
"""

from typing import Any

import warp as wp

from sim.kernels.quadrotor.battery import open_circuit_voltage
from sim.kernels.structs import Types
from sim.params import VehicleParams


@wp.func
def hover_speed(p: Any, thrust: Any, voltage: Any):
    """Motor speed [rad/s] at which one rotor gives a thrust [N] under a voltage [V]; inverts the
    whole thrust map.
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
    """Terminal voltage [V] that a pack settles at while it feeds hover: the upper root of ``u^2 -
    u_oc u + R P = 0``.
    """
    power = p.battery.idle_power + thrust * speed * p.thrust.torque_ratio / p.battery.efficiency
    source = open_circuit_voltage(p, used)
    root = source * source - type(thrust)(4.0) * p.battery.resistance * power
    return type(thrust)(0.5) * (source + wp.sqrt(wp.max(root, root - root)))


def build_steady_hover(t: Types, vehicle: VehicleParams, State: type):
    """Build ``set_steady_hover(p, state, env, thrust, used)`` for a struct of state arrays.

    It puts motors, filters, battery and queue of an environment in hover under a collective thrust
    [N] with a fraction ``used`` of the charge gone. Nothing of the last episode stays. The body
    rate must have been set before."""
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
            # speed and voltage depend on each other weakly: each round gains three digits
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

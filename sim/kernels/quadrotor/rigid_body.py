"""Rigid-body dynamics of the quadrotor: derivative of its state, and step along a derivative.

``build_flow`` composes the seven blocks of the chosen kinds. The hybrid simulator and a quadrotor
without a rope both integrate the result."""

from typing import Any

import warp as wp

from sim.kernels.quadrotor import aero, battery, composer, controller, motor, thrust
from sim.kernels.structs import Types
from sim.params import VehicleParams

CONTROLLERS = {
    "betaflight": controller.rate_controller_betaflight,
    "motor_mixing": controller.rate_controller_motor_mixing,
    "geometric": controller.rate_controller_geometric,
}
MOTORS = {
    "first_order": motor.motor_rate_first_order,
    "instant": motor.motor_rate_instant,
    "asymmetric": motor.motor_rate_asymmetric,
}
BATTERIES = {"sag": battery.battery_sag, "ideal": battery.battery_ideal}
AEROS = {"rotor_drag": aero.aero_rotor_drag, "none": aero.aero_none}


@wp.func
def quat_rate(quat_wb: Any, rate_b: Any):
    """Return the time derivative of the attitude, half of ``quat_wb * (rate_b, 0)``."""
    half = type(rate_b[0])(0.5)
    return quat_wb * type(quat_wb)(
        rate_b[0] * half, rate_b[1] * half, rate_b[2] * half, rate_b[0] - rate_b[0]
    )


@wp.func
def angular_acceleration(p: Any, rate_b: Any, torque_b: Any):
    """Return the angular acceleration ``J^-1 (torque - w x J w)`` [rad/s^2], body frame."""
    momentum = wp.cw_mul(p.body.inertia, rate_b)
    return wp.cw_div(torque_b - wp.cross(rate_b, momentum), p.body.inertia)


@wp.func
def mount_position(rope: Any, s: Any):
    """Return the position of the rope's mount [m], world frame."""
    return s.pos_w + wp.quat_rotate(s.quat_wb, rope.mount)


@wp.func
def mount_velocity(rope: Any, s: Any):
    """Return the velocity of the rope's mount [m/s], world frame."""
    return s.vel_w + wp.quat_rotate(s.quat_wb, wp.cross(s.rate_b, rope.mount))


@wp.func
def advance(s: Any, r: Any, h: Any):
    """Return the state after ``h`` seconds along the derivative ``r``; the attitude is
    normalised.
    """
    out = s
    out.pos_w = s.pos_w + h * r.pos_w
    out.quat_wb = wp.normalize(s.quat_wb + r.quat_wb * h)
    out.vel_w = s.vel_w + h * r.vel_w
    out.rate_b = s.rate_b + h * r.rate_b
    out.motor_speed = s.motor_speed + h * r.motor_speed
    out.integral = s.integral + h * r.integral
    out.setpoint = s.setpoint + h * r.setpoint
    out.gyro = s.gyro + h * r.gyro
    out.charge_used = s.charge_used + h * r.charge_used
    out.voltage = s.voltage + h * r.voltage
    return out


@wp.func
def advance_instant(s: Any, r: Any, h: Any):
    """Return :func:`advance` for motors that reach their set-points at once."""
    out = advance(s, r, h)
    out.motor_speed = r.acting
    return out


@wp.func
def blend(a: Any, wa: Any, b: Any, wb: Any):
    """Return the weighted sum of two derivatives, with acting motor speeds and wrench of ``a``."""
    out = a
    out.pos_w = wa * a.pos_w + wb * b.pos_w
    out.quat_wb = a.quat_wb * wa + b.quat_wb * wb
    out.vel_w = wa * a.vel_w + wb * b.vel_w
    out.rate_b = wa * a.rate_b + wb * b.rate_b
    out.motor_speed = wa * a.motor_speed + wb * b.motor_speed
    out.integral = wa * a.integral + wb * b.integral
    out.setpoint = wa * a.setpoint + wb * b.setpoint
    out.gyro = wa * a.gyro + wb * b.gyro
    out.charge_used = wa * a.charge_used + wb * b.charge_used
    out.voltage = wa * a.voltage + wb * b.voltage
    return out


def build_flow(t: Types, vehicle: VehicleParams, extensions: frozenset[str], motors: bool):
    """Compose the blocks of a vehicle.

    Args:
        t: types of the precision.
        vehicle: only its kinds of blocks are used.
        extensions: names of :data:`sim.kernels.structs.EXTENSIONS` to build in.
        motors: commands are motor-speed set-points, without the vehicle's controller.

    Returns:
        ``flow(p, air, state, command) -> t.QuadRate``, whose accelerations are left at zero, and
        ``advance(state, rate, h) -> state``.
    """
    rate_controller = controller.motor_speeds if motors else CONTROLLERS[vehicle.controller.kind]
    motor_rate = MOTORS[vehicle.motor.kind]
    battery_rate = BATTERIES[vehicle.battery.kind]
    aerodynamics = AEROS[vehicle.aero.kind]

    @wp.func
    def flow(p: Any, air: Any, s: Any, command: Any):
        out = t.QuadRate()
        target, integral_rate, setpoint_rate, gyro_rate = rate_controller(
            p, command, s.rate_b, s.integral, s.setpoint, s.gyro, s.voltage
        )
        speed, speed_rate = motor_rate(p, s.motor_speed, target)
        f = thrust.rotor_thrust_scaled(p, speed, s.voltage)
        if wp.static("ground_effect" in extensions):
            f = thrust.near_ground(p, air, s.pos_w[2], f)
        charge_rate, voltage_rate = battery_rate(p, s.charge_used, s.voltage, speed, f)
        vel_b = wp.quat_rotate_inv(s.quat_wb, s.vel_w - air.wind_w)
        aero_force, aero_torque = aerodynamics(p, vel_b, s.rate_b, f)
        force, torque = composer.compose(
            p, s.rate_b, f, thrust.rotor_torque(p, f), speed, speed_rate, aero_force, aero_torque
        )
        if wp.static("push" in extensions):
            force += wp.quat_rotate_inv(s.quat_wb, air.push_w)
            torque += air.twist_b
        out.pos_w = s.vel_w
        out.quat_wb = quat_rate(s.quat_wb, s.rate_b)
        out.motor_speed = speed_rate
        out.integral = integral_rate
        out.setpoint = setpoint_rate
        out.gyro = gyro_rate
        out.charge_used = charge_rate
        out.voltage = voltage_rate
        out.acting = speed
        out.force_b = force
        out.torque_b = torque
        return out

    return flow, advance_instant if vehicle.motor.kind == "instant" else advance


def build_direct_flow(t: Types):
    """Return ``flow`` without blocks: the command is (thrust [N], torque [N m] about x, y, z) and
    acts at once.

    It is used for the rigid-body dynamics of tests, and for an idealised vehicle.
    """
    vec3 = t.vec3
    real = t.real

    @wp.func
    def flow(p: Any, air: Any, s: Any, command: Any):
        out = t.QuadRate()
        out.pos_w = s.vel_w
        out.quat_wb = quat_rate(s.quat_wb, s.rate_b)
        out.force_b = vec3(real(0.0), real(0.0), command[0])
        out.torque_b = vec3(command[1], command[2], command[3])
        return out

    return flow

"""Blocks of the vehicle and of the release in float64 NumPy, with the equations in the docstrings
of ``sim.params``.

Every function is pure and evaluates E environments. Body frame x forward, y left, z up; SI units.
The suffix ``_dot`` denotes a time derivative. The code is deliberately independent of the training
simulator's: they share only the equations."""

from functools import lru_cache

import numpy as np
from numpy import ndarray
from numpy.polynomial.polynomial import polyval

from sim.params import (
    GRAVITY,
    AeroParams,
    BatteryParams,
    ControllerParams,
    MotorParams,
    ReleaseParams,
    RopeParams,
    RotorParams,
    ThrustParams,
    VehicleParams,
)
from sim.reference.rotation_arrays import cross, length

# rotates a row vector by a quarter turn about z and removes its z component
_QUARTER_TURN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])

# columns of the blocks' state
SETPOINT = slice(0, 3)
GYRO = slice(3, 6)
INTEGRAL = slice(6, 9)
MOTORS = slice(9, 13)
USED = 13  # fraction
VOLTAGE = 14
BLOCKS = 15

# times closer than this are the same event [s]
TIME_TOLERANCE = 1e-10


def command_queue(times: ndarray, commands: ndarray, time: ndarray) -> ndarray:
    """Return the command that acts at ``time``, the latest one that has started to act.

    Args:
        times: when each command starts to act [s], shape (K, E), ascending along K; the first is
            before ``time``.
        commands: collective thrust [N] and body rates [rad/s], shape (K, E, 4).
        time: [s], shape (E,).
    """
    index = np.sum(times <= time + TIME_TOLERANCE, axis=0) - 1
    return commands[index, np.arange(len(time))]


@lru_cache(maxsize=8)
def _tilting(rotors: RotorParams) -> ndarray:
    """Return the thrust of each motor for a unit torque of roll and of pitch [1/m], shape (2,
    4).
    """
    x = np.array(rotors.x)
    y = np.array(rotors.y)
    return np.stack((y / np.sum(y**2), -x / np.sum(x**2)))


def _motor_shares(torque: ndarray, rotors: RotorParams, torque_ratio: float) -> ndarray:
    """Return the thrust of each motor for a torque about roll, pitch and yaw [N], shape (E, 4)."""
    yaw = np.array(rotors.spin) / (4.0 * torque_ratio)
    return torque[:, :2] @ _tilting(rotors) + torque[:, 2:] * yaw


def mixer(
    thrust: ndarray,
    torque: ndarray,
    rotors: RotorParams,
    torque_ratio: float,
    f_min: float,
    f_max: ndarray,
) -> tuple[ndarray, ndarray, ndarray]:
    """Distribute collective thrust and torque to the motors. At saturation yaw is reduced first,
    then roll and pitch.

    Args:
        thrust: [N], shape (E,).
        torque: [N m], shape (E, 3).
        rotors: geometry.
        torque_ratio: nominal kappa [m].
        f_min: least thrust of a motor [N].
        f_max: largest thrust of a motor [N], shape (E,).

    Returns:
        Thrusts [N], shape (E, 4); delivered share of roll and pitch and of yaw, 0 to 1, shapes
        (E,).

    Convention: yaw gets the largest part of the demand with which the range of the four thrusts
    stays within the limits."""
    spin = np.array(rotors.spin)
    tilt = torque[:, :2] @ _tilting(rotors)
    room = f_max - f_min
    extent = tilt.max(axis=1) - tilt.min(axis=1)
    scale = np.minimum(room / np.maximum(extent, 1e-300), 1.0)
    tilt = tilt * scale[:, None]
    # Yaw y raises the motors of one spin by y and lowers the others, so that only differences
    # between the two kinds change, by 2 y.
    rising = tilt[:, spin > 0.0]
    falling = tilt[:, spin < 0.0]
    highest = (room - (rising.max(axis=1) - falling.min(axis=1))) / 2.0
    lowest = -(room - (falling.max(axis=1) - rising.min(axis=1))) / 2.0
    amount = torque[:, 2] / (4.0 * torque_ratio)
    clipped = np.minimum(np.maximum(amount, np.minimum(lowest, 0.0)), np.maximum(highest, 0.0))
    clipped_yaw = spin * clipped[:, None]
    demand = thrust[:, None] / 4.0 + tilt + clipped_yaw
    raise_by = np.maximum(f_min - demand.min(axis=1), 0.0)
    lower_by = np.maximum(demand.max(axis=1) - f_max, 0.0)
    share = np.abs(clipped) / np.maximum(np.abs(amount), 1e-300)
    yaw_share = np.where(clipped == amount, 1.0, share)
    return demand + (raise_by - lower_by)[:, None], scale, yaw_share


def _pid_torque(
    gains: ControllerParams,
    error: ndarray,
    integral: ndarray,
    gyro_dot: ndarray,
    setpoint_dot: ndarray,
) -> ndarray:
    """Add up P, I, D and feed-forward [N m], shape (E, 3)."""
    torque = gains.p_gain * error + integral - gains.d_gain * gyro_dot
    return torque + gains.feedforward_gain * setpoint_dot


def betaflight(
    vehicle: VehicleParams, state: ndarray, command: ndarray, rate: ndarray
) -> tuple[ndarray, ndarray]:
    """Compute the rate controller with set-point filter, P, I with anti-windup, D on a filtered
    gyro, feed-forward and mixer.

    Args:
        vehicle: parameters.
        state: of the blocks, shape (E, 15).
        command: acting command, shape (E, 4).
        rate: true body rate [rad/s], shape (E, 3).

    Returns:
        Motor-speed set-points [rad/s], shape (E, 4), and the time derivatives of set-point, gyro
        and integral, shape (E, 9).
    """
    gains = vehicle.controller
    setpoint, gyro, integral = np.hsplit(state[:, : INTEGRAL.stop], 3)
    setpoint_dot = (command[:, 1:] - setpoint) / gains.setpoint_time_constant
    gyro_dot = (rate - gyro) / gains.gyro_time_constant
    error = setpoint - rate
    torque = _pid_torque(gains, error, integral, gyro_dot, setpoint_dot)
    relative = state[:, VOLTAGE] / vehicle.battery.reference_voltage
    f_max = gains.max_thrust * relative**2
    thrusts, tilt_share, yaw_share = mixer(
        command[:, 0], torque, vehicle.rotors, vehicle.thrust.torque_ratio, gains.min_thrust, f_max
    )
    integral_dot = gains.i_gain * error
    growing = integral_dot * integral > 0.0
    full = np.abs(integral) >= gains.integral_limit
    delivered = np.where(full, 0.0, np.array((tilt_share, tilt_share, yaw_share)).T)
    integral_dot = np.where(growing, delivered * integral_dot, integral_dot)
    correction = 1.0 + (1.0 - gains.voltage_compensation) * (relative - 1.0)
    speed = np.sqrt(thrusts / vehicle.thrust.k_f) * correction[:, None]
    return speed, np.hstack((setpoint_dot, gyro_dot, integral_dot))


def motor_mixing(
    vehicle: VehicleParams, state: ndarray, command: ndarray, rate: ndarray
) -> tuple[ndarray, ndarray]:
    """Compute the rate controller that mixes motor commands and relaxes its integral; arguments and
    result as for :func:`betaflight`.

    The state's set-point is the low-pass filtered rate command."""
    gains = vehicle.controller
    low, gyro, integral = np.hsplit(state[:, : INTEGRAL.stop], 3)
    rate_command = command[:, 1:]
    low_dot = (rate_command - low) / gains.setpoint_time_constant
    gyro_dot = (rate - gyro) / gains.gyro_time_constant
    error = rate_command - rate - gains.gyro_share * (gyro - rate)
    torque = _pid_torque(gains, error, integral, gyro_dot, low_dot)
    relaxed = np.clip(1.0 - np.abs(rate_command - low) / gains.relax_threshold, 0.0, None)
    relaxed[:, 2] = 1.0
    integral_dot = gains.i_gain * error * relaxed
    windup = (np.abs(integral) >= gains.integral_limit) & (integral_dot * integral > 0.0)
    shares = _motor_shares(torque, vehicle.rotors, vehicle.thrust.torque_ratio)
    added = shares * 0.5 / np.sqrt(gains.mix_thrust * gains.max_thrust)
    idle = np.sqrt(gains.min_thrust / gains.max_thrust)
    added = added / np.maximum(np.ptp(added, axis=1) / (1.0 - idle), 1.0)[:, None]
    throttle = np.sqrt(np.maximum(command[:, :1], 0.0) / 4.0 / gains.max_thrust)
    throttle = np.minimum(throttle, 1.0 - added.max(axis=1, keepdims=True))
    throttle = np.maximum(throttle, idle - added.min(axis=1, keepdims=True))
    relative = state[:, VOLTAGE] / gains.calibration_voltage
    correction = 1.0 + (1.0 - gains.voltage_compensation) * (relative - 1.0)
    factor = np.sqrt(gains.max_thrust / vehicle.thrust.k_f) * correction
    speed = factor[:, None] * np.maximum(throttle + added, 0.0)
    return speed, np.hstack((low_dot, gyro_dot, np.where(windup, 0.0, integral_dot)))


def geometric(
    vehicle: VehicleParams, state: ndarray, command: ndarray, rate: ndarray
) -> tuple[ndarray, float]:
    """Compute the proportional rate controller without filters; arguments as for
    :func:`betaflight`.
    """
    gains = vehicle.controller
    inertia = np.array(vehicle.body.inertia)
    torque = gains.geometric_gain * inertia * (command[:, 1:] - rate) + cross(rate, inertia * rate)
    shares = _motor_shares(torque, vehicle.rotors, vehicle.thrust.torque_ratio)
    thrusts = np.clip(command[:, :1] / 4.0 + shares, gains.min_thrust, gains.max_thrust)
    return np.sqrt(thrusts / vehicle.thrust.k_f), 0.0


CONTROLLERS = {"betaflight": betaflight, "motor_mixing": motor_mixing, "geometric": geometric}


def motor(params: MotorParams, speed: ndarray, setpoint: ndarray) -> ndarray:
    """Return the acceleration of the rotors [rad/s^2], shape (E, 4); zero for ``instant``."""
    if params.kind == "instant":
        return np.zeros_like(speed)
    slowing = params.time_constant_down if params.kind == "asymmetric" else params.time_constant
    return (setpoint - speed) / np.where(setpoint < speed, slowing, params.time_constant)


def open_circuit_voltage(params: BatteryParams, used: ndarray) -> ndarray:
    """Return the voltage without load [V], shape (E,)."""
    return polyval(used, params.ocv)


def electrical_power(params: BatteryParams, speed: ndarray, rotor_torque: ndarray) -> ndarray:
    """Return the power that the vehicle draws [W], shape (E,)."""
    return params.idle_power + np.sum(np.abs(rotor_torque) * speed, axis=1) / params.efficiency


def battery(
    params: BatteryParams,
    used: ndarray,
    voltage: ndarray,
    speed: ndarray,
    rotor_torque: ndarray,
) -> tuple[ndarray, ndarray]:
    """Return the rates of used fraction [1/s] and terminal voltage [V/s], shapes (E,)."""
    if params.kind == "ideal":
        return np.zeros_like(used), np.zeros_like(voltage)
    current = electrical_power(params, speed, rotor_torque) / voltage
    sagged = open_circuit_voltage(params, used) - params.resistance * current
    return current / (3600.0 * params.capacity), (sagged - voltage) / params.time_constant


def thrust_map(
    params: ThrustParams,
    reference_voltage: float,
    speed: ndarray,
    voltage: ndarray,
    gain: ndarray,
) -> tuple[ndarray, ndarray]:
    """Return thrust [N] and aerodynamic torque [N m] of the rotors, shapes (E, 4).

    Args:
        params: thrust map.
        reference_voltage: u_ref [V].
        speed: [rad/s], shape (E, 4).
        voltage: [V], shape (E,).
        gain: factor on each motor's thrust in addition to ``params.gain``, shape (E, 4).
    """
    factor = 1.0 + params.voltage_coefficient * (voltage - reference_voltage)
    thrust = (params.k_f * speed**2 + params.k_1 * speed) * factor[:, None]
    thrust = thrust * params.gain * gain
    return thrust, drag_torque_ratio(params) * thrust


def drag_torque_ratio(params: ThrustParams) -> float:
    """Return a rotor's true ratio of drag torque to thrust [m]. The controller's mixer uses the
    nominal ratio.
    """
    return params.torque_ratio * params.torque_gain


def compute_ground_factor(strength: float, radius: float, height: ndarray) -> ndarray:
    """Return the factor on the rotors' thrust at heights of the centre of mass [m], shapes (E,).

    See ``AirParams``.
    """
    if strength == 0.0:
        return np.ones_like(height)
    ratio = radius / (4.0 * np.maximum(height, 0.5 * radius))
    return 1.0 + strength * (1.0 / (1.0 - ratio**2) - 1.0)


def aerodynamics(
    params: AeroParams,
    arms: ndarray,
    torque_ratio: float,
    thrust: ndarray,
    air_velocity_b: ndarray,
    rate: ndarray,
) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """Return the aerodynamic forces and torques.

    Args:
        params: coefficients.
        arms: rotor hubs from the centre of mass [m], shape (E, 4, 3).
        torque_ratio: kappa [m].
        thrust: of the rotors [N], shape (E, 4).
        air_velocity_b: of the centre of mass relative to the air, body frame [m/s], shape (E, 3).
        rate: body rate [rad/s], shape (E, 3).

    Returns:
        Drag force [N] and flapping torque [N m], shapes (E, 3); change of each rotor's thrust [N]
        and of its drag torque [N m], shapes (E, 4).
    """
    if params.kind == "none":
        none = np.zeros_like(rate)
        unchanged = np.zeros_like(thrust)
        return none, none, unchanged, unchanged
    v = air_velocity_b
    force = (-params.drag_x, -params.drag_y, -params.drag_z) * v - params.parasitic * length(v) * v
    hub = v[:, None, :] + cross(rate[:, None, :], arms)
    inwards = hub[..., 2]
    lift = params.translational_lift * (hub[..., 0] ** 2 + hub[..., 1] ** 2)
    thrust_change = thrust * (-params.inflow * inwards + lift)
    torque_change = torque_ratio * thrust * (-params.torque_inflow * inwards)
    total = thrust.sum(axis=1)
    flapping = params.flapping * total[:, None] * (v @ _QUARTER_TURN)
    return force, flapping, thrust_change, torque_change


def composer(
    rotors: RotorParams,
    arms: ndarray,
    thrust: ndarray,
    rotor_torque: ndarray,
    speed: ndarray,
    speed_dot: ndarray,
    rate: ndarray,
    aero: tuple[ndarray, ndarray, ndarray, ndarray],
) -> tuple[ndarray, ndarray]:
    """Add up the wrench on the body about the centre of mass.

    Returns the force [N] and torque [N m], body frame, shapes (E, 3).

    Convention: the change of thrust by inflow contributes to the force and to the torque.
    """
    drag, flapping, thrust_change, torque_change = aero
    lift = thrust + thrust_change
    force = drag.copy()
    force[:, 2] += lift.sum(axis=1)
    yaw = rotor_torque + torque_change + rotors.inertia * speed_dot
    momentum = -rotors.inertia * np.sum(rotors.spin * speed, axis=1)
    torque = flapping.copy()
    torque[:, 0] += np.sum(arms[..., 1] * lift, axis=1) - rate[:, 1] * momentum
    torque[:, 1] -= np.sum(arms[..., 0] * lift, axis=1) - rate[:, 0] * momentum
    torque[:, 2] += np.sum(rotors.spin * yaw, axis=1)
    return force, torque


def payload_force(
    rope: RopeParams,
    drag: float,
    velocity_w: ndarray,
    wind_w: ndarray,
    along_w: ndarray,
    lift_w: ndarray,
    hanging: ndarray,
) -> ndarray:
    """Return the force on the payload [N], world frame, shape (E, 3).

    Args:
        rope: coefficients of downwash and friction.
        drag: 1/2 rho C_d A [kg/m].
        velocity_w: of the payload [m/s], shape (E, 3).
        wind_w: [m/s], shape (E, 3).
        along_w: direction of the rope's last segment, shape (E, 3).
        lift_w: force of the rotors on the vehicle [N], shape (E, 3).
        hanging: shape (E,), bool.
    """
    airspeed = velocity_w - wind_w
    total = -drag * length(airspeed) * airspeed
    normal = velocity_w - np.sum(velocity_w * along_w, axis=1, keepdims=True) * along_w
    friction = rope.swing_damping * normal
    return total - hanging[:, None] * (friction + rope.downwash * lift_w)


def release_lag(params: ReleaseParams, pull: ndarray, payload_mass: ndarray) -> ndarray:
    """Return the time from the latch to the separation [s], shape (E,), from the rope's pull at the
    latch [N].
    """
    return params.lag + params.lag_tension * (pull - payload_mass * GRAVITY)


def release_kick(params: ReleaseParams, along_w: ndarray) -> ndarray:
    """Return the change of velocity by the mechanism [m/s], shape (E, 3), for rope and payload."""
    return params.kick_w + params.kick_along * along_w

"""Vehicle of ``sim.reference.plant``: the seven blocks and the rigid body. While the rope is
attached, MuJoCo computes the body's accelerations.
"""

from dataclasses import dataclass

import numpy as np
from numpy import ndarray

from sim.params import GRAVITY, VehicleParams
from sim.reference import vehicle_blocks
from sim.reference.rotation_arrays import cross, quat_dot
from sim.reference.vehicle_blocks import BLOCKS, GYRO, INTEGRAL, MOTORS, SETPOINT, USED, VOLTAGE

# columns of a body: position, quaternion xyzw, velocity (world, centre of mass), rate (body)
POS = slice(0, 3)
QUAT = slice(3, 7)
VEL = slice(7, 10)
RATE = slice(10, 13)
BODY = 13


@dataclass(frozen=True)
class VehicleErrors:
    """Errors of E vehicles relative to their parameters."""

    thrust_gain: ndarray  # factor on each motor's thrust, shape (E, 4)
    com_offset: ndarray  # centre of mass from the frame's origin, body frame [m], shape (E, 3)


def rotor_arms(vehicle: VehicleParams, errors: VehicleErrors) -> ndarray:
    """Return the rotor hubs relative to the centre of mass [m], shape (E, 4, 3)."""
    rotors = vehicle.rotors
    hubs = np.array((rotors.x, rotors.y, (rotors.z,) * 4)).T
    return hubs - errors.com_offset[:, None, :]


def initial_blocks(
    vehicle: VehicleParams, rate_b: ndarray, weight: ndarray, used: ndarray
) -> ndarray:
    """Return block states in steady hover, shape (E, 15).

    The filters of set-point and gyro have settled at ``rate_b``, the integral is 0, the rotors'
    thrust equals ``weight``, and the terminal voltage has settled under this load.

    Args:
        vehicle: parameters.
        rate_b: [rad/s], shape (E, 3).
        weight: [N], shape (E,).
        used: fraction of the battery used, shape (E,).
    """
    count = len(weight)
    cell = vehicle.battery
    thrust = vehicle.thrust
    state = np.zeros((count, BLOCKS))
    state[:, SETPOINT] = rate_b
    state[:, GYRO] = rate_b
    voltage = np.full(count, cell.reference_voltage)
    for _ in range(50):
        factor = 1.0 + thrust.voltage_coefficient * (voltage - cell.reference_voltage)
        lift = weight / 4.0 / factor
        speed = 2.0 * lift / (thrust.k_1 + np.sqrt(thrust.k_1**2 + 4.0 * thrust.k_f * lift))
        if cell.kind == "ideal":
            break
        torque = np.full((count, 4), thrust.torque_ratio) * weight[:, None] / 4.0
        power = vehicle_blocks.electrical_power(cell, np.repeat(speed[:, None], 4, 1), torque)
        source = vehicle_blocks.open_circuit_voltage(cell, used)
        voltage = (source + np.sqrt(source**2 - 4.0 * cell.resistance * power)) / 2.0
    state[:, MOTORS] = speed[:, None]
    if cell.kind != "ideal":
        state[:, USED] = used
    state[:, VOLTAGE] = voltage
    return state


def vehicle_rates(
    vehicle: VehicleParams,
    errors: VehicleErrors,
    state: ndarray,
    command: ndarray,
    air_velocity_b: ndarray,
    rate_b: ndarray,
    near_ground: ndarray | float,
) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """Evaluate the seven blocks.

    Args:
        vehicle: parameters.
        errors: of the vehicles.
        state: of the blocks, shape (E, 15).
        command: acting command, shape (E, 4).
        air_velocity_b: velocity relative to the air, body frame [m/s], shape (E, 3).
        rate_b: [rad/s], shape (E, 3).
        near_ground: factor on the rotors' thrust, shape (E,).

    Returns:
        Force [N] and torque [N m] about the centre of mass, body frame, shapes (E, 3), the state's
        time derivative, and the rotors' thrust [N], shape (E, 4).
    """
    voltage = state[:, VOLTAGE]
    rates = np.zeros_like(state)
    control = vehicle_blocks.CONTROLLERS[vehicle.controller.kind]
    setpoint, rates[:, : INTEGRAL.stop] = control(vehicle, state, command, rate_b)
    speed = setpoint if vehicle.motor.kind == "instant" else state[:, MOTORS]
    rates[:, MOTORS] = vehicle_blocks.motor(vehicle.motor, speed, setpoint)
    thrust, torque = vehicle_blocks.thrust_map(
        vehicle.thrust, vehicle.battery.reference_voltage, speed, voltage, errors.thrust_gain
    )
    factor = np.reshape(near_ground, (-1, 1))
    thrust = factor * thrust
    torque = factor * torque
    rates[:, USED], rates[:, VOLTAGE] = vehicle_blocks.battery(
        vehicle.battery, state[:, USED], voltage, speed, torque
    )
    arms = rotor_arms(vehicle, errors)
    ratio = vehicle_blocks.drag_torque_ratio(vehicle.thrust)
    aero = vehicle_blocks.aerodynamics(vehicle.aero, arms, ratio, thrust, air_velocity_b, rate_b)
    force_b, torque_b = vehicle_blocks.composer(
        vehicle.rotors, arms, thrust, torque, speed, rates[:, MOTORS], rate_b, aero
    )
    return force_b, torque_b, rates, thrust


def rigid_body_rates(
    vehicle: VehicleParams, body: ndarray, force_w: ndarray, torque_b: ndarray
) -> ndarray:
    """Return the time derivative of free bodies, shape (E, 13), under a force [N], world frame,
    gravity and a torque [N m], body frame.
    """
    inertia = np.array(vehicle.body.inertia)
    rate = body[:, RATE]
    rates = np.empty_like(body)
    rates[:, POS] = body[:, VEL]
    rates[:, QUAT] = quat_dot(body[:, QUAT], rate)
    rates[:, VEL] = force_w / vehicle.body.mass - np.array([0.0, 0.0, GRAVITY])
    rates[:, RATE] = (torque_b - cross(rate, inertia * rate)) / inertia
    return rates

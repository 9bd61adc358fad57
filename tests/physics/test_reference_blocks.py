"""The reference's blocks against closed forms and conservation laws."""

import numpy as np
from numpy.testing import assert_allclose
from pytest import fixture, mark

from sim.params import GRAVITY
from sim.reference import vehicle_blocks
from sim.reference.quadrotor import (
    VehicleErrors,
    initial_blocks,
    rigid_body_rates,
    vehicle_rates,
)
from tests.oracle.quadrotor import ReferenceQuadrotor, rk4
from tests.plants import paper_plant, plain_vehicle

EXACT = 1e-12
"""Round-off of some ten operations on numbers of order 1."""
LEVEL = np.array([[0.0, 0.0, 0.0, 1.0]])


@fixture(scope="module")
def vehicle():
    return paper_plant().vehicle


def fly(quadrotor, command, periods):
    for _ in range(periods):
        quadrotor.step(np.array([command]))


def test_queue_switches_at_the_delay_exactly(vehicle):
    """A step of thrust after 22 ms: the rotors answer 22 ms after the command, within a period, as
    1 - exp(-t / T).
    """
    plain = plain_vehicle(vehicle)
    quadrotor = ReferenceQuadrotor(plain)
    start = quadrotor.blocks[0, 9]
    weight = plain.body.mass * GRAVITY
    fly(quadrotor, (2.0 * weight, 0.0, 0.0, 0.0), 1)
    assert_allclose(quadrotor.blocks[0, 9:13], start, rtol=EXACT)
    fly(quadrotor, (2.0 * weight, 0.0, 0.0, 0.0), 2)
    answered = 0.06 - plain.queue.delay
    final = np.sqrt(2.0 * weight / 4.0 / plain.thrust.k_f)
    expected = final + (start - final) * np.exp(-answered / plain.motor.time_constant)
    assert_allclose(quadrotor.blocks[0, 9:13], expected, rtol=1e-9)  # RK4, 15 us to the power of 4


def test_battery_settles_where_source_and_load_meet(vehicle):
    """u = (u_oc + sqrt(u_oc^2 - 4 R P)) / 2 under constant power, approached within
    time constants.
    """
    cell = vehicle.battery
    speed, torque = np.full((1, 4), 3000.0), np.full((1, 4), 0.015)
    power = cell.idle_power + 4 * 0.015 * 3000.0 / cell.efficiency
    state = np.array([[0.2, 16.0]])

    def rates(x):
        return np.stack(vehicle_blocks.battery(cell, x[:, 0], x[:, 1], speed, torque), -1)

    for _ in range(2000):
        state = rk4(rates, state, 5e-4)
    used, voltage = state[0]
    source = np.polynomial.polynomial.polyval(used, cell.ocv)
    settled = (source + np.sqrt(source**2 - 4.0 * cell.resistance * power)) / 2.0
    drawn = 1.0 * power / settled / (3600.0 * cell.capacity)
    slope = np.polynomial.polynomial.polyval(0.2, np.polynomial.polynomial.polyder(cell.ocv))
    assert (
        0.0 < voltage - settled < 1.2 * abs(slope) * drawn * cell.time_constant
    )  # lags the falling source by T
    assert abs(used - 0.2 - drawn) < 0.01 * drawn


def test_mixer_delivers_what_fits(vehicle):
    rotors, ratio = vehicle.rotors, vehicle.thrust.torque_ratio
    torque = np.array([[0.02, -0.03, 0.004]])
    thrusts, tilt_share, yaw_share = vehicle_blocks.mixer(
        np.array([4.0]), torque, rotors, ratio, 0.03, np.array([3.5])
    )
    x, y, spin = np.array(rotors.x), np.array(rotors.y), np.array(rotors.spin)
    delivered = [np.sum(thrusts * y), -np.sum(thrusts * x), ratio * np.sum(thrusts * spin)]
    assert_allclose(delivered, torque[0], atol=EXACT)
    assert abs(thrusts.sum() - 4.0) < EXACT
    assert (tilt_share[0], yaw_share[0]) == (1.0, 1.0)


@mark.parametrize("torque", [(0.0, 0.0, 0.1), (0.3, 0.1, 0.3), (0.05, 0.15, -0.1)])
def test_mixer_gives_up_yaw_before_roll_and_pitch(vehicle, torque):
    rotors, ratio = vehicle.rotors, vehicle.thrust.torque_ratio
    thrusts, tilt_share, yaw_share = vehicle_blocks.mixer(
        np.array([2.0]), np.array([torque]), rotors, ratio, 0.03, np.array([3.5])
    )
    assert thrusts.min() > 0.03 - EXACT
    assert thrusts.max() < 3.5 + EXACT
    x, y, spin = np.array(rotors.x), np.array(rotors.y), np.array(rotors.spin)
    roll, pitch, yaw = np.sum(thrusts * y), -np.sum(thrusts * x), ratio * np.sum(thrusts * spin)
    assert_allclose(roll * torque[1], pitch * torque[0], atol=EXACT)
    assert abs(yaw) < abs(torque[2])
    assert_allclose([roll, pitch], tilt_share[0] * np.array(torque[:2]), atol=EXACT)
    assert_allclose(yaw, yaw_share[0] * torque[2], atol=EXACT)
    assert abs(np.ptp(thrusts) - 3.47) < 1e-9  # what there is, is used


@mark.parametrize("battery", ["ideal", "sag"])
def test_hover_is_an_equilibrium(vehicle, battery):
    """Thrust equals weight at the start; a battery that holds 16.7 V makes the rotors a little fast
    afterwards.
    """
    plain = plain_vehicle(vehicle, aero="rotor_drag", battery=battery)
    weight = plain.body.mass * GRAVITY
    state = initial_blocks(plain, np.zeros((1, 3)), np.array([weight]), np.zeros(1))
    command = np.array([[weight, 0.0, 0.0, 0.0]])
    force, torque, rates, _ = vehicle_rates(
        plain, VehicleErrors.none(1), state, command, np.zeros((1, 3)), np.zeros((1, 3))
    )
    assert_allclose(force[0], (0.0, 0.0, weight), atol=1e-9)
    assert abs(rates[0, 14]) < 1e-9
    if battery == "ideal":
        assert_allclose(rates, 0.0, atol=1e-9)
        assert_allclose(torque, 0.0, atol=EXACT)


@mark.parametrize(
    ("controller", "motor"), [("betaflight", "first_order"), ("geometric", "instant")]
)
def test_rates_reach_their_command(vehicle, controller, motor):
    plain = plain_vehicle(vehicle, controller=controller, motor=motor)
    quadrotor = ReferenceQuadrotor(plain)
    fly(quadrotor, (plain.body.mass * GRAVITY, 2.0, -1.0, 0.5), 40)
    assert_allclose(quadrotor.body[0, 10:13], (2.0, -1.0, 0.5), atol=0.15)


def test_turning_body_keeps_momentum_and_energy(vehicle):
    """A free top: |J w| in the world frame and w.J.w stay."""
    inertia = np.array(vehicle.body.inertia)
    rate = np.array([[6.0, 3.0, -4.0]])
    body = np.hstack((np.zeros((1, 3)), LEVEL, np.zeros((1, 3)), rate))
    for _ in range(1000):
        body = rk4(
            lambda x: rigid_body_rates(vehicle, x, np.zeros((1, 3)), np.zeros((1, 3))), body, 5e-4
        )
    assert abs(np.sum(inertia * body[0, 10:] ** 2) / np.sum(inertia * rate**2) - 1.0) < 1e-10
    x, y, z, w = body[0, 3:7]
    momentum = inertia * body[0, 10:]
    axis, cross = np.array([x, y, z]), np.cross
    turned = momentum + 2.0 * cross(axis, cross(axis, momentum) + w * momentum)
    assert_allclose(turned, inertia * rate[0], rtol=1e-9)

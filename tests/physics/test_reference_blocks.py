"""The mixer of the reference plant: what fits is delivered, and yaw gives way first."""

import numpy as np
from numpy.testing import assert_allclose
from pytest import fixture, mark

from sim.reference import vehicle_blocks
from tests.plants import paper_plant

EXACT = 1e-12
"""Round-off of some ten operations on numbers of order 1."""


@fixture(scope="module")
def vehicle():
    return paper_plant().vehicle


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

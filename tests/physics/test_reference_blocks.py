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


def mix(vehicle, collective: float, torque: tuple[float, float, float]):
    """Thrusts of the rotors, what they do about roll, pitch and yaw, and the mixer's two shares."""
    rotors, ratio = vehicle.rotors, vehicle.thrust.torque_ratio
    thrusts, tilt_share, yaw_share = vehicle_blocks.mixer(
        np.array([collective]), np.array([torque]), rotors, ratio, 0.03, np.array([3.5])
    )
    x, y, spin = np.array(rotors.x), np.array(rotors.y), np.array(rotors.spin)
    delivered = [np.sum(thrusts * y), -np.sum(thrusts * x), ratio * np.sum(thrusts * spin)]
    return thrusts, np.array(delivered), tilt_share[0], yaw_share[0]


def test_mixer_delivers_what_fits(vehicle):
    torque = (0.02, -0.03, 0.004)
    thrusts, delivered, *shares = mix(vehicle, 4.0, torque)
    assert_allclose(delivered, torque, atol=EXACT)
    assert abs(thrusts.sum() - 4.0) < EXACT
    assert shares == [1.0, 1.0]


@mark.parametrize("torque", [(0.0, 0.0, 0.1), (0.3, 0.1, 0.3), (0.05, 0.15, -0.1)])
def test_mixer_gives_up_yaw_before_roll_and_pitch(vehicle, torque):
    thrusts, (roll, pitch, yaw), tilt_share, yaw_share = mix(vehicle, 2.0, torque)
    assert thrusts.min() > 0.03 - EXACT
    assert thrusts.max() < 3.5 + EXACT
    assert_allclose(roll * torque[1], pitch * torque[0], atol=EXACT)
    assert abs(yaw) < abs(torque[2])
    assert_allclose([roll, pitch], tilt_share * np.array(torque[:2]), atol=EXACT)
    assert_allclose(yaw, yaw_share * torque[2], atol=EXACT)
    assert abs(np.ptp(thrusts) - 3.47) < 1e-9  # what there is, is used

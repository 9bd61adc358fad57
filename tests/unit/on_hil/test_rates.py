"""Sticks from body rates:

Betaflight's curves at known points, their inverse, and which way is which.
"""

import math

from pytest import approx, mark

from hil.links.backends.rates import RatesParams, Sticks
from tests.fakes.fake_betaflight import rate_at

LINEAR = RatesParams("actual", (60, 60, 30), (60, 60, 30), (0, 0, 0))
ACTUAL = RatesParams("actual", (7, 20, 10), (67, 90, 40), (0, 54, 100))
CLASSIC = RatesParams("betaflight", (100, 180, 250), (70, 0, 40), (0, 30, 100))


def degrees(params, axis, stick):
    return math.degrees(params.rate(axis, stick))


def test_known_points_of_the_curves():
    """RC rate 1 with super rate 0.7 ends at 200 / 0.3 deg/s; actual rates end at their largest, and
    begin with their slope.
    """
    assert degrees(CLASSIC, 0, 1.0) == approx(200.0 / 0.3)
    assert degrees(CLASSIC, 0, 0.5) == approx(100.0 / 0.65)
    assert degrees(CLASSIC, 1, 1.0) == approx(360.0)
    assert degrees(CLASSIC, 1, 0.5) == approx(360.0 * (0.5**4 * 0.3 + 0.5 * 0.7))
    assert degrees(CLASSIC, 2, 1.0) == approx(min(1998.0, 200.0 * (2.5 + 14.54 * 0.5) / 0.6))
    assert degrees(ACTUAL, 0, 1.0) == approx(670.0)
    assert degrees(ACTUAL, 0, 0.5) == approx(70 * 0.5 + 600 * 0.25)
    assert degrees(ACTUAL, 0, 1e-6) == approx(70e-6, rel=1e-4)
    assert degrees(ACTUAL, 1, 0.5) == approx(200 * 0.5 + 700 * 0.5 * (0.5**5 * 0.54 + 0.5 * 0.46))
    assert degrees(LINEAR, 2, -0.5) == approx(-150.0)


@mark.parametrize("params", [LINEAR, ACTUAL, CLASSIC])
def test_the_inverse_is_as_near_as_microseconds_allow(params):
    sticks = Sticks(params)
    for axis in range(3):
        for i in range(-40, 41):
            rate = i / 40 * sticks.limits[axis]
            us = sticks.position(axis, rate)
            assert 1000 <= us <= 2000
            off = abs(rate_at(params, axis, us) - rate)
            for other in (us - 1, us + 1):
                if 1000 <= other <= 2000:
                    assert off <= abs(rate_at(params, axis, other) - rate) + 1e-12


def test_which_way_is_which():
    """Right roll is stick right; nose down, +y in forward-left-up, is stick forward; left yaw, +z,
    is stick left.
    """
    sticks = Sticks(LINEAR)
    assert sticks.position(0, 1.0) > 1500
    assert sticks.position(1, 1.0) > 1500
    assert sticks.position(2, 1.0) < 1500
    assert [sticks.position(axis, 0.0) for axis in range(3)] == [1500] * 3
    assert sticks.position(0, 1e3) == 2000, "beyond the end is the end"

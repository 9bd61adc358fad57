"""Free fall: the closed form; `test_team` and `test_reference_plant` of `tests/physics` hold the
simulators to it.
"""

import numpy as np
from numpy.testing import assert_allclose
from pytest import approx, mark

from visthrow.common.free_fall import fall_time, free_flight


def test_a_fall_ends_on_the_ground_with_its_energy():
    """Its speed there is that of the height that it fell through."""
    height, climb = np.array([2.0, 1.0, 0.5]), np.array([0.0, 3.0, -1.0])
    pos = np.column_stack([np.zeros(3), np.ones(3), height])
    vel = np.column_stack([np.ones(3), np.zeros(3), climb])
    time = fall_time(height, climb)
    expected = np.column_stack([time, np.ones(3), np.zeros(3)])
    assert_allclose(free_flight(pos, vel, time[:, None]), expected, atol=1e-12)
    assert_allclose((climb - 9.81 * time) ** 2, climb**2 + 2.0 * 9.81 * height)


@mark.parametrize(("floor", "expected"), [(0.0, 1.0 / 9.81), (-np.inf, np.nan)])
def test_a_height_that_is_never_reached(floor, expected):
    with np.errstate(invalid="ignore"):
        assert fall_time(np.float64(-1.0), np.float64(1.0), floor) == approx(expected, nan_ok=True)

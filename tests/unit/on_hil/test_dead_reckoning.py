"""Dead reckoning against closed forms of a turn and of a fall."""

import math

from pytest import approx, mark

from hil.control.tick.body_estimate import Estimate
from hil.control.tick.dead_reckoning import RESPONSE, DeadReckoning
from hil.poses.body_track import BodyState

TICK, AGE, MASS = 0.02, 0.01, 0.27
STILL = (0.0,) * 4
"""Command of no thrust and no rates."""


def estimate(time: float, age: float) -> Estimate:
    """A vehicle whose last pose came an age ago [s], as the tracks repeat it."""
    vehicle = BodyState((0.0, 0.0, 1.3), (0.0, 0.0, 0.0, 1.0), (1.0, 0.0, 0.5), (0.0,) * 3, age)
    return Estimate(time, vehicle, None, None, 0, 0, 0, AGE + age)


def carry(ticks=10, rates=lambda n: None, command=STILL) -> DeadReckoning:
    reckoning = DeadReckoning()
    for n in range(ticks + 1):
        reckoning.update(estimate(n * TICK, n * TICK), rates(n), command, MASS)
    return reckoning


@mark.parametrize("axis", [0, 1, 2])
def test_reported_rates_turn_the_attitude(axis):
    """From the time of the pose on; reports differ in a last digit."""
    rates = lambda n: tuple(3.0 + 1e-9 * n if i == axis else 0.0 for i in range(3))  # noqa: E731
    reckoning = carry(rates=rates)
    angle = 2.0 * math.atan2(reckoning.state.quat[axis], reckoning.state.quat[3])
    assert angle == approx(3.0 * (10 * TICK + AGE), abs=2e-3)
    assert reckoning.duration == approx(10 * TICK + AGE)


def test_without_reports_the_rates_follow_the_command():
    reckoning = carry(5, command=(0.0, 2.0, 0.0, 0.0))
    share = 1.0 - math.exp(-(5 * TICK + AGE) / RESPONSE)
    assert reckoning.state.rate == approx((2.0 * share, 0.0, 0.0))


def test_a_vehicle_without_thrust_falls_and_one_with_its_weight_goes_on():
    time = 10 * TICK + AGE
    falls = carry().state
    assert falls.vel == approx((1.0, 0.0, 0.5 - 9.81 * time), abs=1e-3)
    goes_on = carry(command=(MASS * 9.81, 0.0, 0.0, 0.0)).state
    assert goes_on.vel == approx((1.0, 0.0, 0.5), abs=1e-3)
    assert goes_on.pos == approx((time, 0.0, 1.3 + 0.5 * time), abs=1e-3)


def test_a_new_pose_begins_anew():
    reckoning = carry()
    reckoning.update(estimate(11 * TICK, 0.0), None, STILL, MASS)
    assert reckoning.state.vel == (1.0, 0.0, 0.5)
    assert reckoning.duration == 0.0

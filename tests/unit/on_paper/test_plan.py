"""The baseline's plan: projectile motion, septic spline, flatness, bounds."""

import numpy as np
from numpy.linalg import norm
from pytest import approx, fixture, mark, raises

from visthrow.common.errors import ConfigError
from visthrow.paper.baseline import pendulum_model as pm
from visthrow.paper.baseline import spline as sp
from visthrow.paper.baseline.pendulum_model import Pendulum
from visthrow.paper.baseline.spline import PlanError, PlanParams
from visthrow.paper.baseline.throw_plan import (
    landing_point,
    plan_throw,
    release_for,
)

MODEL = Pendulum(0.212, 0.060, 0.363)


OPEN_LOOP = 2e-3
"""State error of the flat inputs flown open loop at 2 ms, held constant over each step (measured
2e-4).
"""


@fixture(scope="module")
def plan():
    return plan_throw(MODEL, 2.0, 1.13, 2.2, PlanParams(), 0.04, lag=0.11)


def test_the_release_lands_on_the_target():
    release = release_for(2.0, 1.13, 2.2, 0.04)
    point, time = landing_point(release.pos_w, release.vel_w, 0.04)
    assert point == approx([2.0, 0.0])
    assert time == approx(np.sqrt(2.0 * (1.13 - 0.04) / 9.81))
    assert release.fall_time == approx(time)


@mark.parametrize(("height", "speed"), [(0.04, 2.0), (1.0, 0.0), (1.0, float("nan"))])
def test_impossible_releases_are_refused(height, speed):
    with raises(ConfigError, match="expected"):
        release_for(2.0, height, speed, 0.04)


def test_plan_ends_in_the_release_on_the_grid_and_within_bounds(plan):
    end = plan.path.sample(np.array([plan.path.duration]))[0]
    assert np.allclose(end[:2], [plan.release.pos_w, plan.release.vel_w], atol=1e-9)
    latch = (plan.path.duration - 0.11) / 0.02
    assert latch == approx(round(latch), abs=1e-9)
    path = plan.path.sample(np.arange(0.0, plan.path.duration, 0.005))
    bounds, soft = PlanParams(), 1.05  # soft bounds: a few per cent past them
    assert norm(path[:, 1], axis=1).max() < soft * bounds.max_speed
    assert norm(path[:, 2], axis=1).max() < soft * bounds.max_acceleration
    assert path[:, 0, 2].min() > bounds.floor
    states, inputs = plan.reference(0.0, 0.005, 150)
    assert np.all(pm.tension(MODEL, states[:-1], inputs) > 0.0)
    assert inputs[:, 0].max() < soft * bounds.max_thrust


def test_past_its_end_the_path_goes_on_straight(plan):
    beyond = plan.path.sample(np.array([plan.path.duration + 0.3]))[0]
    assert np.allclose(beyond[0], plan.release.pos_w + 0.3 * plan.release.vel_w)
    assert np.allclose(beyond[2:], 0.0)


def test_flat_inputs_flown_open_loop_stay_on_the_path(plan):
    step = 0.002
    count = round(plan.path.duration / step)
    states, inputs = plan.reference(0.0, step, count)
    state = states[0]
    for control in inputs:
        state = pm.step(MODEL, state, control, step)
    assert np.abs(state - states[-1]).max() < OPEN_LOOP


def test_bad_plans_are_refused():
    falling = np.zeros((1, 6, 3))
    falling[0, 2, 2] = -9.81
    with raises(PlanError, match="falls freely"):
        sp.flat_reference(MODEL, falling)

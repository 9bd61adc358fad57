"""The fit of a moving goal's velocity: the line through exact positions, its accuracy under noise,
and where a frame shows the goal.
"""

from dataclasses import replace

import numpy as np
import torch
from numpy.random import default_rng
from numpy.testing import assert_allclose
from pytest import approx

from camera.keypoints import KeypointCamera, keypoints
from tests.configs import load_experiment
from tests.unit.on_onboard.test_located import follow
from visthrow.onboard import goal_motion
from visthrow.onboard import observations as ob

PERIOD = 0.02


def fit_velocity(positions: torch.Tensor, sigma: float) -> torch.Tensor:
    """Velocity after all steps; positions: (T, E, 2)."""
    sums = goal_motion.empty_sums(positions.shape[1])
    fresh = torch.ones(positions.shape[1], dtype=torch.bool)
    for step, place in enumerate(positions):
        time = torch.full((len(place),), step * PERIOD)
        sums, velocity = goal_motion.fit(sums, time, place, torch.full_like(time, sigma**-2), fresh)
        fresh = torch.zeros_like(fresh)
    return velocity


def test_equals_the_least_squares_line_with_a_prior():
    rng = default_rng(0)
    times = np.arange(12) * PERIOD
    places = 1.0 + 0.5 * times + 0.01 * rng.standard_normal(12)
    sigma = 0.02
    # (A^T A / sigma^2 + P) x = A^T y / sigma^2, with a prior on the slope alone
    design = np.column_stack((np.ones_like(times), times))
    normal = design.T @ design / sigma**2 + np.diag([0.0, goal_motion.SPEED_SIGMA**-2])
    slope = np.linalg.solve(normal, design.T @ places / sigma**2)[1]
    moving = torch.tensor(np.column_stack((places, -places)), dtype=torch.float32)[:, None]
    assert_allclose(fit_velocity(moving, sigma)[0].numpy(), [slope, -slope], rtol=2e-3)


def test_a_new_throw_forgets_the_last_one_and_an_unseen_goal_changes_nothing():
    sums = goal_motion.empty_sums(2)
    no = torch.zeros(2, dtype=torch.bool)
    for step in range(10):
        place = torch.tensor([[step * PERIOD, 0.0]] * 2)
        time, weight = torch.full((2,), step * PERIOD), torch.full((2,), 1e6)
        sums, velocity = goal_motion.fit(sums, time, place, weight, no)
    assert_allclose(velocity.numpy(), [[1.0, 0.0]] * 2, atol=2e-3)
    blind = torch.tensor([1e6, 0.0])
    fresh = torch.tensor([True, False])
    sums, velocity = goal_motion.fit(
        sums, torch.tensor([0.0, 0.2]), torch.full((2, 2), 9.0), blind, fresh
    )
    assert_allclose(velocity.numpy(), [[0.0, 0.0], [1.0, 0.0]], atol=2e-3)


def test_a_goal_straight_below_weighs_as_its_four_corners():
    """Each weighs 1 / (sigma reach^2 / height)^2."""
    params = load_experiment("vision_moving")
    layout, camera = ob.layout_of(params.task.observation), KeypointCamera(params.camera)
    frame = torch.tensor([[0.0, 0.0, 2.0, *[0.0] * 6, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]])
    goal, payload = torch.tensor([[0.03, 0.0, 0.0]]), torch.tensor([[0.0, 0.0, 1.5]])
    points, valid = keypoints(camera, frame[:, :3], torch.eye(3)[None], goal, payload)
    frame = torch.cat([frame, points.flatten(1)], dim=1)
    _, weight = goal_motion.measure_goal(layout, frame, valid, camera)
    assert weight.item() == approx(4 / (goal_motion.ANGLE_SIGMA * 2.0) ** 2, rel=0.05)


def test_a_located_state_layout_has_the_mean_goal():
    """Ten noisy frames of one goal: their mean less the measured position, beside the offset."""
    params = load_experiment("state").task.observation
    layout = ob.layout_of(replace(params, located=True))
    assert layout.dimension == ob.layout_of(params).dimension + 2
    rng = default_rng(1)
    places = 0.1 * rng.standard_normal((10, 2))
    goals = [1.5, -0.5] + 0.05 * rng.standard_normal((10, 2))
    frames = torch.zeros(10, 1, layout.frame)
    frames[:, 0, :2] = torch.tensor(places)
    frames[:, 0, ob.VEHICLE : ob.VEHICLE + 2] = torch.tensor(goals - places)
    for step, estimate in enumerate(follow(layout, frames, None, None)):
        assert torch.equal(estimate.frame, frames[step])
        expected = np.mean(goals[: step + 1], axis=0) - places[step]
        assert_allclose(estimate.places[0].numpy(), expected, atol=1e-5)

"""Parts of the environment by themselves: ages of poses and moving goals, against numbers worked by
hand.
"""

import math
from dataclasses import replace

import torch
from numpy.testing import assert_allclose
from pytest import approx

from tests.configs import load_experiment
from tests.episodes import COUNT, FRESH, LIKE, OLD
from visthrow.training.env.options import POSE, MovingGoals, PoseDelay

PERIOD = 0.02


def delay_of(**changes) -> PoseDelay:
    torch.manual_seed(3)
    params = load_experiment("state").task.observation
    return PoseDelay(replace(params, **changes), PERIOD, LIKE, None)


def sample(value: float) -> torch.Tensor:
    return torch.full((COUNT, POSE), value)


def test_jitter_moves_the_age_of_a_pose_both_ways():
    delay = delay_of(latency=(0.03, 0.03), latency_jitter=0.004)
    delay.begin(FRESH)
    for k in range(6):
        pose = delay.push(sample(k * PERIOD), FRESH if k == 0 else OLD)
    age = 5 * PERIOD - pose[:, 0]
    assert float(age.mean()) == approx(0.03, abs=2e-4)
    assert float(age.min()) == approx(0.026, abs=1e-4)
    assert float(age.max()) == approx(0.034, abs=1e-4)


def test_an_exact_pose_of_the_recent_past_lies_between_two_steps():
    delay = delay_of(latency=(0.0, 0.03))
    for k in range(3):
        delay.push(sample(float(k)), FRESH if k == 0 else OLD)
    assert_allclose(delay.exact(0.25 * PERIOD).numpy(), 1.75, atol=1e-6)


def test_goals_move_in_every_direction_at_the_configured_speeds():
    torch.manual_seed(3)
    goals = MovingGoals((0.2, 0.6), LIKE)
    goals.begin(FRESH)
    speed = goals.velocity.norm(dim=-1)
    heading = torch.atan2(goals.velocity[:, 1], goals.velocity[:, 0])
    assert float(speed.min()) == approx(0.2, abs=2e-3)
    assert float(speed.max()) == approx(0.6, abs=2e-3)
    assert float(heading.min()) == approx(-math.pi, abs=0.02)
    assert float(heading.max()) == approx(math.pi, abs=0.02)

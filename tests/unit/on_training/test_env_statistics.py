"""Additions of ThrowEnv to a perfect simulation: noise, bias and latency by their statistics, and
the reward of a crash worked by hand.
"""

import math

import torch
from pytest import approx
from torch.testing import assert_close

from tests.configs import load_experiment
from visthrow.onboard import actions as act
from visthrow.onboard import observations as ob
from visthrow.training.env import ThrowEnv

COUNT = 4096
"""Environments: standard deviations are then known to 1.1 %, means to 1.6 % of a deviation."""
SPREAD = 0.05  # relative; four and a half standard errors


def env_of(*overrides: str, count: int = COUNT) -> ThrowEnv:
    experiment = load_experiment("state", list(overrides))
    torch.manual_seed(7)
    return ThrowEnv(experiment, "cpu", seed=7, count=count)


def true_frame(env: ThrowEnv) -> torch.Tensor:
    """Return the state frame without noise and latency, shape (E, 20)."""
    state = env.views.state
    rot_wb = ob.rotation_from_quat(state["quat_wb"])
    vehicle = ob.vehicle_part(state["pos_w"], state["vel_w"], state["rate_b"], rot_wb)
    offset = ob.state_part(state["pos_w"], env.views.goal_w, env.views.out["payload_pos_w"])
    return torch.cat([vehicle, offset], dim=-1)


def require_spread(errors: torch.Tensor, step: float, bias: float) -> None:
    """Fail where errors at some steps, shape (T, ...), have another noise or bias."""
    assert errors.std().item() == approx(math.hypot(step, bias), rel=SPREAD)
    within = errors.std(dim=0).square().mean().sqrt()
    assert within.item() == approx(step, rel=SPREAD), "the bias must hold over the steps"


def test_measurements_have_the_configured_noise_and_bias():
    step, bias = 0.01, 0.03
    env = env_of(
        "task.observation.latency=[0.0,0.0]",
        f"task.noise.observation_step={step}",
        f"task.noise.observation_bias={bias}",
    )
    errors = []
    for _ in range(4):
        errors.append(env.measured[0] - true_frame(env))
        env.carry(env.previous_action)
    errors = torch.stack(errors)  # (T, E, 20)
    require_spread(errors, step, bias)
    assert errors.mean().abs() < 4.0 * bias / math.sqrt(COUNT * 20)


def test_measurements_are_as_old_as_the_latency():
    age = 0.02  # one control period
    env = env_of(
        f"task.observation.latency=[{age},{age}]",
        "task.noise.observation_step=0.0",
        "task.noise.observation_bias=0.0",
        count=64,
    )
    before = true_frame(env)
    env.carry(env.previous_action)
    now = true_frame(env)
    assert (now - before).abs().max() > 1e-3
    assert_close(env.measured[0], before, atol=1e-5, rtol=0.0)


def test_flown_commands_have_the_configured_noise_and_bias():
    step, bias = 0.02, 0.05
    env = env_of(f"task.noise.command_step={step}", f"task.noise.command_bias={bias}")
    action = torch.zeros(COUNT, act.ACTIONS)
    action[:, 4] = -1.0
    exact = act.command_from_action(action[:, :4], 14.0, torch.tensor([10.0, 10.0, 4.0]))
    scale = torch.tensor([7.0, 10.0, 10.0, 4.0])
    errors = []
    for _ in range(4):
        env.carry(action)
        errors.append((env.views.command.clone() - exact) / scale)
    require_spread(torch.stack(errors), step, bias)


def test_the_exact_critic_is_without_noise_and_the_actor_is_not():
    env = env_of(
        "task.observation.latency=[0.0,0.0]",
        "task.noise.observation_step=0.05",
        'ppo.privileged=["exact","payload_velocity"]',
    )
    groups, truth = env.get_observations(), true_frame(env)
    assert_close(groups["critic"][:, : ob.VEHICLE], truth[:, : ob.VEHICLE], atol=1e-6, rtol=0.0)
    noise = groups["actor"][:, : ob.VEHICLE] - truth[:, : ob.VEHICLE]
    assert noise.std().item() == approx(0.05, rel=SPREAD)


def test_a_crash_costs_its_penalty_once():
    env = env_of(
        "task.noise.command_step=0.0",
        "task.noise.command_bias=0.0",
        "task.start.mass=0.0",
        count=64,
    )
    p = env.cfg.task.reward
    pos_w = env.views.state["pos_w"]
    pos_w[:32, 2] = 3.5  # above the bounds, which end at 3 m
    pos_w[32:, 2] = 2.0
    action = env.previous_action.clone()
    _, reward, done, _ = env.step(action)
    assert done[:32].all()
    assert not done[32:].any()
    paid = p.scale * p.termination
    gap = reward[32:].mean() - reward[:32].mean()
    assert gap.item() == approx(paid, rel=0.02)
    assert reward[:32].max() < 0.0


def test_a_step_while_carrying_is_rewarded_as_worked_by_hand():
    env = env_of("task.noise.command_step=0.0", "task.noise.command_bias=0.0", count=16)
    p, period = env.cfg.task.reward, env.cfg.sim.control_period
    previous, action = env.previous_action.clone(), env.previous_action.clone()
    action[:, 1:4] = torch.tensor([0.3, -0.2, 0.1])
    _, reward, done, _ = env.step(action)
    assert not done.any()
    state, out = env.views.state, env.views.out
    vel, change = state["vel_w"], (action - previous)[:, :4]
    expected = p.velocity * vel.square().sum(1)
    expected += p.angular_velocity * state["rate_b"].square().sum(1)
    expected += p.relative_velocity * (out["payload_vel_w"] - vel).square().sum(1)
    costs = torch.tensor(p.rate_command), torch.tensor(p.command_change)
    expected -= p.smoothness * action[:, 1:4].square() @ costs[0]
    expected -= p.smoothness * (p.l1_mix * change.abs() + change.square()) @ costs[1]
    expected -= p.carry_time * period
    assert_close(reward, p.scale * expected, rtol=1e-4, atol=0.0)

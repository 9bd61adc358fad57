"""The environment as rsl_rl's VecEnv: fresh tensors, groups, ends, what the actor may not see, the
reward by hand.
"""

import math
from dataclasses import replace

import torch
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, fixture, mark, raises
from torch.testing import assert_close

from sim.kernels.state import COLLISION, NONFINITE
from tests.configs import load_experiment, quiet
from visthrow.common.errors import ConfigError
from visthrow.onboard import actions, observations
from visthrow.task import terminations
from visthrow.training.env import ThrowEnv

PERIOD = 0.02


@fixture(scope="module")
def env():
    torch.manual_seed(0)
    return ThrowEnv(quiet("state"), count=16)


def test_layouts_have_the_papers_sizes():
    params = load_experiment("vision_ideal").task.observation
    assert observations.layout_of(load_experiment("state").task.observation).dimension == 35
    assert observations.layout_of(params).dimension == 69
    assert observations.layout_of(replace(params, validity=False)).dimension == 61
    with raises(ValueError, match="expected 'state' or 'vision'"):
        observations.layout_of(replace(params, layout="lidar"))


def test_actor_does_not_see_what_only_the_critic_may(env):
    """Mass, voltage, timer and payload velocity change the critic's view alone."""
    still = torch.zeros(16, dtype=torch.bool)
    before = env._observe(still)
    changed = {"mass_scale": 1.3, "voltage": 12.0, "release_timer": 0.05}
    saved = {name: env.views.state[name].clone() for name in changed}
    for name, value in changed.items():
        env.views.state[name].fill_(value)
    env.views.out["payload_vel_w"] += 1.0
    after = env._observe(still)
    for name, value in saved.items():
        env.views.state[name].copy_(value)
    env.views.out["payload_vel_w"] -= 1.0
    now = (
        observations.VEHICLE + 5 + 2
    )  # the payload's history moved on by one entry of the same value
    assert_close(after["actor"][:, :now], before["actor"][:, :now], rtol=0, atol=0)
    assert_close(after["actor"][:, -1], before["actor"][:, -1], rtol=0, atol=0)
    assert (after["critic"] - before["critic"]).abs().amax(0).count_nonzero() >= 6


@mark.parametrize("name", ["paper", "paper_vision"])
def test_the_papers_recipe_and_nothing_else(name):
    """Sec.

    III-C and IV-C: 35 or 61 numbers, the critic's 38, no latency, a full battery, Table II
    unscaled.
    """
    paper = load_experiment(name)
    env = ThrowEnv(paper, count=32, seed=1)
    obs, reward, _, extras = env.step(torch.zeros(32, 5))
    assert extras == {}, "the time limit is a negative end; time_outs would bootstrap it"
    assert obs["actor"].shape == (32, 61 if "vision" in name else 35)
    assert obs["critic"].shape == (32, 38)
    assert_array_equal(obs["critic"][:, -4:-1].numpy(), env.views.out["payload_vel_w"].numpy())
    assert not env.delay.age.any()
    assert env.views.state["charge_used"].max() < 1e-3, (
        "share of a full battery that one step may draw"
    )
    rest = -2.0 * PERIOD - reward
    assert ((rest > 0.0) & (rest < 1.0)).all(), (
        "a second costs 2 as in Table II; what is left are speeds and commands"
    )
    assert paper.ppo.environments * paper.ppo.steps * paper.ppo.iterations == approx(2e8, rel=1e-3)
    kept = obs.clone()
    env.step(torch.zeros(32, 5))
    for group in ("actor", "critic"):
        assert torch.equal(obs[group], kept[group]), "the next step writes other tensors"


def test_the_critic_sees_what_is_named():
    """In the order of the documentation; without ``exact`` it begins with what the actor sees."""
    e = load_experiment("state")
    named = {
        "payload_velocity": 3,
        "release_timer": 1,
        "time": 1,
        "mass": 1,
        "voltage": 1,
        "mount": 6,
        "pose_age": 1,
    }
    for chosen in [(), ("exact",), ("mass",), ("exact", "mount"), tuple(named), ("exact", *named)]:
        altered = replace(e, ppo=replace(e.ppo, privileged=chosen))
        obs = ThrowEnv(altered, count=4).get_observations()
        known = sum(named.get(name, 0) for name in chosen)
        assert obs["critic"].shape == (4, 35 + known)  # exact: the same parts without their noise
        assert torch.equal(obs["critic"][:, :35], obs["actor"]) == ("exact" not in chosen)
    with raises(ConfigError, match=r"ppo\.privileged has 'velocity'; .*payload_velocity"):
        replace(e.ppo, privileged=("velocity",))


def test_release_ends_an_episode_after_the_lag_and_is_paid_by_hand():
    torch.manual_seed(0)
    env = ThrowEnv(quiet("state"), count=4)
    ask = torch.zeros(4, 5)
    ask[:, 4] = 1.0
    for step in range(1, 7):  # 0.11 s of lag end within the sixth period
        _, reward, done, _ = env.step(ask)
        assert bool(done.all()) == (step == 6)
    last, p = env.last, env.cfg.task.reward
    duration = 5 * PERIOD + 0.01  # separation lies 10 ms into the sixth period
    assert_allclose(
        (last["duration"] - env.views.out["time_to_impact"]).numpy(), duration, atol=1e-5
    )
    landing = 500.0 * torch.exp(-2.5 * last["landing_error"])
    flight = -2.0 * env.views.out["time_to_impact"]
    near = -100.0 * (0.25 - last["clearance"]).clamp(min=0.0)
    expected = (
        landing + flight + near - 2.0 * PERIOD
    )  # Eq. 2: nothing of speeds and commands at the release step
    assert_allclose((reward / p.scale).numpy(), expected.numpy(), rtol=1e-5)


SAFE = {"pos": (0.0, 0.0, 1.3), "payload": (0.0, 0.0, 0.9), "tilt": 0.0, "time": 1.0, "status": 0}
ENDS = [  # what is changed, to a value just inside and just outside; whether it counts once latched
    ("pos", (0.0, 0.0, 2.999), (0.0, 0.0, 3.001), True),
    ("pos", (0.0, 0.0, 0.501), (0.0, 0.0, 0.499), True),
    ("pos", (2.999, 0.0, 1.3), (3.001, 0.0, 1.3), True),
    ("pos", (0.0, -2.999, 1.3), (0.0, -3.001, 1.3), True),
    ("pos", (-2.12, 2.12, 1.3), (-2.13, 2.13, 1.3), True),
    ("tilt", 99.9, 100.1, False),
    ("payload", (0.3, 0.0, 1.299), (0.3, 0.0, 1.301), False),
    ("payload", (0.0, 0.0, 0.041), (0.0, 0.0, 0.039), False),
    ("time", 4.98, 5.0, False),
    ("status", 0, COLLISION, True),
    ("status", 0, NONFINITE, True),
]


@mark.parametrize(("name", "inside", "outside", "always"), ENDS)
def test_an_end_of_an_episode_just_inside_and_just_outside(name, inside, outside, always):
    bounds = load_experiment("state").task.bounds
    for value, ends in ((inside, False), (outside, True)):
        case = SAFE | ({"payload": (0.0, 0.0, 0.4)} if name == "pos" else {}) | {name: value}
        tilt = math.radians(case["tilt"])
        turned = torch.eye(3)[None].clone()
        turned[0, 1:, 1:] = torch.tensor(
            [[math.cos(tilt), -math.sin(tilt)], [math.sin(tilt), math.cos(tilt)]]
        )
        for latched in (False, True):
            ended = terminations.negative(
                bounds,
                torch.tensor([case["pos"]]),
                turned,
                torch.tensor([case["payload"]]),
                torch.tensor([case["status"]], dtype=torch.int32),
                torch.tensor([latched]),
                torch.tensor([case["time"]]),
                0.04,
            )
            assert ended.item() == (ends and (always or not latched))


def test_commands_and_their_inverse():
    rate = torch.tensor([10.0, 10.0, 4.0])
    action = torch.rand(100, 4) * 2 - 1
    command = actions.command_from_action(action, 14.0, rate)
    assert_close(actions.action_from_command(command, 14.0, rate), action, rtol=1e-5, atol=1e-5)
    edge = actions.command_from_action(torch.tensor([[9.0, 9, -9, 9], [-9.0, 0, 0, 0]]), 14.0, rate)
    assert edge.tolist() == [[14.0, 10.0, -10.0, 4.0], [0.0, 0.0, 0.0, 0.0]]
    hover = torch.tensor([actions.hover_action(2.7, 14.0)])
    assert actions.command_from_action(hover, 14.0, rate)[0, 0].item() == approx(2.7, rel=1e-5)
    assert not actions.wants_release(hover, 0.95).item()

"""A team's environment: one goal per world, joint releases, joint ends."""

import math
from types import SimpleNamespace

import numpy as np
import torch
from pytest import approx, fixture, mark, raises
from torch.testing import assert_close

from sim.params import GRAVITY
from visthrow import config
from visthrow.common.errors import ConfigError
from visthrow.common.free_fall import fall_time
from visthrow.cooperative.team import TeamExperiment, as_flown, members
from visthrow.cooperative.team_env import TeamEnv
from visthrow.cooperative.team_training import TeamTraining, _summary
from visthrow.onboard.observations import rotation_from_quat
from visthrow.training.ppo.ppo_training import PPOTraining


def experiment(name: str = "pair", *changes: str) -> TeamExperiment:
    return config.load(TeamExperiment, config.find("cooperative", name), changes)


@fixture
def env() -> TeamEnv:
    torch.manual_seed(3)
    return TeamEnv(as_flown(experiment(), "none"), seed=3, count=8)


def hover(env: TeamEnv, rho: torch.Tensor) -> torch.Tensor:
    actions = env.start_action.expand(env.num_envs, -1).clone()
    actions[:, 4] = rho
    return actions


def test_faults_are_those_of_vehicle_zero():
    parts = members(as_flown(experiment(), "weak"))
    assert parts["vehicles"][0].thrust.gain == (0.9,) * 4
    assert parts["vehicles"][1].thrust.gain == (1.0,) * 4
    lags = [r.lag for r in members(as_flown(experiment(), "late"))["releases"][:2]]
    assert lags[0] - lags[1] == approx(0.03)
    trained = members(experiment())
    assert {r.lag for r in trained["releases"][1::2]} == {experiment().release.lag}
    assert min(v.thrust.gain[0] for v in trained["vehicles"]) == approx(0.88)


def test_a_camera_sees_keypoints_in_place_of_load_and_goal():
    env = TeamEnv(experiment("pair_vision"), count=4)
    observed = env.get_observations()["actor"]
    assert observed.shape == (4, env.layout.dimension)
    assert torch.isfinite(observed).all()


def test_a_goal_that_is_fitted_over_a_throw_is_refused():
    with raises(ConfigError, match=r"observation\.located"):
        TeamEnv(experiment("pair_vision", "task.observation.located=true"), count=4)


def test_one_policy_of_both_sees_with_both_and_releases_at_once():
    env = TeamEnv(experiment("pair_central"), seed=3, count=8)
    observed = env.get_observations()["actor"]
    assert observed.shape == (4, 2 * env.layout.dimension)
    places = observed.unflatten(1, (2, -1))[:, :, :3].flatten(0, 1)
    assert_close(places, env.views.state["pos_w"], atol=0.2, rtol=0.0)
    actions = env.start_action.tile(4, 2)
    actions[:, 4::5] = torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    _, reward, done, _ = env.step(actions)
    tripped = env._worlds(env.views.state["release_timer"] >= 0.0)
    assert tripped.tolist() == [[True] * 2, [False] * 2, [False] * 2, [False] * 2]
    assert reward.shape == done.shape == (4,)


def test_rows_that_are_no_whole_worlds_are_refused():
    with raises(ValueError, match="7 rows; expected a multiple of 2"):
        TeamEnv(experiment(), count=7)


def find_least_gaps(env: TeamEnv) -> list[tuple[float, str]]:
    """Least gap of each world and what it is of, by loops over all pairs in float64."""
    state = {name: value.double() for name, value in env.views.state.items()}
    reach, rope = env.cfg.team.rotor_reach, env.cfg.rope
    radius = rope.payload_radius + env.cfg.vehicle.collision_radius
    least = []
    for world in range(env.worlds):
        rows = range(world * env.team, (world + 1) * env.team)
        gaps = []
        for a in rows:
            pos = state["pos_w"][a]
            gaps.append(((env.load_w[world].double() - pos).norm().item() - radius, "load"))
            for b in rows:
                if a == b:
                    continue
                other = state["pos_w"][b]
                gaps.append(((other - pos).norm().item() - 2.0 * reach, "vehicle"))
                if not state["attached"][b]:
                    continue
                turn = rotation_from_quat(state["quat_wb"][b : b + 1])[0]
                joint = other + turn @ env._mount.double()
                for direction in state["cable_dir_w"][:, b]:
                    joint = joint + direction * env._segment[b].double()
                    gaps.append(((joint - pos).norm().item() - reach, "cable"))
        least.append(min(gaps))
    return least


@mark.parametrize("vehicles", [2, 3])
def test_the_gap_is_the_least_over_all_pairs(vehicles):
    torch.manual_seed(vehicles)
    changes = experiment("pair", f"team.vehicles={vehicles}")
    env = TeamEnv(changes, seed=3, count=40 * vehicles)
    state = env.views.state
    state["pos_w"] += 0.4 * torch.randn_like(state["pos_w"])
    state["attached"].copy_(torch.rand(env.rows) < 0.6)
    expected = find_least_gaps(env)
    assert {kind for _, kind in expected} == {"load", "vehicle", "cable"}
    assert_close(env.gap().tolist(), [gap for gap, _ in expected], atol=1e-5, rtol=0)


def test_three_vehicles_release_on_the_last_request_and_land_after_the_last():
    env = TeamEnv(as_flown(experiment("pair", "team.vehicles=3"), "late"), seed=3, count=12)
    assert env.get_observations()["actor"].shape == (12, env.layout.dimension)
    requests = torch.ones(4, 3)
    requests[0, 2] = requests[1, 1] = requests[2, 0] = -1.0
    env.step(hover(env, requests.flatten()))
    env.step(hover(env, -torch.ones(12)))
    tripped = env._worlds(env.views.state["release_timer"] >= 0.0)
    assert tripped.tolist() == [[False] * 3] * 3 + [[True] * 3]
    released = env.last["released"]
    for _ in range(9):
        if released[3]:
            break
        env.step(hover(env, -torch.ones(12)))
        released = env.last["released"]
    assert released.tolist() == [False, False, False, True]
    last = {name: value[3].double() for name, value in env.last.items()}
    assert last["apart"] == approx(0.03, abs=1e-4)
    pos, vel, height = last["load_w"], last["load_vel_w"], env.cfg.release.landing_height
    fall = fall_time(pos[2] - height, vel[2])
    assert_close(last["landing_w"][:2], (pos + fall * vel)[:2], atol=1e-4, rtol=0.0)


def test_three_vehicles_learn():
    small = ["team.vehicles=3", "ppo.environments=48", "ppo.epochs=1", "ppo.hidden=[32]"]
    training = TeamTraining(experiment("pair", *small), "cpu", 3)
    before = training.policy({}).weights[-1].clone()
    rows = list(training.run(60.0, iterations=3))
    assert [row["iteration"] for row in rows] == [1, 2, 3]
    assert all(math.isfinite(value) for row in rows for value in row.values())
    assert (training.policy({}).weights[-1] != before).any()


def test_an_actor_sees_how_long_ago_its_latch_tripped():
    env = TeamEnv(as_flown(experiment(), "none"), seed=3, count=4)
    counts = []
    for k in range(6):
        requests = torch.tensor([1.0, 1.0, 1.0, -1.0]) if k != 4 else -torch.ones(4)
        observed = env.step(hover(env, requests))[0]["actor"]
        counts.append(observed[:, -1].tolist())
    assert counts == [[0.0] * 4] + [[k, k, 0.0, 0.0] for k in (1.0, 2.0, 3.0, 4.0, 5.0)]


def test_the_load_clears_the_vehicle_that_it_flies_past():
    env = TeamEnv(as_flown(experiment(), "none"), seed=3, count=4)
    env.views.state["pos_w"].copy_(torch.tensor([[0.9, 0.1, 1.2], [9.0, 0.0, 1.0]] * 2))
    env.load_w.copy_(torch.tensor([[0.0, 0.0, 1.0], [0.9, 0.1, 0.4]]))
    env.load_vel_w.copy_(torch.tensor([[2.0, 0.0, 2.0], [0.0, 0.0, 0.0]]))
    time = torch.linspace(0.0, 0.55, 2000, dtype=torch.float64)
    height = 1.0 + 2.0 * time - 0.5 * GRAVITY * time.square()
    passing = ((2.0 * time - 0.9).square() + 0.01 + (height - 1.2).square()).sqrt().min().item()
    clearance = env._clearance(torch.tensor([0.55, 0.2])).tolist()
    assert clearance == approx([passing, 0.8], abs=0.01)


@mark.parametrize(
    ("coefficient", "conditions", "latch"),
    [
        ("team.contact_cost", ["team.rotor_reach=0.33"], -1.0),
        ("team.margin_cost", ["team.rotor_reach=0.26"], -1.0),
        ("task.reward.termination", ["team.rotor_reach=0.33"], -1.0),
        ("task.reward.smoothness", ["task.reward.rate_command=[1.0, 2.0, 3.0]"], -1.0),
        ("task.reward.landing", ["task.reward.landing_decay=2.0"], 1.0),
        ("task.reward.proximity", ["release.clearance_margin=5.0"], 1.0),
    ],
)
def test_a_step_is_paid_as_worked_by_hand(coefficient, conditions, latch):
    rewards = []
    for value in (0.0, 10.0):
        torch.manual_seed(3)
        changes = experiment("pair", f"{coefficient}={value}", *conditions)
        env = TeamEnv(as_flown(changes, "none"), seed=3, count=4)
        actions = hover(env, torch.full((4,), latch))
        actions[:, 1:4] = torch.tensor([0.1, -0.2, 0.3])
        for _ in range(9):
            _, reward, done, _ = env.step(actions)
            if done.any():
                break
        rewards.append(reward)
    last, contact = env.last, env.last["contact"].float()
    missing = env.cfg.team.margin - last["gap"]
    assert torch.equal(last["contact"], (missing > env.cfg.team.margin) & ~last["released"])
    expected = {
        "contact_cost": -contact,
        "margin_cost": -missing.clamp(max=env.cfg.team.margin),
        "termination": -contact,
        "smoothness": torch.full((2,), -(0.01 + 2.0 * 0.04 + 3.0 * 0.09)),
        "landing": (-2.0 * last["landing_error"]).exp(),
        "proximity": last["clearance"] - 5.0,
    }[coefficient.split(".")[-1]]
    paid = (rewards[1] - rewards[0]) / (10.0 * env.cfg.task.reward.scale)
    assert_close(paid, env._rows(expected), atol=1e-4, rtol=1e-4)
    assert expected.abs().min() > 0.01


def test_cables_start_from_mounts_that_move_as_the_load_does():
    torch.manual_seed(3)
    env = TeamEnv(experiment("pair"), seed=3, count=16)
    env._mount.copy_(torch.tensor([0.1, -0.05, -0.2]))
    state = env.views.state
    state["rate_b"] += torch.randn_like(state["rate_b"])
    env._form(torch.ones(env.worlds, dtype=torch.bool))
    turn = rotation_from_quat(state["quat_wb"])
    length = env._segment[:, None] * env.cfg.rope.segments
    ends = state["pos_w"] + turn @ env._mount + length * state["cable_dir_w"][0]
    rate_w = (turn @ state["rate_b"][..., None])[..., 0]
    velocities = state["vel_w"] + torch.linalg.cross(rate_w, turn @ env._mount)
    for values in map(env._worlds, (ends, velocities)):
        assert_close(values[:, 0], values[:, 1], atol=1e-5, rtol=0.0)
        assert (values[0, 0] - values[1, 0]).norm() > 0.01


def test_releases_are_free_ever_earlier_as_training_goes_on(monkeypatch):
    monkeypatch.setattr(PPOTraining, "collect", lambda self, done: None)
    training = object.__new__(TeamTraining)
    training.experiment = experiment("pair", "team.free=[0.1, 0.3]", "team.first_release=20")
    training.env = SimpleNamespace(earliest=torch.tensor(-1))
    earliest = []
    for done in (0.0, 0.1, 0.15, 0.25, 0.3, 1.0):
        training.collect(done)
        earliest.append(int(training.env.earliest))
    assert earliest == [20, 20, 15, 5, 0, 0]


def test_a_bias_points_from_the_target_to_where_loads_land():
    values = {
        "released": np.array([True, True, True, False]),
        "contact": np.array([False, False, True, False]),
        "clearance": np.full(4, 1.0),
        "landing_error": np.full(4, 0.2),
        "landing_w": np.array([[2.1, -0.1, 0.0], [2.3, -0.3, 0.0], [9.0, 9.0, 0.0], [0.0] * 3]),
        "duration": np.full(4, 0.8),
        "apart": np.full(4, 0.01),
    }
    figures = _summary(values, 2.0, 0.2)
    assert figures["bias"] == approx([0.2, -0.2])
    assert (figures["landed"], figures["contact"]) == (0.75, 0.25)

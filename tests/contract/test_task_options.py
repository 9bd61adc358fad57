"""Options of the task beyond the paper: moving goals, varied payloads; and flying under stated
departures from a contract.
"""

from dataclasses import replace

import numpy as np
import torch
from numpy.linalg import norm
from numpy.testing import assert_allclose
from pytest import approx, raises

from sim.hybrid import rope_variants, tether_lengths
from tests.commands import run_command
from tests.configs import load_experiment, quiet
from visthrow.common.errors import ConfigError, MismatchError
from visthrow.onboard.policy import Policy, find_policy
from visthrow.task import Experiment, TargetParams, contract_of
from visthrow.task.measurement import hover_start
from visthrow.throws.loading import load_policy
from visthrow.throws.plants import ReferenceAdapter
from visthrow.training import protocol
from visthrow.training.env import ThrowEnv

PERIOD = 0.02


def experiment(name: str, *changes: str) -> Experiment:
    return load_experiment(name, changes)


def test_goals_move_as_drawn_and_the_landing_counts_where_they_are_at_impact():
    torch.manual_seed(0)
    env = ThrowEnv(experiment("state_moving", "task.target.speed=[0.5,1.0]"), count=64)
    start, velocity = env.views.goal_w.clone(), env.goals.velocity.clone()
    speed = velocity.norm(dim=1)
    assert speed.min() >= 0.5
    assert speed.max() <= 1.0
    assert speed.std() > 0.1
    ask = torch.zeros(64, 5)
    ask[:, 4] = 1.0
    for step in range(1, 7):  # 0.11 s of lag end within the sixth period
        _, _, done, _ = env.step(ask)
        if step < 6:
            assert_allclose(env.views.goal_w, start + step * PERIOD * velocity, atol=1e-6)
    assert bool(done.all())
    landed_at = env.last["duration"]  # from the throw's start to the landing
    goal = start + landed_at[:, None] * velocity
    assert_allclose(env.last["goal_w"], goal, atol=1e-5)
    miss = (env.last["landing_w"] - goal)[:, :2].norm(dim=1)
    assert_allclose(env.last["landing_error"], miss, atol=1e-5)


def test_a_moving_goal_is_observed_late_and_its_velocity_is_learnt():
    """Without noise the actor's offset is to the goal of 10 ms ago, and the fit reaches the true
    velocity.
    """
    env = ThrowEnv(quiet("state_moving", "task.observation.latency=[0.01,0.01]"), count=32)
    hover = env.previous_action.clone()
    alive = torch.ones(32, dtype=torch.bool)
    for _ in range(12):
        obs, _, done, _ = env.step(hover)
        alive &= done == 0
    assert alive.sum() > 20
    actor, velocity = obs["actor"][alive], env.goals.velocity[alive]
    assert_allclose(
        actor[:, -2:], velocity[:, :2], rtol=0.05, atol=0.01
    )  # the prior still pulls a little
    observed = actor[:, 20:22] + actor[:, 22:24] + actor[:, :2]
    expected = (env.views.goal_w[alive] - 0.01 * velocity)[:, :2]
    assert_allclose(observed, expected, atol=1e-5)
    assert (obs["critic"][alive][:, -2:] == velocity[:, :2]).all()


def test_throws_at_moving_goals_keep_where_the_goal_was():
    loaded = load_policy("state", overrides=["task.target.speed=[0.5,0.5]"])
    throws = protocol.throw(loaded.experiment, loaded.policy.act, 1.5, 8, "cpu", 0)
    good = throws.success
    assert good.all()
    moved = norm(throws.goal_w - [1.5, 0.0], axis=1)
    assert_allclose(moved, 0.5 * throws.duration, rtol=1e-4)
    assert_allclose(norm(throws.landing_w - throws.goal_w, axis=1), throws.error, atol=1e-5)
    assert throws.summary()["error_mean"] > 0.2, (
        "a policy for goals that stand still throws to where it saw them"
    )


def test_payloads_vary_in_every_combination():
    params = experiment("state_payload")
    ropes = rope_variants(params.rope, params.task.start)
    assert len(ropes) == 6 * 5 * 5
    sizes = {
        (round(r.length, 6), round(r.payload_mass, 6), round(r.payload_drag, 9)) for r in ropes
    }
    assert len(sizes) == len(ropes)
    masses = np.array([r.payload_mass for r in ropes]) / params.rope.payload_mass
    assert (masses.min(), masses.max()) == approx((0.8, 1.2))
    gyration = [r.payload_inertia / r.payload_mass for r in ropes]
    assert_allclose(gyration, params.rope.payload_inertia / params.rope.payload_mass)
    assert [r.length for r in ropes[:6]] == [
        r.length for r in tether_lengths(params.rope, params.task.start)
    ]
    env = ThrowEnv(params, count=300)
    hanging = (env.views.out["payload_pos_w"] - env.views.state["pos_w"]).norm(dim=1)
    assert hanging.max() - hanging.min() > 0.05, "cables of 0.297 to 0.363 m"
    assert env.get_observations()["actor"].shape == (300, 35), "no input of the payload"
    assert env.get_observations()["critic"].shape == (300, 44)


def test_what_varies_in_training_varies_in_its_throws():
    start = hover_start(experiment("state_payload")).task.start
    assert (start.payload_variants, start.payload_spread, start.tether_spread) == (5, 0.2, 0.1)
    assert start.position == (0.03, 0.03, 0.03)
    with raises(ValueError, match="expected 1 or more, and 0 to below 1"):
        rope_variants(experiment("state").rope, replace(start, payload_spread=1.0))


def test_departures_are_refused_unless_allowed_and_then_named():
    change = ["vehicle.motor.time_constant=0.05", "rope.length=0.4"]
    with raises(MismatchError, match=r"rope\.length"):
        load_policy("state", "state", change, allow=["vehicle"])
    with raises(MismatchError, match=r"vehicle\.motor\.time_constant"):
        load_policy("state", "state", change, allow=["rope.length", "vehicle.motor.kind"])
    with raises(ConfigError, match=r"allow 'vehicle\.mot': .* did you mean 'vehicle\.motor'"):
        load_policy("state", allow=["vehicle.mot"])
    loaded = load_policy("state", "state", change, allow=["rope.length", "vehicle.motor"])
    assert loaded.departures == {"rope.length": 0.4, "vehicle.motor.time_constant": 0.05}
    assert load_policy("state").departures == {}
    others = [
        "camera.mount",
        "rope.payload_drag",
        "vehicle.body.com[2]",
    ]  # of vision, or at its default: a contract may have them
    assert load_policy("state", allow=others).departures == {}


def test_the_table_of_a_departing_policy_says_so(tmp_path, printed):
    command = "compare state --config state --set rope.length=0.34 --throws 2 --targets 2.0"
    command += f" --device cpu --out {tmp_path}"
    assert run_command(command) == 2
    assert "flown with rope.length = 0.34" in printed(f"{command} --allow rope")
    assert "flown with rope.length = 0.34" in (tmp_path / "compare-hybrid.md").read_text()


def test_a_field_with_a_default_enters_the_contract_only_where_it_differs():
    plain, moving = contract_of(experiment("state")), contract_of(experiment("state_moving"))
    assert "goal_velocity" not in plain["observation"]
    assert moving["observation"]["goal_velocity"] is True
    assert "payload_drag" not in plain["rope"]
    assert contract_of(experiment("state_drag"))["rope"]["payload_drag"] == approx(1.04e-3)


def test_a_policy_is_not_flown_in_wind_or_under_laws_without_allowance():
    """The shipped policies were trained without either, and fly. Laws have SI units alone, unlike
    vehicles of a class.
    """
    assert not {"air", "laws"} & contract_of(experiment("state")).keys()
    law = (
        'laws=[{block = "payload force", factors = [], vector = "cable", coefficient = 0.1}]',
        "laws[0].coefficient: trained with nothing, here 0.1",
        ["laws"],
    )
    wind = (
        "air.wind_w=[1,0,0]",
        "air.wind_w[0]: trained with nothing, here 1.0",
        ["air.wind_w"],
    )
    for name in ("state", "any"):
        load_policy(name)
        for change, message, allowed in (law, wind):
            with raises(MismatchError) as error:
                load_policy(name, overrides=[change])
            assert message in str(error.value)
            if (name, change) != ("any", law[0]):
                assert load_policy(name, overrides=[change], allow=allowed).departures


def test_an_older_policy_was_trained_in_the_wind_of_its_config(tmp_path):
    policy = Policy.load(find_policy("state"))
    trained = {**policy.made_by["config"], "air": {"wind_w": [1.0, 0.0, 0.0]}}
    path = tmp_path / "windy.npz"
    replace(policy, made_by={**policy.made_by, "config": trained}).save(path)
    assert load_policy(path).experiment.air.wind_w == (1.0, 0.0, 0.0)
    with raises(MismatchError, match=r"(?s)with 1\.0, here nothing.*--allow air\.wind_w$"):
        load_policy(path, "state")


def test_the_plain_reference_plant_has_the_drag_of_the_training_and_the_realistic_one_another():
    params = experiment("state_drag")
    assert (
        ReferenceAdapter(params, realistic=False)._plant.extras.payload_drag
        == params.rope.payload_drag
        > 0.0
    )
    assert ReferenceAdapter(experiment("state"), realistic=False)._plant.extras.payload_drag == 0.0
    assert ReferenceAdapter(params, realistic=True)._plant.extras.payload_drag == approx(1.044e-3)


def test_speeds_that_make_no_range_are_refused():
    with raises(ValueError, match="ascending range"):
        TargetParams((0.5, 0.2))


def test_a_policy_is_flown_without_what_only_its_training_had():
    """``flown`` of its configuration comes before the user's overrides; a latency within its
    training is accepted.
    """
    loaded, named = (
        load_policy("vision"),
        load_policy("vision", overrides=["camera.noise.drop_probability=0.3"]),
    )
    trained = experiment("vision")
    assert trained.camera.noise.drop_probability == 0.1
    assert loaded.experiment.camera.noise == experiment("vision_ideal").camera.noise
    assert loaded.experiment.task.observation.latency == (0.008, 0.012)
    assert (
        named.experiment.camera.noise.drop_probability,
        named.experiment.camera.noise.scale_std,
    ) == (0.3, 0.0)
    with raises(MismatchError, match="latency"):
        load_policy("vision", overrides=["task.observation.latency=[0.06,0.06]"])

"""Vehicles of a class: drawn as stated, flown in their own units, and one policy for all as an
ordinary one for each.
"""

from collections.abc import Sequence
from dataclasses import fields

import numpy as np
import torch
from numpy.testing import assert_allclose
from pytest import approx, mark, raises

from sim.params import GRAVITY, AeroParams
from sim.scaling.vehicle_class import SCALES, draw
from tests.configs import QUIET, load_experiment
from visthrow import config
from visthrow.common.errors import PolicyError
from visthrow.onboard import actions as act
from visthrow.onboard.pilot import Pilot
from visthrow.onboard.policy import Policy
from visthrow.task import Experiment, contract_of, plant_of
from visthrow.task.fleet import members, single_vehicle, specialise
from visthrow.throws.loading import load_policy
from visthrow.throws.recorded import fly
from visthrow.training.env import ThrowEnv

SAME = 3e-4
"""Of float32 numbers whose units differ, after a network that reacts to each."""

FAR = 0.12
"""Of a throw whose mean error is 0.02 m at a rope of 0.33 m."""

NAMED = ("paper", "crazyflie_brushless", "five_inch", "x500")


def experiment(*overrides: str, policy: str = "any") -> Experiment:
    return load_experiment(policy, ["fleet.count=3", *overrides])


def of(name: str, policy: str = "any", overrides: Sequence[str] = ()) -> Experiment:
    vehicle = (f'vehicle="vehicle/{name}.toml"', f'rope="rope/{name}.toml"', "fleet.count=0")
    return experiment(*vehicle, *overrides, policy=policy)


def random_policy(of: Experiment) -> Policy:
    torch.manual_seed(0)
    contract = contract_of(of)
    width = contract["observation"]["dimension"]
    mean, std = 0.3 * torch.randn(width), 0.2 + torch.rand(width)
    return Policy(
        (0.3 * torch.randn(16, width), 0.3 * torch.randn(5, 16)),
        (torch.randn(16), torch.randn(5)),
        "tanh",
        contract,
        {},
        mean,
        std,
        0.01,
    )


def test_a_vehicle_is_the_same_in_every_draw_and_another_under_another_seed():
    few, many = (
        experiment("fleet.count=2", "fleet.first=7"),
        experiment("fleet.count=5", "fleet.first=4"),
    )
    assert members(few) == members(many)[3:]
    assert (
        members(few)[0] != members(experiment("fleet.count=2", "fleet.first=7", "fleet.seed=2"))[0]
    )
    assert len({m.units.mass for m in members(many)}) == 5


def test_drawn_vehicles_lie_in_the_ranges_and_follow_size():
    base = experiment()
    fleet, known = base.fleet, plant_of(base)
    drawn = [draw(fleet, known, k) for k in range(300)]
    mass = np.array([p.vehicle.body.mass for p in drawn])
    assert fleet.mass[0] <= mass.min() < 0.04
    assert 1.5 < mass.max() <= fleet.mass[1]
    strength = np.array(
        [4 * p.vehicle.controller.max_thrust / (p.total_mass * GRAVITY) for p in drawn]
    )
    assert fleet.least_thrust - 1e-9 <= strength.min() < 6.0 < strength.max()
    size = mass / known.vehicle.body.mass
    for name, exponent, value, reference in (
        ("arm", 1 / 3, [p.vehicle.rotors.x[0] for p in drawn], known.vehicle.rotors.x[0]),
        (
            "thrust",
            1.0,
            [p.vehicle.controller.max_thrust for p in drawn],
            known.vehicle.controller.max_thrust,
        ),
        (
            "motor_lag",
            1 / 6,
            [p.vehicle.motor.time_constant for p in drawn],
            known.vehicle.motor.time_constant,
        ),
        ("rope", 1 / 3, [p.rope.length for p in drawn], known.rope.length),
        ("delay", 0.0, [p.vehicle.queue.delay for p in drawn], 1.0),
        ("lag", 0.0, [p.release.lag for p in drawn], 1.0),
    ):
        factor, (low, high) = np.array(value) / reference / size**exponent, getattr(fleet, name)
        near = 0.15 * (high - low)  # both ends are reached
        assert low * (1 - 1e-9) <= factor.min() < low + near, name
        assert high - near < factor.max() <= high * (1 + 1e-9), name
    with_drag = {path for path, factors in SCALES["vehicle"].items() if factors == "drag"}
    assert with_drag == {f"aero.{f.name}" for f in fields(AeroParams) if f.name != "kind"}


def test_the_environment_flies_every_vehicle_with_its_limits_and_reports_them():
    env = ThrowEnv(experiment("task.start.tether_variants=2"), "cpu", seed=1, count=12)
    drawn, given_setup = members(env.cfg), env.get_observations()["actor"][:, -4:]
    for e in range(12):
        member = drawn[e % 6 // 2]
        assert given_setup[e].tolist() == approx(member.given_setup, rel=1e-6)
        assert (
            float(env.delay.age[e]) * member.units.time
            <= env.cfg.task.observation.latency[1] + 1e-6
        )
    env.carry(torch.ones(12, 5))
    queued = env.views.command[:, 0]
    for e in range(12):
        most = drawn[e % 6 // 2].max_thrust
        assert float(queued[e]) == approx(most, rel=0.15), "five deviations of the commands' noise"


@mark.parametrize("kind", ["any", "any_vision"])
@mark.parametrize("name", NAMED)
def test_a_pilot_decides_in_si_units_what_the_policy_decides_in_the_vehicles(name, kind):
    base = of(name, kind, [*QUIET, "task.start.mass=0.0", "task.start.tether_variants=1"])
    policy, env = random_policy(base), ThrowEnv(base, "cpu", seed=1, count=4)
    specialist, one = specialise(policy, base)
    pilot, units = (
        Pilot(specialist, one.camera if kind == "any_vision" else None, 4),
        members(base)[0].units,
    )
    assert pilot.period == approx(0.02 * units.time)
    assert specialist.total_mass == approx(plant_of(base).total_mass)
    most, rates = members(base)[0].max_thrust, torch.tensor(base.task.action.max_rate)
    shown = env.get_observations()["actor"]
    for _ in range(15):
        action = policy.act(shown)
        state, size = {k: v.numpy() for k, v in env.views.state.items()}, units.length
        payload, goal = (
            env.views.out["payload_pos_w"].numpy() * size,
            env.views.goal_w.numpy() * size,
        )
        out = pilot.act(
            state["pos_w"] * size,
            state["quat_wb"],
            state["vel_w"] * size / units.time,
            state["rate_b"] / units.time,
            payload,
            goal,
        )
        assert_allclose(out.action, act.clip_action(action).numpy(), atol=SAME)
        command = act.command_from_action(torch.from_numpy(out.action), most, rates)
        assert_allclose(out.command[:, 0], command[:, 0] * units.size((1, 1, -2)), rtol=SAME)
        assert_allclose(out.command[:, 1:], command[:, 1:] / units.time, rtol=SAME, atol=SAME)
        shown = env.carry(action)["actor"]
    assert one.rope.length == plant_of(base).rope.length


def test_one_vehicles_experiment_is_the_same_task_at_its_size():
    one = single_vehicle(of("x500"))
    size, usual = 0.8 / 0.33, load_experiment("any")
    assert one.fleet is None
    assert one.task.observation.setup == "none"
    assert one.task.bounds.horizontal == approx(usual.task.bounds.horizontal * size)
    assert one.release.landing_height == approx(usual.release.landing_height * size)
    assert one.release.lag == approx(usual.release.lag)
    assert one.sim.control_period == approx(0.02 * np.sqrt(size))
    assert one.task.action.max_thrust == approx(4 * one.vehicle.controller.max_thrust)
    assert config.loads(Experiment, config.dumps(one)) == one


def test_a_policy_of_one_vehicle_is_not_specialised():
    base = load_experiment("state")
    with raises(
        PolicyError, match="for one vehicle; expected a policy that was trained for a fleet"
    ):
        specialise(random_policy(base), of("x500"))


def test_the_shipped_policy_throws_with_a_named_vehicle_through_the_pilot(tmp_path):
    vehicle = ['vehicle="vehicle/x500.toml"', 'rope="rope/x500.toml"']
    loaded = load_policy("any", overrides=vehicle)
    size = loaded.experiment.rope.length / 0.33
    log = fly(loaded, [2.0 * size, 0.0, 0.0])
    assert log.meta["result"]["success"]
    assert log.meta["result"]["error"] < FAR * size
    loaded.policy.save(tmp_path / "own.npz")  # an ordinary policy, which hil takes
    again = load_policy(tmp_path / "own.npz")
    assert again.experiment == loaded.experiment
    assert Pilot(again.policy).period == loaded.experiment.sim.control_period


def test_ranges_that_nothing_can_be_drawn_from_are_refused():
    with raises(
        config.ConfigError,
        match=r"fleet\.mass is 2\.0 to 0\.03; expected an ascending range above 0",
    ):
        experiment("fleet.mass=[2.0, 0.03]")
    with raises(config.ConfigError, match=r"fleet\.count is -1"):
        experiment("fleet.count=-1")

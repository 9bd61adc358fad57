"""Solvers behind the exchange: they end the hard throw where the fused chain does, and fly, let go
and start anew as it does; closed forms of a box and of two cables."""

import contextlib
import gc
import importlib.util
import math
import sys
import weakref
from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace

import numpy as np
import warp as wp
from numpy.linalg import norm
from numpy.testing import assert_allclose
from pytest import approx, importorskip, mark, param, raises

from sim.hybrid import HybridSim, tether_lengths
from sim.kernels.state import NONFINITE
from sim.params import GRAVITY, LawParams, PlantParams, change_values
from sim.solvers.mujoco import _make_on_gpu
from tests.configs import load_experiment
from tests.contract.test_simulator_bits import assert_same, state_of
from tests.plants import EVERYTHING, SCENES, paper_plant
from tests.scenes import load_scene
from tests.simulators import Flight, fly
from visthrow.cli import build_parser
from visthrow.common.errors import ConfigError
from visthrow.task import plant_of
from visthrow.throws.loading import load_policy
from visthrow.throws.plants import HybridPlant

SCENE = load_scene(SCENES / "hard_throw.toml")
needs_physx = mark.skipif(
    importlib.util.find_spec("ovphysx") is None, reason="PhysX is not installed: make physx"
)
PHYSX = param("physx", 0.002, 0.012, marks=needs_physx)
SOLVERS = [("exchanged_chain", 0.002, 0.002), ("mujoco_warp", 0.0005, 0.001), PHYSX]
"""Name, substep [s], and how far a second of random flight may end from the fused chain [m]; PhysX
is of first order. A separation within a substep frees the vehicle at its end only."""


def use_solver(plant: PlantParams, solver: str, substep: float) -> PlantParams:
    """The plant with its bodies in a solver."""
    numerics = replace(plant.sim, solver=solver, substep=substep)
    return replace(plant, sim=numerics)


@lru_cache
def run_converged() -> Flight:
    """The fused chain's hard throw at a fine step."""
    return fly(SCENE, 2e-4, "float32", 0.02, "chain")


def measure_distance(solver: str, substep: float) -> float:
    """How far a solver ends the hard throw from the fused chain's converged run [m]."""
    end, truth = fly(SCENE, substep, "float32", 0.02, solver), run_converged()
    ball, vehicle = norm(end.ball_pos_w - truth.ball_pos_w), norm(end.pos_w - truth.pos_w)
    return max(float(ball), float(vehicle))


def test_the_exchange_costs_the_chain_no_accuracy():
    """Measured 0.15 mm of the ball and 0.22 mm of the vehicle, fused and exchanged alike."""
    exchanged, fused = (measure_distance(name, 2e-3) for name in ("exchanged_chain", "chain"))
    assert exchanged == approx(fused, abs=2e-5)
    assert exchanged < 4e-4


def test_mujoco_ends_the_hard_throw_at_the_same_place():
    """RK4 has converged at 0.5 ms; measured 0.024 mm."""
    assert measure_distance("mujoco_warp", 5e-4) < 1e-4


@needs_physx
def test_physx_converges_onto_the_chain():
    """First order in its step; measured 8.1 and 2.0 mm."""
    coarse, fine = (measure_distance("physx", step) for step in (2e-3, 5e-4))
    assert coarse < 0.01
    assert coarse / fine == approx(4.0, rel=0.15)


def fly_random(solver: str, substep: float, count: int = 12, device: str = "cpu") -> HybridSim:
    """Random vehicles and ropes, a second of drawn commands, and releases on the way."""
    experiment = load_experiment("state")
    plant = use_solver(plant_of(experiment), solver, substep)
    lag = replace(plant.release, lag=0.1113)  # within a substep
    plant, spreads = replace(plant, release=lag), experiment.task.start
    sim = HybridSim(plant, count, device, 4, ropes=tether_lengths(plant.rope, spreads))
    sim.randomize(spreads)
    rng, weight = np.random.default_rng(5), GRAVITY * plant.total_mass
    for k in range(50):
        rates = rng.uniform(-2.0, 2.0, (count, 3))
        command = np.column_stack([weight * rng.uniform(0.7, 1.5, count), rates])
        sim.set_command(command, 4 * np.arange(count) == k)
        sim.step()
    return sim


@mark.parametrize(("solver", "substep", "near"), SOLVERS)
def test_a_solver_flies_and_lets_go_as_the_fused_chain_does(solver, substep, near):
    """Masses, cable lengths, batteries, latch and lag of each environment are the same: a
    twentieth more mass alone would move a vehicle by half a metre."""
    ours, theirs = fly_random("chain", 0.002), fly_random(solver, substep)
    for name in ("attached", "release_timer", "separation_time", "mass_scale"):
        assert_allclose(theirs.get(name), ours.get(name), atol=1e-5, err_msg=name)
    for name in ("pos_w", "payload_pos_w", "landing_w", "release_pos_w"):
        assert_allclose(theirs.get(name), ours.get(name), atol=near, err_msg=name)
    assert_allclose(theirs.get("voltage"), ours.get("voltage"), atol=1e-3)


@mark.parametrize(("solver", "substep", "near"), [("chain", 0.002, 0.0), *SOLVERS])
def test_what_is_masked_or_broken_is_put_back(solver, substep, near):
    """One environment stands still, another's velocity is no number: the third flies as ever."""
    sims = [HybridSim(use_solver(paper_plant(), solver, substep), 3) for _ in range(2)]
    sick, well = sims
    velocity = np.zeros((3, 3), np.float32)
    velocity[1] = np.nan
    sick.state.vel_w.assign(velocity)
    sick.adopt()
    for sim in sims:
        sim.set_command(np.full((3, 4), [3.0, 0.5, -0.2, 0.1]))
    mask = wp.array([0, 1, 1], dtype=wp.int32)
    states = []
    for _ in range(3):
        sick.step(mask)
        well.step()
        states.append(state_of(sick))
    assert sick.get("status").tolist() == [0, NONFINITE, 0]
    assert_same(states[2], states[0], 0, 0)
    assert_same(states[2], state_of(well), 2, 2)
    sick.place(np.zeros((3, 3)))
    sick.step()
    assert not sick.get("status").any()


@mark.parametrize(("solver", "substep", "near"), SOLVERS)
def test_what_stood_still_flies_on_from_the_same_state(solver, substep, near):
    sim = HybridSim(use_solver(paper_plant(), solver, substep), 2)
    sim.set_command(np.zeros((2, 4)))
    for _ in range(5):
        sim.step(wp.array([1, 0], dtype=wp.int32))
    first = sim.get("vel_w")[0]
    for _ in range(5):
        sim.step()
    assert first[2] < -0.5
    assert_allclose(sim.get("vel_w")[1], first, atol=1e-3)


def hang_payload(name: str, **vehicle) -> HybridSim:
    """A payload of ``configs/rope`` on a vehicle without blocks, whose command is a wrench."""
    experiment = load_experiment(f"state_{name}")
    plant = use_solver(plant_of(experiment), "mujoco_warp", 0.00025)
    body = replace(plant.vehicle.body, **vehicle)
    controller = plant.vehicle.controller
    strong = replace(controller, max_thrust=max(controller.max_thrust, GRAVITY * body.mass))
    without = replace(plant.vehicle, body=body, controller=strong)
    return HybridSim(replace(plant, vehicle=without), 1, direct=True)


@mark.parametrize("name", ["box", "two_cables", "rod_gripper"])
def test_other_payloads_hang_where_the_geometry_says(name):
    """They weigh what they should: a vehicle with a thrust of the total weight stays."""
    sim = hang_payload(name)
    rope, weight = sim.params.rope, GRAVITY * sim.params.total_mass
    for _ in range(25):
        sim.set_command([[weight, 0.0, 0.0, 0.0]])
        sim.step()
    assert_allclose(sim.get("pos_w"), 0.0, atol=2e-3)
    below = sim.get("pos_w")[0, 2] + rope.mount[2] - sim.get("payload_pos_w")[0, 2]
    assert below == approx(rope.length + rope.payload_offset, abs=2e-3)


def test_two_cables_turn_as_a_bifilar_pendulum():
    """omega^2 = m g d^2 / (4 I L) for a small turn about the vertical, the mount held still by its
    own inertia.
    """
    sim = hang_payload("two_cables", mass=1e4, inertia=(1e2, 1e2, 1e2))
    solver, turn, angles = sim._exchange.solver, 0.05, []
    solver.qpos.numpy()[0, 10:14] = math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)
    solver._placed(sim._all)
    for _ in range(100):
        sim.set_command([[GRAVITY * sim.params.total_mass, 0.0, 0.0, 0.0]])
        sim.step()
        quat = solver.qpos.numpy()[0, 10:14]
        angles.append(2.0 * math.atan2(quat[3], quat[0]))
    angle, time = np.array(angles), 0.02 * np.arange(1, 101)
    before = np.flatnonzero(np.diff(np.sign(angle)) != 0)
    crossings = time[before] + 0.02 * angle[before] / (angle[before] - angle[before + 1])
    rope = sim.params.rope
    inertia = rope.payload_mass / 12.0 * (rope.payload_sides[0] ** 2 + rope.payload_sides[1] ** 2)
    stiff = rope.payload_mass * GRAVITY * rope.cables_apart**2
    expected = math.sqrt(stiff / (4.0 * inertia * rope.length))
    assert math.pi / np.diff(crossings).mean() == approx(expected, rel=0.02)


def test_a_cable_pulls_or_is_slack():
    """Under thrust the cables are as long as they are; a vehicle that is pushed down falls faster
    than the box."""
    sim = hang_payload("two_cables")
    reach = sim.params.rope.length + sim.params.rope.payload_offset - sim.params.rope.mount[2]
    weight = GRAVITY * sim.params.total_mass
    for thrust, slack in ((1.5 * weight, False), (-0.75 * weight, True)):
        for _ in range(8):
            sim.set_command([[thrust, 0.0, 0.0, 0.0]])
            sim.step()
        apart = norm(sim.get("pos_w") - sim.get("payload_pos_w"))
        assert (apart < reach - 0.01) if slack else apart == approx(reach, abs=3e-3)


@mark.gpu
@mark.parametrize(("solver", "substep", "near"), SOLVERS)
def test_a_solver_flies_on_a_gpu_as_the_fused_chain_does(solver, substep, near):
    if solver == "mujoco_warp":
        importorskip("mujoco_warp")
    ours, theirs = (
        fly_random(*build, device="cuda:0") for build in (("chain", 0.002), (solver, substep))
    )
    for name in ("pos_w", "payload_pos_w", "landing_w"):
        assert_allclose(theirs.get(name), ours.get(name), atol=near, err_msg=name)


def test_what_a_solver_cannot_hold_is_refused():
    box = plant_of(load_experiment("state_box"))
    with raises(ValueError, match=r"payload_sides is .*'mujoco_warp'"):
        HybridSim(use_solver(box, "chain", 0.002), 1)
    plant = paper_plant()
    giving = replace(plant.rope, compliance=1e-3)
    with raises(ValueError, match="'exchanged_chain' with compliance"):
        HybridSim(replace(use_solver(plant, "exchanged_chain", 0.002), rope=giving), 1)
    in_joint = (LawParams("rope joint", (), "joint_rate", 1e-3),)
    with raises(ValueError, match="law on the rope's joint"):
        HybridSim(replace(use_solver(plant, "exchanged_chain", 0.002), laws=in_joint), 1)
    exact = use_solver(plant, "mujoco_warp", 0.002)
    exact = replace(exact, sim=replace(exact.sim, precision="float64"))
    with raises(ValueError, match="precision 'float64'; expected 'float32'"):
        HybridSim(exact, 1)
    with raises(ValueError, match="half the height of the box"):
        replace(plant.rope, payload_sides=(0.1, 0.1, 0.1))
    with raises(ValueError, match=r"expected a box .* and no gripper"):
        replace(plant.rope, cables_apart=0.06)


def test_the_command_line_and_the_configuration_choose_the_solver():
    args = build_parser().parse_args(["compare", "--solver", "physx", "--set", "rope.length=0.4"])
    assert args.overrides == ["sim.solver=physx", "rope.length=0.4"]
    with raises(ConfigError, match=r"solver.*exchanged_chain"):
        load_policy("state", None, ["sim.solver=bullet"])


def test_a_vehicle_that_is_held_is_held_in_the_solver_too():
    """Put back after each step, it falls anew every time: 2 mm in a period."""
    experiment = load_policy("state", None, ["sim.solver=exchanged_chain"]).experiment
    plant = HybridPlant(experiment)
    stand = plant.hold()
    for _ in range(5):
        plant.step(np.zeros((1, 4)))
        plant.hold(stand)
    plant.step(np.zeros((1, 4)))
    assert stand["pos_w"][0, 2] - plant.state.pos_w[0, 2] < 0.005


def test_the_last_rod_carries_the_ball():
    """Against a thousand pieces of the rod."""
    rope = replace(paper_plant().rope, rope_mass=0.05, payload_inertia=3e-5)
    pieces, share = 1000, rope.segment_mass / 1000
    heights = -rope.segment_length * (np.arange(pieces) + 0.5) / pieces
    heights = np.append(heights, -rope.segment_length - rope.payload_offset)
    masses = np.append(np.full(pieces, share), rope.payload_mass)
    centre = np.average(heights, weights=masses)
    inertia = masses @ (heights - centre) ** 2 + rope.payload_inertia
    assert rope.rod(True) == approx((masses.sum(), -centre, inertia), rel=1e-5)


@mark.parametrize("drag", [0.0, 0.05])
def test_a_rope_far_to_the_side_swings_on_as_it_was_placed(drag):
    """Where a hinge's rate is twice the rod's; with the payload's drag."""
    plant = paper_plant()
    rope = replace(plant.rope, payload_drag=drag)
    plant = replace(plant, rope=rope)
    segments, tilt = plant.rope.segments, math.radians(60.0)
    direction = np.tile([0.0, math.sin(tilt), -math.cos(tilt)], (1, segments, 1))
    rate = np.tile([6.0, 0.0, 0.0], (1, segments, 1))
    level = np.array([[0.0, 0.0, 0.0, 1.0]])
    exact = change_values(use_solver(plant, "chain", 5e-4), {"sim.precision": "float64"})
    chain = HybridSim(exact, 1, extensions=EVERYTHING)
    velocities = []
    for sim in (chain, HybridSim(use_solver(plant, "mujoco_warp", 5e-4), 1)):
        sim.place(np.zeros((1, 3)), level, np.zeros((1, 3)), np.zeros((1, 3)), direction, rate)
        for _ in range(5):
            sim.step()
        velocities.append(sim.get("payload_vel_w"))
    assert_allclose(velocities[1], velocities[0], atol=0.01)


def test_mujoco_warps_model_lives_as_long_as_the_graph_that_reads_it(monkeypatch):
    class Model:
        body_mass = None

    def put_model(*_args, **_options) -> Model:
        model = Model()
        made.append(weakref.ref(model))
        return model

    made: list = []
    data = SimpleNamespace(qpos=None, qvel=None, ctrl=None)
    engine = SimpleNamespace(
        put_model=put_model, make_data=lambda *_, **__: data, step=lambda *_: 0
    )
    monkeypatch.setitem(sys.modules, "mujoco_warp", engine)
    for name in ("ScopedDevice", "ScopedStream", "ScopedCapture", "Stream", "synchronize_device"):
        capture = contextlib.nullcontext(SimpleNamespace(graph=None))
        monkeypatch.setattr(wp, name, lambda *_, _made=capture, **__: _made)
    parts = _make_on_gpu(None, {}, 1, "cuda:0")
    gc.collect()
    assert made[0]() is not None, parts

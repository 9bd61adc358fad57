"""Equal bits: alone or in a batch, from a graph or launched, after a masked reset, from one seed or
parameter.
"""

from dataclasses import replace

import numpy as np
import warp as wp
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal
from pytest import mark

from sim.hybrid import HybridSim
from sim.kernels.state import NONFINITE, OUTPUT_FIELDS, STATE_FIELDS
from sim.params import BodyParams
from tests.plants import paper_plant
from tests.simulators import bare_quadrotor, random_commands
from visthrow.task import load_experiment

COUNT = 5
STEPS = 12
RELEASED = 4
"""Step at which some environments get the release command."""


def start_spreads():
    return load_experiment("state").task.start


def state_of(sim: HybridSim) -> dict[str, np.ndarray]:
    """Every state array."""
    return {name: sim.get(name) for name in STATE_FIELDS}


def everything(sim: HybridSim) -> dict[str, np.ndarray]:
    """Every state and output array."""
    return state_of(sim) | {name: sim.get(name) for name in OUTPUT_FIELDS}


def assert_same(a: dict, b: dict, rows=slice(None), other=slice(None)) -> None:
    for name, value in a.items():
        assert_array_equal(value[rows], b[name][other], err_msg=name)


def vehicles(count: int) -> list:
    """Vehicles of different masses."""
    vehicle = paper_plant().vehicle
    masses = vehicle.body.mass * (1.0 + 0.02 * np.arange(count))
    return [replace(vehicle, body=BodyParams(float(m), vehicle.body.inertia)) for m in masses]


def ropes(count: int) -> list:
    rope = paper_plant().rope
    return [replace(rope, length=rope.length * (1.0 + 0.01 * k)) for k in range(count)]


def poses(seed: int, count: int) -> dict[str, np.ndarray]:
    """Random starts: bent ropes, tilted vehicles."""
    rng = np.random.default_rng(seed)
    segments = paper_plant().rope.segments
    directions = np.array([0.0, 0.0, -1.0]) + 0.4 * rng.normal(size=(count, segments, 3))
    directions /= norm(directions, axis=-1, keepdims=True)
    swing = np.cross(rng.normal(size=(count, segments, 3)), directions)
    quat = np.array([0.0, 0.0, 0.0, 1.0]) + 0.2 * rng.normal(size=(count, 4))
    return {
        "pos_w": rng.normal(size=(count, 3)),
        "quat_wb": quat / norm(quat, axis=-1, keepdims=True),
        "vel_w": rng.normal(size=(count, 3)),
        "rate_b": rng.normal(size=(count, 3)),
        "cable_dir_w": directions,
        "cable_vel_w": swing,
    }


def drive(sim: HybridSim, commands: np.ndarray, release: np.ndarray | None = None) -> None:
    for k, command in enumerate(commands):
        sim.set_command(command, None if release is None else release * (k >= RELEASED))
        sim.step()


def test_a_batch_equals_its_members_alone(monkeypatch):
    monkeypatch.setattr("sim.hybrid.FEWEST", 1)  # several launches of the batch
    start, commands = poses(0, COUNT), random_commands(0, STEPS, COUNT)
    release = np.arange(COUNT) % 2
    batch = HybridSim(paper_plant(), COUNT, vehicles=vehicles(COUNT), ropes=ropes(COUNT), threads=2)
    batch.place(**start)
    drive(batch, commands, release)
    assert batch.get("attached").tolist() == (1 - release).tolist()
    whole = everything(batch)
    for e in range(COUNT):
        alone = HybridSim(
            paper_plant(), 1, vehicles=vehicles(COUNT)[e : e + 1], ropes=ropes(COUNT)[e : e + 1]
        )
        alone.place(**{k: v[e : e + 1] for k, v in start.items()})
        drive(alone, commands[:, e : e + 1], release[e : e + 1])
        assert_same(everything(alone), whole, slice(None), slice(e, e + 1))


def test_parameters_differ_between_environments():
    """Environment e takes entry e modulo the list's length."""
    sim = HybridSim(paper_plant(), 4, ropes=ropes(2))
    reach = -sim.get("payload_pos_w")[:, 2]
    assert reach[0] == reach[2] < reach[1] == reach[3]


def test_a_graph_equals_launches():
    start, commands = poses(2, COUNT), random_commands(2, STEPS, COUNT)
    eager, graphed = HybridSim(paper_plant(), COUNT), HybridSim(paper_plant(), COUNT)
    spreads = start_spreads()
    for sim in (eager, graphed):
        sim.place(**start)
    mask = wp.array(np.array([1, 0, 0, 1, 0], dtype=np.int32), device="cpu")
    graphed.randomize(spreads, mask)  # the first call uploads the spreads, which a graph may not
    eager.randomize(spreads, mask)
    with wp.ScopedCapture(device="cpu") as capture:
        graphed.step()
        graphed.step()
        graphed.randomize(spreads, mask)
    assert_same(everything(eager), everything(graphed))
    for command in commands:
        for sim in (eager, graphed):
            sim.set_command(command, np.ones(COUNT))
        eager.step()
        eager.step()
        eager.randomize(spreads, mask)
        wp.capture_launch(capture.graph)
        assert_same(everything(eager), everything(graphed))
    assert_array_equal(eager.goal_w.numpy(), graphed.goal_w.numpy())


def test_a_masked_reset_leaves_the_rest():
    sim = HybridSim(paper_plant(), COUNT)
    sim.place(**poses(3, COUNT))
    drive(sim, random_commands(3, STEPS, COUNT), np.arange(COUNT) % 2)
    before, goals = everything(sim), np.array(sim.goal_w.numpy())
    mask = np.array([0, 1, 0, 0, 1], dtype=np.int32)
    sim.randomize(start_spreads(), wp.array(mask, device="cpu"))
    kept, fresh = mask == 0, mask == 1
    assert_same(everything(sim), before, kept, kept)
    assert_array_equal(sim.goal_w.numpy()[kept], goals[kept])
    assert np.all(np.any(sim.get("pos_w")[fresh] != before["pos_w"][fresh], axis=-1))
    assert np.all(sim.get("attached")[fresh] == 1)
    assert np.all(sim.get("release_timer")[fresh] < 0.0)
    assert np.all(sim.get("status")[fresh] == 0)


def test_a_reset_leaves_nothing_of_the_last_episode():
    """An environment that is reset after a wild flight equals a fresh one to the bit."""
    used, fresh = (HybridSim(paper_plant(), COUNT, seed=7) for _ in range(2))
    drive(used, random_commands(4, STEPS, COUNT), np.ones(COUNT))
    start, commands = poses(5, COUNT), random_commands(5, STEPS, COUNT)
    for sim in (used, fresh):
        sim.place(**start)
    assert_same(state_of(used), state_of(fresh))
    for sim in (used, fresh):
        drive(sim, commands)
    assert_same(state_of(used), state_of(fresh))


def test_the_queue_holds_hover_after_a_reset():
    sim = HybridSim(paper_plant(), COUNT)
    drive(sim, random_commands(6, STEPS, COUNT))
    assert np.any(sim.get("queue")[..., 1:])
    sim.randomize(start_spreads())
    queue = sim.get("queue")
    assert not np.any(queue[..., 1:])
    plant = paper_plant()
    load = plant.rope.rope_mass + plant.rope.payload_mass
    weight = 9.81 * (plant.vehicle.body.mass * sim.get("mass_scale") + load)
    assert_allclose(queue[..., 0], np.tile(weight[:, None], (1, queue.shape[1])), rtol=1e-6)


def test_draws_do_not_depend_on_the_batch():
    large, small = HybridSim(paper_plant(), COUNT, seed=3), HybridSim(paper_plant(), 2, seed=3)
    for sim in (large, small):
        sim.randomize(start_spreads())
    assert_same(everything(small), everything(large), slice(None), slice(0, 2))


@mark.parametrize("place", range(4))
def test_a_bad_command_raises_a_bit_and_does_not_spread(place):
    """NaN in one environment: its bit is set, its last command is held, others are unchanged."""
    sick, well = HybridSim(paper_plant(), 3), HybridSim(paper_plant(), 3)
    command = np.tile([4.0, 1.0, 0.5, 0.0], (3, 1))
    bad = command.copy()
    bad[1, place] = np.nan
    for k in range(5):
        sick.set_command(bad if k in (1, 2) else command)
        well.set_command(command)
        sick.step()
        well.step()
        assert sick.get("status").tolist() == [0, NONFINITE if k in (1, 2) else 0, 0]
    assert_same(everything(sick), everything(well))


@mark.parametrize("kind", ["hybrid", "alone"])
@mark.parametrize(
    "name", ["setpoint", "gyro", "integral", "motor_speed", "voltage", "charge_used", "rate_b"]
)
def test_no_part_of_the_state_may_be_bad(kind, name):
    sim = HybridSim(paper_plant(), 2) if kind == "hybrid" else quad(2)
    value = sim.get(name)
    value[0] = np.nan
    getattr(sim.state, name).assign(value)
    sim.step()
    assert sim.get("status").tolist() == [NONFINITE, 0]


def quad(count: int) -> HybridSim:
    return bare_quadrotor(paper_plant().vehicle, count)


def test_a_quadrotor_in_a_batch_flies_as_alone():
    commands = random_commands(8, STEPS, COUNT)
    batch, alone = quad(COUNT), quad(1)
    drive(batch, commands)
    drive(alone, commands[:, 3:4])
    assert_same(state_of(alone), state_of(batch), 0, 3)

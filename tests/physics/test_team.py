"""Several vehicles on one load: a single vehicle's chain, releases."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
from pytest import approx

from sim.hybrid import HybridSim
from sim.params import PlantParams
from tests.plants import paper_plant
from visthrow.common.free_fall import fall_time, free_flight
from visthrow.cooperative.team_sim import TeamSim

SECOND_ORDER = 1e-3
"""Of two second-order integrators at 2 ms over 0.6 s of hard flight [m]; both were 0.3 mm off."""
TILT = np.radians(35.0)


def plant(share: float = 0.075, segments: int = 5) -> PlantParams:
    base = paper_plant()
    rope = replace(
        base.rope,
        segments=segments,
        length=0.5,
        payload_mass=share,
        payload_offset=0.0,
        payload_inertia=0.0,
        joint_damping=0.0,
    )
    return replace(base, rope=rope)


def around(team: int) -> np.ndarray:
    """Directions from the mounts to the load, shape (1, V, 3)."""
    angle = 2.0 * np.pi * np.arange(team) / team
    side = -np.sin(TILT)
    down = np.full(team, -np.cos(TILT))
    return np.stack([side * np.cos(angle), side * np.sin(angle), down], -1)[None]


def hang_level(params: PlantParams, directions: np.ndarray, **options) -> TeamSim:
    """Level vehicles where straight cables lead from the load to them, all moving alike."""
    rope, team = params.rope, directions.shape[1]
    sim = TeamSim(params, 1, team, threads=1, **options)
    sim.place(
        np.array([0.0, 0.0, 1.0]) - rope.length * directions[0] - rope.mount,
        vel_w=np.tile([0.3, -0.2, 0.1], (team, 1)),
        cable_dir_w=np.repeat(directions[0][:, None], rope.segments, axis=1),
    )
    return sim


def commands(steps: int, rows: int) -> np.ndarray:
    """Thrust [N] and rates [rad/s] that swing the load hard, the same for all."""
    time = 0.02 * np.arange(steps)
    one = [2.9 * (1.0 + 0.7 * np.sin(9.0 * time)), 2.0 * np.sin(5.0 * time)]
    one += [4.0 * np.sin(7.0 * time), np.full(steps, 0.5)]
    return np.repeat(np.stack(one, -1)[:, None], rows, axis=1)


def test_one_vehicle_is_the_fused_chain():
    params = plant()
    team, single = hang_level(params, np.array([[[0.0, 0.0, -1.0]]])), HybridSim(params, 1)
    single.place(team.get("pos_w"), vel_w=team.get("vel_w"))
    for command in commands(30, 1):
        for sim in (team, single):
            sim.set_command(command)
            sim.step()
    moved = np.abs(single.get("payload_pos_w") - [0.0, 0.0, 1.0]).max()
    assert moved > 0.2
    assert_allclose(team.load[0].numpy(), single.get("payload_pos_w"), atol=SECOND_ORDER)
    assert_allclose(team.get("pos_w"), single.get("pos_w"), atol=SECOND_ORDER)


def test_each_end_goes_after_its_lag_and_the_last_one_makes_the_landing():
    params = plant()
    late = replace(params.release, lag=params.release.lag + 0.03)
    sim = hang_level(params, around(2), releases=[params.release, late])
    gone = {}
    for k, command in enumerate(commands(12, 2)):
        sim.set_command(command, np.full(2, k == 2))
        before = sim.load[1].numpy().copy()
        sim.step()
        for row in np.flatnonzero(sim.get("separated")):
            gone[row] = 0.02 * k + sim.get("separation_time")[row]
        after = sim.load[1].numpy()
        if len(gone) == 2:
            break
        assert np.abs(after - before).max() < 2.0  # no jump at the first separation
    assert gone[0] == approx(0.04 + params.release.lag, abs=1e-5)
    assert gone[1] == approx(0.04 + late.lag, abs=1e-5)
    pos, vel = (array.numpy()[0].astype(float) for array in sim.load)
    landing = free_flight(pos, vel, fall_time(pos[2] - params.release.landing_height, vel[2]))
    assert_allclose(sim.get("landing_w")[1], landing, atol=1e-4)
    assert np.abs(sim.get("landing_w")[0] - landing).max() > 0.01

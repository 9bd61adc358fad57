"""Worlds without a hidden effect move as the simulator does."""

from dataclasses import replace

import numpy as np
from numpy.linalg import norm
from pytest import mark, param

from bench.worlds.fly import fly
from bench.worlds.numbers import nominal
from bench.worlds.pilot import Throw, Tracker
from sim.hybrid import HybridSim
from tests.plants import paper_plant

AGREEMENT = {
    "rod": 1e-5,  # the same equations for one rod, solved otherwise; RK4 at 0.5 ms
    "string": (
        2e-4
    ),  # 24 point masses stand for 24 slender rods; a hard throw bends them differently
    "chain": 3e-4,  # MuJoCo at 0.5 ms, actuators by the midpoint rule
}
"""Largest distance to the simulator at 0.25 ms [m], vehicle or ball, until the separation of a hard
throw.
"""


@mark.parametrize("plant", ["rod", *(param(name, marks=mark.slow) for name in ("string", "chain"))])
def test_a_world_without_effect_moves_as_the_simulator(plant):
    rng = np.random.default_rng(0)
    throws = [Throw(rng, speed, heading) for speed, heading in ((7.0, 0.4), (11.0, -2.0))]
    world = nominal()
    world.ball_inertia = 0.0 if plant == "string" else world.ball_inertia
    pilot = Tracker(throws, world.mass, world.ball_mass + world.rope_mass, rng)
    flown = fly(plant, [world] * 2, pilot.command, throws, 1.9, (0.0, 0.0, 0.0), 0, np.full(2, 0.1))

    params = paper_plant()
    segments = {"rod": 1, "string": 24, "chain": 15}[plant]
    rope = replace(params.rope, segments=segments, payload_inertia=max(world.ball_inertia, 1e-9))
    numerics = replace(params.sim, substep=2.5e-4, precision="float64")
    sim = HybridSim(replace(params, rope=rope, sim=numerics), 2)
    sim.place(np.array([throw.at(0.0)[0] for throw in throws]), battery_used=0.1)
    worst = 0.0
    for k in range(flown.commands.shape[1]):
        sim.set_command(flown.commands[:, k], flown.release_at <= k * 0.02 + 1e-9)
        sim.step()
        hangs = sim.get("attached") != 0
        now = (k + 1) * 20
        both = np.maximum(
            norm(sim.get("pos_w") - flown.pos[:, now], axis=1),
            norm(sim.get("payload_pos_w") - flown.ball[:, now], axis=1),
        )
        worst = max([worst, *both[hangs]])
    assert 0.0 < worst < AGREEMENT[plant]
    np.testing.assert_allclose(flown.separated_at - flown.release_at, 0.11, atol=1e-9)

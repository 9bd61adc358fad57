"""The whole simulator against the whole reference plant: queue, blocks, rope and release together.

The reference shares the equations and no code: float64 NumPy and MuJoCo's rope without twist, RK4.
"""

from dataclasses import replace

import numpy as np
from numpy.linalg import norm

from sim.hybrid import HybridSim
from sim.params import PlantParams, QueueParams
from sim.reference.plant import ReferencePlant
from tests.plants import paper_plant
from tests.simulators import numerics, random_commands

COUNT, STEPS, ASKED_AT = 6, 25, 12
"""Environments; control steps; step at which every second one asks for the release."""
LAG = 0.1037
SEGMENTS = 5
"""A third of the paper's, for the reference's time; `test_chain_oracle` flies all."""
WITHIN, SUBSTEP = 1e-4, 5e-4
"""After half a second of full-range commands [m]: measured 0.035 mm at this substep [s]."""
VOLTAGE = 1e-3
"""[V]"""
RELEASE = np.arange(COUNT) % 2 == 1


def plant() -> PlantParams:
    """The paper's plant with a delay and a lag that fall inside substeps."""
    base = paper_plant()
    return replace(
        base,
        vehicle=replace(base.vehicle, queue=QueueParams(0.0213)),
        rope=replace(base.rope, segments=SEGMENTS),
        release=replace(base.release, lag=LAG),
    )


def test_whole_plant():
    pos, still = np.tile([0.0, 0.0, 2.0], (COUNT, 1)), np.zeros((COUNT, 3))
    vel = np.random.default_rng(0).normal(size=(COUNT, 3)) * 0.5
    reference = ReferencePlant(plant(), count=COUNT, step=5e-4)
    reference.reset(pos, np.tile([0.0, 0.0, 0.0, 1.0], (COUNT, 1)), vel, still)
    sim = HybridSim(replace(plant(), sim=numerics(SUBSTEP, "float64")), COUNT)
    sim.place(pos, vel_w=vel)
    separation = np.full(COUNT, np.nan)
    for k, command in enumerate(random_commands(0, STEPS, COUNT)):
        release = RELEASE & (k == ASKED_AT)
        reference.step(command, release)
        sim.set_command(command, release)
        sim.step()
        now = sim.get("separated") != 0
        separation[now] = 0.02 * k + sim.get("separation_time")[now]
    state = reference.state
    assert norm(sim.get("pos_w") - state.pos_w, axis=1).max() < WITHIN
    held = ~RELEASE
    assert norm(sim.get("payload_pos_w") - state.payload_pos_w, axis=1)[held].max() < WITHIN
    assert np.abs(sim.get("voltage") - state.battery_voltage).max() < VOLTAGE
    np.testing.assert_array_equal(sim.get("attached") != 0, state.attached)
    np.testing.assert_allclose(separation, reference.landing.separation_time, atol=1e-6)
    assert norm(state.pos_w - pos, axis=1).min() > 0.1, "the vehicles must have gone somewhere"

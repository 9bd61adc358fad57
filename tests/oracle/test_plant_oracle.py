"""The whole simulator against the whole reference plant: queue, blocks, rope and release together.

The reference shares the equations and no code: float64 NumPy and MuJoCo's rope without twist, RK4.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.linalg import norm
from pytest import mark

from sim.hybrid import HybridSim
from sim.params import PlantParams, QueueParams
from sim.reference.plant import ReferencePlant
from tests.plants import paper_plant
from tests.simulators import numerics, random_commands

COUNT, STEPS, ASKED_AT = 6, 25, 12
"""Environments; control steps; step at which every second one asks for the release."""
LAG = 0.1037
WITHIN = {"float32": 1e-3, "float64": 1e-4}
"""After half a second of full-range commands [m]: measured 0.64 mm at 2 ms, 0.035 mm at 0.5 ms."""
SUBSTEPS = {"float32": 2e-3, "float64": 5e-4}
VOLTAGE = 1e-3
"""[V]"""
RELEASE = np.arange(COUNT) % 2 == 1


def plant() -> PlantParams:
    """The paper's plant with a delay and a lag that fall inside substeps."""
    base = paper_plant()
    return replace(
        base,
        vehicle=replace(base.vehicle, queue=QueueParams(0.0213)),
        release=replace(base.release, lag=LAG),
    )


def start() -> tuple[np.ndarray, np.ndarray]:
    return (
        np.tile([0.0, 0.0, 2.0], (COUNT, 1)),
        np.random.default_rng(0).normal(size=(COUNT, 3)) * 0.5,
    )


@lru_cache
def reference() -> ReferencePlant:
    pos, vel = start()
    flown = ReferencePlant(plant(), count=COUNT, step=5e-4)
    flown.reset(pos, np.tile([0.0, 0.0, 0.0, 1.0], (COUNT, 1)), vel, np.zeros((COUNT, 3)))
    for k, command in enumerate(random_commands(0, STEPS, COUNT)):
        flown.step(command, RELEASE & (k == ASKED_AT))
    return flown


@mark.parametrize("precision", ["float64"])
def test_whole_plant(precision):
    pos, vel = start()
    sim = HybridSim(replace(plant(), sim=numerics(SUBSTEPS[precision], precision)), COUNT)
    sim.place(pos, vel_w=vel)
    separation = np.full(COUNT, np.nan)
    for k, command in enumerate(random_commands(0, STEPS, COUNT)):
        sim.set_command(command, RELEASE & (k == ASKED_AT))
        sim.step()
        separation[sim.get("separated") != 0] = (
            0.02 * k + sim.get("separation_time")[sim.get("separated") != 0]
        )
    state = reference().state
    bound = WITHIN[precision]
    assert norm(sim.get("pos_w") - state.pos_w, axis=1).max() < bound
    held = ~RELEASE
    assert norm(sim.get("payload_pos_w") - state.payload_pos_w, axis=1)[held].max() < bound
    assert np.abs(sim.get("voltage") - state.battery_voltage).max() < VOLTAGE
    np.testing.assert_array_equal(sim.get("attached") != 0, state.attached)
    np.testing.assert_allclose(separation, reference().landing.separation_time, atol=1e-6)
    assert norm(state.pos_w - pos, axis=1).min() > 0.1, "the vehicles must have gone somewhere"

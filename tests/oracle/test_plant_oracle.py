"""The whole simulator against the whole reference plant: queue, blocks, rope and release together.

The reference shares the equations and no code: float64 NumPy and MuJoCo's rope without twist, RK4.
"""

from dataclasses import replace

import numpy as np
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, mark

from sim.hybrid import HybridSim
from sim.params import PlantParams, change_values
from sim.reference.plant import ReferencePlant
from tests.plants import EVERYTHING, paper_plant
from tests.simulators import bare_quadrotor, numerics, random_commands

COUNT, RELEASE_STEP = 4, 12
"""Environments; step at which every second one gets the release command."""
USUAL = {"rope.segments": 1, "vehicle.queue.delay": 0.0213, "release.lag": 0.1037}
"""A delay and a lag that fall inside substeps. `test_chain_oracle` flies all segments."""
CASES = {
    "usual": ({"rope.segments": 15}, 25),
    "late by whole periods": ({"vehicle.queue.delay": 0.04}, 10),
    "late by periods and more": ({"vehicle.queue.delay": 0.0467}, 10),
    "at once": ({"vehicle.queue.delay": 0.0}, 10),
    "geometric": ({"vehicle.controller.kind": "geometric", "vehicle.motor.kind": "instant"}, 10),
    "mixing": (
        {
            "vehicle.controller.kind": "motor_mixing",
            "vehicle.controller.gyro_share": (0.4, 0.5, 1.3),
            "vehicle.battery.kind": "ideal",
            "vehicle.aero.kind": "none",
        },
        10,
    ),
}
"""Changes of the paper's plant, and how many control steps it flies."""
PRECISIONS = {"usual": ("float64", "float32")}
"""The usual plant flies as in training too; the others in float64 alone."""
WITHIN = {"float64": 1e-4, "float32": 1e-3}
"""After half a second of full-range commands [m], at the substeps below; measured 0.63 mm in
float32."""
SUBSTEPS = {"float64": 5e-4, "float32": 2e-3}
BUILT_IN = {"float64": EVERYTHING, "float32": frozenset()}
"""Extensions: the kernel of all tests of extensions, and that of training."""
VOLTAGE, RATE = 1e-3, 0.05
"""[V], [rad/s]"""
RELEASE = np.arange(COUNT) % 2 == 1


def plant_of(changes: dict) -> PlantParams:
    return change_values(paper_plant(), USUAL | changes)


@mark.parametrize("name", CASES)
def test_whole_plant(name):
    changes, steps = CASES[name]
    plant = plant_of(changes)
    pos, still = np.tile([0.0, 0.0, 2.0], (COUNT, 1)), np.zeros((COUNT, 3))
    vel = np.random.default_rng(0).normal(size=(COUNT, 3)) * 0.5
    reference = ReferencePlant(plant, count=COUNT, step=2e-3)
    reference.reset(pos, np.tile([0.0, 0.0, 0.0, 1.0], (COUNT, 1)), vel, still)
    sims, separation = {}, {}
    for precision in PRECISIONS.get(name, ("float64",)):
        settings = numerics(SUBSTEPS[precision], precision)
        built_in = BUILT_IN[precision]
        sims[precision] = HybridSim(replace(plant, sim=settings), COUNT, extensions=built_in)
        sims[precision].place(pos, vel_w=vel)
        separation[precision] = np.full(COUNT, np.nan)
    for k, command in enumerate(random_commands(0, steps, COUNT)):
        release = RELEASE & (k == RELEASE_STEP)
        reference.step(command, release)
        for precision, sim in sims.items():
            sim.set_command(command, release)
            sim.step()
            now = sim.get("separated") != 0
            separation[precision][now] = 0.02 * k + sim.get("separation_time")[now]
    state, held = reference.state, ~RELEASE
    for precision, sim in sims.items():
        within = WITHIN[precision]
        assert norm(sim.get("pos_w") - state.pos_w, axis=1).max() < within
        assert np.abs(sim.get("rate_b") - state.rate_b).max() < RATE
        assert norm(sim.get("payload_pos_w") - state.payload_pos_w, axis=1)[held].max() < within
        assert np.abs(sim.get("voltage") - state.battery_voltage).max() < VOLTAGE
        assert_array_equal(sim.get("attached") != 0, state.attached)
        assert_allclose(separation[precision], reference.landing.separation_time, atol=1e-6)
    assert norm(state.pos_w - pos, axis=1).max() > 0.1, "the vehicles must have gone somewhere"


def test_orders_of_the_integrators_without_a_rope():
    """Gentle commands keep the mixer off its limits, where orders 1 and 4 differ; no other code is
    needed.
    """
    vehicle = plant_of({}).vehicle

    def end(integrator, step):
        sim = bare_quadrotor(vehicle, 1, integrator, step, precision="float64")
        for command in ([3.0, 1.0, -0.5, 0.3], [2.0, -1.0, 0.5, -0.2], [2.5, 0.3, 1.0, 0.1]):
            sim.set_command([command])
            sim.step()
        return sim.get("pos_w")[0]

    for integrator, order in (("euler", 1.0), ("rk4", 4.0)):
        ends = [end(integrator, h) for h in (1e-3, 5e-4, 2.5e-4)]
        measured = np.log2(norm(ends[0] - ends[1]) / norm(ends[1] - ends[2]))
        assert measured == approx(order, abs=0.35)

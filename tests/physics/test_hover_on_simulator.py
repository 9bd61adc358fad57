"""The hover controller on the full simulator: every block of the vehicle, 15 segments of rope, also
with more delay.
"""

from dataclasses import replace

import numpy as np
from numpy.linalg import norm
from pytest import mark

from sim.hybrid import HybridSim
from visthrow import config
from visthrow.onboard.hover import HoverController, HoverParams
from visthrow.task import Experiment, plant_of

GOAL = np.array([0.0, 0.0, 2.0])
SWING = 0.35
"""Start of the second vehicle: rope this far off the vertical [rad]; the first starts 0.5 m off the
goal.
"""
SECONDS = 6
STEPS = 50
"""Of 20 ms, a second."""


@mark.parametrize("extra_delay", [0.0, 0.02])
@mark.parametrize("loaded", [True, False])
def test_settles_and_damps_with_margin(extra_delay, loaded):
    plant = plant_of(config.load(Experiment, config.find("train", "state")))
    queue = replace(plant.vehicle.queue, delay=plant.vehicle.queue.delay + extra_delay)
    plant = replace(plant, vehicle=replace(plant.vehicle, queue=queue))
    simulator = HybridSim(plant, 2)
    ropes = np.tile([0.0, 0.0, -1.0], (2, plant.rope.segments, 1))
    ropes[1] = (np.sin(SWING), 0.0, -np.cos(SWING))
    simulator.place(pos_w=GOAL + np.array([[0.3, 0.32, -0.24], [0.0, 0.0, 0.0]]), cable_dir_w=ropes)
    controller = HoverController(HoverParams(), plant.sim.control_period, 2)
    mass = plant.vehicle.body.mass + (
        plant.rope.rope_mass + plant.rope.payload_mass if loaded else 0.0
    )
    distance, swing, rate = [], [], []
    for _ in range(SECONDS * STEPS):
        pos_w, vel_w = simulator.get("pos_w"), simulator.get("vel_w")
        simulator.set_command(
            controller.step(pos_w, simulator.get("quat_wb"), vel_w, GOAL, mass), [not loaded] * 2
        )
        simulator.step()
        distance.append(norm(simulator.get("pos_w") - GOAL, axis=1))
        swing.append(norm((simulator.get("payload_pos_w") - simulator.get("pos_w"))[:, :2], axis=1))
        rate.append(norm(simulator.get("rate_b"), axis=1))
    distance, swing, rate = (
        np.array(rows).reshape(SECONDS, STEPS, 2) for rows in (distance, swing, rate)
    )
    assert distance[3:].max() < 0.10
    assert distance[-1].max() < 0.02
    if loaded:
        peaks = swing[:, :, 1].max(axis=1)
        assert peaks[2] < 0.65 * peaks[0]
        assert peaks[5] < 0.40 * peaks[0]
    else:
        assert rate[-1].max() < 0.05, "the rate loop must not ring"

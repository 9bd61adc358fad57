"""Random full-range flights: nothing fails, and rods turn as fast as they do at a fine step.

A rope that never fails may do so by false damping; so its segments' rates are held against a run at
0.1 ms."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose

from sim.hybrid import HybridSim, tether_lengths
from sim.kernels.state import FALLBACK, NONFINITE
from sim.params import PlantParams
from tests.configs import load_experiment
from tests.plants import EVERYTHING
from tests.simulators import numerics, random_commands
from visthrow.task import Experiment, plant_of

FAILED = 1e-3
"""Share of episodes without terminations that may end in a bad state."""
RATE_RATIO = 0.02
"""RMS rate of the segments at 2 ms against 0.1 ms, over all rods; measured 0.993 to 0.999."""
ROD_RATIO = 0.03
"""The same for each rod of the rope."""
RATE_DIFFERENCE = 0.1
"""RMS of the difference of the rates over their RMS; measured 0.02 to 0.05."""


def experiment() -> Experiment:
    return load_experiment("state")


def start_randomised(
    count: int, seed: int, plant: PlantParams | None = None, extensions=frozenset()
) -> HybridSim:
    """Randomised as in training."""
    exp = experiment()
    plant = plant or plant_of(exp)
    ropes = tether_lengths(plant.rope, exp.task.start)
    sim = HybridSim(plant, count, seed=seed, ropes=ropes, extensions=extensions)
    sim.randomize(exp.task.start)
    return sim


def test_hardly_a_failed_state_without_terminations():
    """Episodes of a second, by full-range commands."""
    count, start = 400, experiment().task.start
    sim, failed, fallbacks = start_randomised(count, 2), 0, 0
    for episode in np.split(random_commands(2, 100, count), 2):
        bad = np.zeros(count, dtype=bool)
        for command in episode:
            sim.set_command(command)
            sim.step()
            status = sim.get("status")
            bad |= (status & NONFINITE) != 0
            fallbacks += np.count_nonzero(status & FALLBACK)
        failed += np.count_nonzero(bad)
        sim.randomize(start)
    assert failed <= FAILED * 2 * count
    assert fallbacks < 0.01 * 100 * count


def segment_rates(substep: float, precision: str, count: int, seed: int) -> np.ndarray:
    """Rates of all rods over the first 0.2 s [1/s], shape (T, E, L, 3)."""
    plant = replace(plant_of(experiment()), sim=numerics(substep, precision))
    extensions = EVERYTHING if precision == "float64" else frozenset()
    sim, rows = start_randomised(count, seed, plant, extensions), []
    for command in random_commands(seed, 10, count):
        sim.set_command(command)
        sim.step()
        assert not np.any(sim.get("status") & NONFINITE)
        rows.append(sim.get("cable_vel_w").astype(float))
    return np.array(rows)


def test_segments_turn_as_fast_as_at_a_fine_step():
    coarse, fine = (segment_rates(*how, 64, 3) for how in ((0.002, "float32"), (1e-4, "float64")))
    rms = [np.sqrt(np.square(r).sum(-1).mean((1, 2))) for r in (coarse, fine, coarse - fine)]
    assert np.ptp(rms[1]) > 0.5, "the rope must have been driven"
    assert_allclose(rms[0] / rms[1], 1.0, atol=RATE_RATIO)
    assert (rms[2] / rms[1]).max() < RATE_DIFFERENCE
    rods = [np.sqrt(np.square(r).sum(-1).mean((0, 1))) for r in (coarse, fine)]
    assert_allclose(rods[0] / rods[1], 1.0, atol=ROD_RATIO)

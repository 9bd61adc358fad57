"""Release: latch, lag at substep resolution, and what follows from the state at separation, against
plain NumPy.
"""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from pytest import mark

from sim.hybrid import HybridSim
from sim.params import PlantParams, change_values
from tests.plants import paper_plant

CLOCK = 1e-6
"""Times are sums of float32 periods [s]."""
PERIOD = 0.02


def plant(lag: float) -> PlantParams:
    return change_values(paper_plant(), {"release.lag": lag})


def throw(sim: HybridSim, commands: np.ndarray, release_step: int) -> list[dict]:
    """Outputs of every step; the release is commanded at one step only."""
    rows = []
    for k, command in enumerate(commands):
        sim.set_command(command, np.full(sim.count, k == release_step))
        sim.step()
        names = (
            "separated",
            "attached",
            "separation_time",
            "release_timer",
            "payload_pos_w",
            "payload_vel_w",
        )
        rows.append({name: sim.get(name) for name in names})
    return rows


@mark.parametrize("lag", [0.0, 0.004, 0.02, 0.1037, 0.11])
def test_the_latch_keeps_and_the_lag_is_exact(lag):
    """Commanded once, at the start of step 3; separation follows in the right step and at the right
    time.
    """
    release_step, count = 3, 2
    sim = HybridSim(plant(lag), count)
    rows = throw(sim, np.tile([3.0, 0.5, 0.0, 0.0], (14, count, 1)), release_step)
    times = [k for k, row in enumerate(rows) if np.any(row["separated"])]
    assert len(times) == 1
    (step,) = times
    since = (step - release_step) * PERIOD + rows[step]["separation_time"]
    assert_allclose(since, lag, atol=CLOCK)
    for k, row in enumerate(rows):
        assert np.all(row["attached"] == (k < step))
        assert np.all(row["release_timer"] < 0.0) == (k < release_step)


def test_asking_again_or_no_more_changes_nothing():
    once, often = HybridSim(plant(0.07), 1), HybridSim(plant(0.07), 1)
    command = [[3.0, 0.5, 0.0, 0.0]]
    for k in range(8):
        once.set_command(command, [k == 1])
        often.set_command(command, [k >= 1])
        once.step()
        often.step()
        for name in ("payload_pos_w", "pos_w", "attached", "separated", "release_timer"):
            assert_array_equal(once.get(name), often.get(name))


def test_outputs_stay_after_the_landing_step():
    """A release's outputs stay until the next one: the learner may read them a step later."""
    sim = HybridSim(plant(0.02), 1)
    command = [[3.0, 0.5, 0.0, 0.0]]
    kept = None
    for k in range(6):
        sim.set_command(command, [k == 0])
        sim.step()
        if kept is not None:
            for name, value in kept.items():
                assert_array_equal(sim.get(name), value)
            assert sim.get("separated")[0] == 0
        if sim.get("separated")[0]:
            kept = {
                name: sim.get(name)
                for name in ("landing_w", "time_to_impact", "clearance", "payload_pos_w")
            }
    assert kept is not None

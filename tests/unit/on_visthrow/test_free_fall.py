"""Free fall: one closed form for arrays and tensors, equal to the simulator's."""

import numpy as np
from numpy.testing import assert_allclose
from pytest import approx, mark

from sim.hybrid import HybridSim
from sim.kernels import state as st
from tests.plants import paper_plant
from visthrow.common.free_fall import fall_time, free_flight

FLOAT32 = 1e-5
"""Relative rounding of the simulator's float32 over a fall of a second."""

HEIGHT = np.array([2.0, 1.0, 0.5])
CLIMB = np.array([0.0, 3.0, -1.0])


def test_the_closed_form_is_the_simulators():
    """Where the simulator foresees the landing of payloads that separate now, without drag."""
    plant = paper_plant()
    sim = HybridSim(plant, 3)
    pos_w = np.column_stack([np.zeros(3), np.zeros(3), HEIGHT + 2.0])
    vel_w = np.column_stack([np.ones(3), np.zeros(3), CLIMB])
    sim.place(pos_w, vel_w=vel_w)
    payload_w = sim.get("payload_pos_w").astype(float)
    velocity_w = sim.get("payload_vel_w").astype(float)
    sim.foresee()
    time = fall_time(payload_w[:, 2] - plant.release.landing_height, velocity_w[:, 2])
    landing_w = free_flight(payload_w, velocity_w, time[:, None])
    foreseen = {k: st.fetched(getattr(sim.foreseen, k)) for k in ("time_to_impact", "landing_w")}
    assert_allclose(foreseen["time_to_impact"], time, rtol=FLOAT32)
    assert_allclose(foreseen["landing_w"], landing_w, rtol=FLOAT32, atol=FLOAT32)


@mark.parametrize(("floor", "expected"), [(0.0, 1.0 / 9.81), (-np.inf, np.nan)])
def test_a_height_that_is_never_reached(floor, expected):
    with np.errstate(invalid="ignore"):
        assert fall_time(np.float64(-1.0), np.float64(1.0), floor) == approx(expected, nan_ok=True)

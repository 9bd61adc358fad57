"""The same kernels on CUDA: graphs equal launches, and the CPU agrees."""

from dataclasses import replace

import numpy as np
import warp as wp
from numpy.testing import assert_allclose
from pytest import mark

from sim.hybrid import HybridSim
from tests.contract.test_simulator_bits import assert_same, everything, start_spreads
from tests.plants import paper_plant
from tests.simulators import numerics, random_commands

pytestmark = [
    mark.gpu,
    mark.skipif(not wp.is_cuda_available(), reason="needs a CUDA device"),
]
DEVICE = "cuda:0"
COUNT, STEPS = 200, 15
SAME = 1e-9
"""In float64 the two compilers' sums differ in the last digits, and a second of flight makes
thousands of those [m].
"""


def drive(sim: HybridSim) -> dict[str, np.ndarray]:
    for k, command in enumerate(random_commands(0, STEPS, COUNT)):
        sim.set_command(command, (np.arange(COUNT) % 2) * (k == 5))
        sim.step()
    return everything(sim)


def test_graph_equals_launches():
    start = start_spreads()
    sims = [HybridSim(paper_plant(), COUNT, DEVICE, seed=1) for _ in range(2)]
    mask = wp.array((np.arange(COUNT) % 3 == 0).astype(np.int32), device=DEVICE)
    for sim in sims:
        sim.randomize(start, mask)
        sim.step()  # loads the modules, which a capture may not
    eager, graphed = sims
    before = everything(graphed)
    with wp.ScopedCapture(device=DEVICE) as capture:
        graphed.step()
        graphed.randomize(start, mask)
    assert_same(everything(graphed), before)  # a capture records and runs nothing
    for command in random_commands(1, STEPS, COUNT):
        for sim in sims:
            sim.set_command(command)
        eager.step()
        eager.randomize(start, mask)
        wp.capture_launch(capture.graph)
        assert_same(everything(eager), everything(graphed))


def test_cuda_agrees_with_the_cpu():
    plant = replace(paper_plant(), sim=numerics(precision="float64"))
    on_cuda, on_cpu = (drive(HybridSim(plant, COUNT, device)) for device in (DEVICE, "cpu"))
    for name in ("pos_w", "payload_pos_w", "landing_w"):
        assert_allclose(on_cuda[name], on_cpu[name], atol=SAME, err_msg=name)

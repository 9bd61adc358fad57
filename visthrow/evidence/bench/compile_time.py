"""Time to the first step: with an empty kernel cache, and with the one that this filled."""

import contextlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator

import warp as wp

from visthrow.common.errors import VisthrowError

_PROBE = """
import sys, time
import warp as wp
wp.init()
wp.array([0.0], device=sys.argv[1])
from visthrow import config
from visthrow.task import Experiment, plant_of
start = time.perf_counter()
from sim.hybrid import HybridSim
sim = HybridSim(plant_of(config.load(Experiment, config.find("train", "state"))), 1, sys.argv[1])
sim.randomize(config.load(Experiment, config.find("train", "state")).task.start)
sim.step()
wp.synchronize_device(sys.argv[1])
print("seconds", time.perf_counter() - start)
"""


@contextlib.contextmanager
def fresh_cache(device: str) -> Iterator[dict[str, float]]:
    """Measure with an empty kernel cache and go on with it inside the context, so that nothing is compiled twice.

    Yields:
        Seconds from nothing to the first finished control step, in processes of their own: ``cold_s`` with the empty
        cache, ``warm_s`` with what this left there.

    Raises:
        VisthrowError: such a process failed.
    """
    wp.init()
    before = wp.config.kernel_cache_dir
    with tempfile.TemporaryDirectory() as folder:
        caches = {"WARP_CACHE_PATH": folder, "CUDA_CACHE_PATH": folder}
        found = {"cold_s": _probe(device, caches), "warm_s": _probe(device, caches)}
        wp.config.kernel_cache_dir = os.path.join(folder, wp.config.version)
        try:
            yield found
        finally:
            wp.config.kernel_cache_dir = before


def _probe(device: str, caches: dict[str, str]) -> float:
    told = subprocess.run(
        [sys.executable, "-c", _PROBE, device], capture_output=True, text=True, env={**os.environ, **caches}
    )
    seconds = [line.split()[1] for line in told.stdout.splitlines() if line.startswith("seconds ")]
    if told.returncode or not seconds:
        raise VisthrowError(f"measuring the compile time on {device} failed: {told.stderr.strip()[-500:]}")
    return float(seconds[-1])

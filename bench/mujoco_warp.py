"""MuJoCo Warp on the rope of the hard throw: implicitfast with armature at 2 ms, from a
CUDA graph.
"""

import importlib
import statistics
import time
from typing import Any

import numpy as np
import warp as wp

from bench.report import Table, rate

BATCHES = (8192, 16384, 32768, 65536)
SUBSTEPS = 10  # in the graph: one control step of ours
STRETCH = 25  # replays from one start: the 0.5 s of the hard throw
MISSING = (
    "MuJoCo Warp was not measured: the package '{package}' is not installed; "
    "install it with: pip install {package}"
)


def _model() -> tuple[Any, Any]:
    from bench import mujoco_c

    return mujoco_c.start_scene(
        mujoco_c.HARD_THROW, mujoco_c.IMPLICIT_STEP, "implicitfast", mujoco_c.ARMATURE
    )


class Worlds:
    """A batch of hard throws in MuJoCo Warp."""

    def __init__(self, count: int, device: str):
        import mujoco_warp

        self.count = count
        self.device = device
        model, data = _model()
        with wp.ScopedDevice(device):
            self._model = mujoco_warp.put_model(model)
            self.data = mujoco_warp.put_data(model, data, nworld=count)
            self._start = wp.clone(self.data.qpos), wp.clone(self.data.qvel)
            self._step = mujoco_warp.step
            self._advance()  # loads the modules: a capture cannot
            with wp.ScopedCapture(device=device, force_module_load=False) as capture:
                self._advance()
            self.graph = capture.graph

    def _advance(self) -> None:
        for _ in range(SUBSTEPS):
            self._step(self._model, self.data)

    def rate(self, replays: int = STRETCH) -> float:
        """Substeps a second of one stretch from the start of the throw."""
        wp.copy(self.data.qpos, self._start[0])
        wp.copy(self.data.qvel, self._start[1])
        wp.synchronize_device(self.device)
        start = time.perf_counter()
        for _ in range(replays):
            wp.capture_launch(self.graph)
        wp.synchronize_device(self.device)
        return self.count * SUBSTEPS * replays / (time.perf_counter() - start)

    def measure_difference(self, replays: int) -> float:
        """Distance [m] of world 0's vehicle from MuJoCo C's after as many steps: the same model was
        measured.
        """
        import mujoco

        self.rate(replays)
        model, data = _model()
        mujoco.mj_step(model, data, SUBSTEPS * replays)
        return float(np.linalg.norm(self.data.qpos.numpy()[0, :3] - data.qpos[:3]))


def measure(
    device: str,
    repeats: int,
    control_period: float,
    batches: tuple[int, ...] = BATCHES,
    stretch: int = STRETCH,
) -> dict[str, Any]:
    """Median rates over batch sizes; only ``why_not`` where a package is missing."""
    for package in ("mujoco", "mujoco_warp"):
        try:
            importlib.import_module(package)
        except ModuleNotFoundError:
            return {"why_not": MISSING.format(package=package.replace("_", "-"))}
    model, _ = _model()
    substeps = control_period / model.opt.timestep
    rows = []
    off = float("nan")
    for count in batches:
        worlds = Worlds(count, device)
        off = worlds.measure_difference(min(stretch, 5))
        rates = [worlds.rate(stretch) for _ in range(repeats)]
        best = statistics.median(rates)
        rows.append(
            {
                "batch": count,
                "substeps_per_s": best,
                "env_steps_per_s": best / substeps,
                "runs": rates,
            }
        )
        del worlds
    return {
        "rows": rows,
        "best": max(rows, key=lambda r: r["substeps_per_s"]),
        "off_from_c_m": off,
        "step_s": model.opt.timestep,
    }


def table(rates: dict[str, Any]) -> Table:
    """Printed form of :func:`measure`."""
    cells = [
        (f"{r['batch']:,}", rate(r["substeps_per_s"]), rate(r["env_steps_per_s"]))
        for r in rates["rows"]
    ]
    title = f"MuJoCo Warp, bare rope, implicitfast with armature, {rates['step_s'] * 1e3:g} ms"
    return Table(title, ("worlds", "substeps/s", "env-steps/s"), tuple(cells))

"""A GPU: environment steps a second over batch sizes from a CUDA graph, against MuJoCo Warp."""

import functools
import statistics
import time
from collections.abc import Callable
from typing import Any

import warp as wp

from bench import commands
from bench.report import Report, Table, device_name, rate
from sim.hybrid import HybridSim, tether_lengths
from visthrow.task import Experiment, plant_of

BATCHES = tuple(2**k for k in range(12, 20))  # 4,096 to 524,288
GRAPH_STEPS = 20  # control steps in the graph
REPLAYS = 3  # of the graph between two starts: 1.2 simulated seconds
BARS = {"env_steps_per_s": 30e6, "over_mujoco_warp": 30.0}


class Graph:
    """Control steps of a batch under drawn commands, captured once and replayed; launched one by
    one on a CPU, and where the solver's work cannot be captured.
    """

    def __init__(
        self, experiment: Experiment, count: int, kind: str, device: str, steps: int = GRAPH_STEPS
    ):
        plant = plant_of(experiment)
        self.spreads = experiment.task.start
        self.steps = steps
        self.device = device
        self.sim = HybridSim(
            plant, count, device, ropes=tether_lengths(experiment.rope, self.spreads)
        )
        drawn = commands.draw(kind, plant, experiment.task.action, steps, count)
        self._commands = [wp.array(c, dtype=self.sim.types.vec4, device=device) for c in drawn]
        self.sim.randomize(self.spreads)
        self._advance()  # loads the module: a capture cannot
        self._replay = self._advance
        if device.startswith("cuda") and self.sim.capturable:
            with wp.ScopedCapture(device=device, force_module_load=False) as capture:
                self._advance()
            self._replay = functools.partial(wp.capture_launch, capture.graph)

    def _advance(self) -> None:
        for command in self._commands:
            wp.copy(self.sim.command, command)
            self.sim.step()

    def rate(self, replays: int = REPLAYS, clock: Callable[[], float] = time.perf_counter) -> float:
        """Environment steps a second of one stretch from a new start, the start left out."""
        self.sim.randomize(self.spreads)
        wp.synchronize_device(self.device)
        start = clock()
        for _ in range(replays):
            self._replay()
        wp.synchronize_device(self.device)
        return self.sim.count * self.steps * replays / (clock() - start)


def sweep(
    experiment: Experiment, device: str, batches: tuple[int, ...], repeats: int
) -> list[dict[str, Any]]:
    """Median rates over batch sizes and command kinds, with the shares of fallen-back and failed
    environments.
    """
    rows = []
    for count in batches:
        row: dict[str, Any] = {"batch": count}
        for kind in commands.KINDS:
            graph = Graph(experiment, count, kind, device)
            graph.rate()
            rates = [graph.rate() for _ in range(repeats)]
            row[kind] = {
                "env_steps_per_s": statistics.median(rates),
                "runs": rates,
                **commands.shares(graph.sim),
            }
            del graph
        rows.append(row)
    return rows


def measure(
    experiment: Experiment,
    device: str,
    batches: tuple[int, ...] | list[int],
    repeats: int,
    with_mujoco: bool = True,
) -> Report:
    """Measure and report."""
    plant = plant_of(experiment)
    rows = sweep(experiment, device, tuple(batches), repeats)
    best = {kind: max(rows, key=lambda r: r[kind]["env_steps_per_s"]) for kind in commands.KINDS}
    top = {kind: best[kind][kind]["env_steps_per_s"] for kind in commands.KINDS}
    figures: dict[str, Any] = {
        "device": device,
        "batches": rows,
        "best": {k: {"batch": best[k]["batch"], "env_steps_per_s": top[k]} for k in top},
        "graph_steps": GRAPH_STEPS,
        "replays": REPLAYS,
        "repeats": repeats,
        "bars": BARS,
        "mujoco_warp": None,
    }
    tables = [_sweep_table(rows, plant.rope.segments)]
    if with_mujoco:
        from bench import mujoco_warp

        rates = mujoco_warp.measure(device, min(repeats, 3), plant.sim.control_period)
        figures["mujoco_warp"] = rates
        if "rows" in rates:
            rates["ratio"] = {k: top[k] / rates["best"]["env_steps_per_s"] for k in top}
            tables.append(mujoco_warp.table(rates))
    return Report(
        "sim", f"Simulator on {device_name(device)}", tuple(tables), _notes(figures), figures
    )


def _sweep_table(rows: list[dict[str, Any]], segments: int) -> Table:
    header = (
        "environments",
        "hover, env-steps/s",
        "full range, env-steps/s",
        "full range: fell back",
        "failed",
    )
    cells = [
        (
            f"{row['batch']:,}",
            rate(row["hover"]["env_steps_per_s"]),
            rate(row["full"]["env_steps_per_s"]),
            f"{100 * row['full']['fallback']:.1f} %",
            f"{100 * row['full']['failed']:.3f} %",
        )
        for row in rows
    ]
    return Table(f"visthrow, all blocks, rope of {segments} segments", header, tuple(cells))


def _notes(figures: dict[str, Any]) -> tuple[str, ...]:
    best = figures["best"]
    notes = [
        (
            f"One graph holds {GRAPH_STEPS} control steps with a new command each; {REPLAYS}"
            f" replays from a new random start a measurement, median of {figures['repeats']}. One"
            " env-step is one control step."
        ),
        "Best: "
        + "; ".join(
            f"{k} {rate(b['env_steps_per_s'])} env-steps/s at {b['batch']:,}"
            for k, b in best.items()
        )
        + f" (bar {BARS['env_steps_per_s'] / 1e6:.0f} M).",
    ]
    rates = figures["mujoco_warp"]
    if rates is not None:
        ratios = rates.get("ratio")
        notes.append(
            rates["why_not"]
            if ratios is None
            else (
                f"Over MuJoCo Warp's best: hover {ratios['hover']:.0f}, full range"
                f" {ratios['full']:.0f} times (bar {BARS['over_mujoco_warp']:.0f})."
            )
        )
    return tuple(notes)

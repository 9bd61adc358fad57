"""Substeps a second of the hybrid simulator by solver and number of vehicles, all blocks and the
exchange included.

Chains run from a CUDA graph of 20 control steps; the others are launched step by step."""

import dataclasses
import json
import time
from collections.abc import Sequence

import numpy as np
import warp as wp

from bench import commands, start
from bench.engine import SUBSTEPS
from bench.report import Report, Table, device_name, finish, rate
from sim.hybrid import HybridSim, tether_lengths
from visthrow import config
from visthrow.task import Experiment, plant_of

GRAPH = 20  # control steps
FEWEST, SECONDS = 3, 1.0  # stretches of so many control steps, and for so long at least [s]


def measure(solver: str, count: int, device: str, changes: list[str]) -> dict:
    """Rate of one solver in substeps of 2 ms a second, whatever its own step."""
    experiment = config.load(Experiment, config.find("train", "state"), changes)
    plant = plant_of(experiment)
    numerics = dataclasses.replace(plant.sim, solver=solver, substep=SUBSTEPS[solver])
    plant, spreads = dataclasses.replace(plant, sim=numerics), experiment.task.start
    begin = time.perf_counter()
    sim = HybridSim(plant, count, device, ropes=tether_lengths(plant.rope, spreads))
    sim.randomize(spreads)
    drawn = commands.draw("hover", plant, experiment.task.action, GRAPH, count)
    given = [wp.array(c, dtype=sim.types.vec4, device=device) for c in drawn]

    def stretch() -> None:
        for command in given:
            wp.copy(sim.command, command)
            sim.step()

    if device.startswith("cuda") and sim.capturable:
        stretch()
        with wp.ScopedCapture(device=device, force_module_load=False) as captured:
            stretch()
        graph = captured.graph

        def stretch() -> None:
            wp.capture_launch(graph)

    stretch()
    wp.synchronize_device(device)
    built = time.perf_counter() - begin
    sim.randomize(spreads)
    wp.synchronize_device(device)
    begin, cpu, done = time.perf_counter(), time.process_time(), 0
    while done < FEWEST or time.perf_counter() - begin < SECONDS:
        stretch()
        wp.synchronize_device(device)
        done += 1
    wall, cpu = time.perf_counter() - begin, time.process_time() - cpu
    steps = count * GRAPH * done * round(plant.sim.control_period / 0.002)
    return {
        "solver": solver,
        "vehicles": count,
        "substeps_per_s": steps / wall,
        "substeps_per_cpu_s": steps / cpu,
        "built_s": built,
        "finite": bool(np.isfinite(sim.get("pos_w")).all()),
        **commands.shares(sim),
    }


def run(args) -> int:
    rows = []
    for solver in args.solvers:
        for count in args.counts:
            rows.append(measure(solver, count, args.device, args.overrides))
            print(json.dumps(rows[-1]), flush=True)
    by = "substeps_per_s" if args.device.startswith("cuda") else "substeps_per_cpu_s"
    cells = tuple((r["solver"], f"{r['vehicles']:,}", rate(r[by])) for r in rows)
    unit = "substeps/s" if by == "substeps_per_s" else "substeps a CPU second"
    title = f"Substeps of 2 ms with all blocks, {device_name(args.device)}"
    table = Table(title, ("solver", "vehicles", unit), cells)
    steps = ", ".join(f"{name} {1e3 * step:g} ms" for name, step in SUBSTEPS.items())
    notes = (f"Exchange and own step: {steps}. Hover commands, starts as in training.",)
    return finish(Report("engine", title, (table,), notes, {"rows": rows}), args)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = start.parser_of(__doc__)
    parser.add_argument("--solvers", nargs="+", default=list(SUBSTEPS), choices=list(SUBSTEPS))
    parser.add_argument("--counts", type=int, nargs="+", default=[1, 64, 1024])
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    parser.add_argument("--device", default="cpu")
    return start.main(parser, run, argv)


if __name__ == "__main__":
    raise SystemExit(main())

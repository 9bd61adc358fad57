"""Substeps a second of the hybrid simulator by solver and number of vehicles, all blocks and the
exchange included.

Chains run from a CUDA graph of 20 control steps; the others are launched step by step. On a CPU
its own seconds count, on a GPU those of the wall."""

import json
import time
from argparse import Namespace
from collections.abc import Sequence

import numpy as np

from bench import commands, start
from bench.engine import SUBSTEPS, overrides
from bench.report import Report, Table, device_name, finish, rate
from bench.sim_gpu import Graph
from visthrow.task import load_experiment

PAPERS_SUBSTEPS = 10  # a control step, whatever the solver's own step
SECONDS = 1.0  # of a measurement, at least


def measure(solver: str, count: int, args: Namespace) -> dict:
    """Rate of one solver in substeps of 2 ms a second."""
    changes = [*overrides(solver), *args.overrides]
    experiment = load_experiment("state", changes)
    begin = time.perf_counter()
    graph = Graph(experiment, count, "hover", args.device)
    built = time.perf_counter() - begin
    clock = time.perf_counter if args.device.startswith("cuda") else time.process_time
    once = count * graph.steps / graph.rate(1)  # [s]
    steps = graph.rate(max(3, round(SECONDS / once)), clock)
    return {
        "solver": solver,
        "vehicles": count,
        "substeps_per_s": PAPERS_SUBSTEPS * steps,
        "built_s": built,
        "finite": bool(np.isfinite(graph.sim.get("pos_w")).all()),
        **commands.shares(graph.sim),
    }


def run(args: Namespace) -> int:
    rows = []
    for solver in args.solvers:
        for count in args.counts:
            rows.append(measure(solver, count, args))
            print(json.dumps(rows[-1]), flush=True)
    cells = tuple((r["solver"], f"{r['vehicles']:,}", rate(r["substeps_per_s"])) for r in rows)
    unit = "substeps/s" if args.device.startswith("cuda") else "substeps a CPU second"
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

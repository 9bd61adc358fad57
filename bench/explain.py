"""Time of a diagnosis of given logs: reading and the fit of initial states, the verdicts, the
report.

python -m bench.explain flights/*.npz --no-report
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from bench import start
from bench.report import Report, Table, add_arguments_of_measurements, finish
from sim.cores import cores
from visthrow.common.compute_device import resolve_for_warp
from visthrow.diagnose.inputs import model_arguments as opening
from visthrow.diagnose.reporting import explain_cli
from visthrow.diagnose.select import diagnose_flights

VERDICT_S = {"cpu": 90.0, "cuda": 5.0}
"""Bars for ten throws and a minute of flight with the whole catalogue: two quiet CPU cores, an
H200.
"""
REPORT_S = 120.0
"""Additional time allowed for the report."""


def measure(args: argparse.Namespace) -> dict[str, float]:
    """Seconds of each stage of one diagnosis, and the numbers of flights and effects."""
    begun = time.perf_counter()
    source = opening.Opened(args)
    model = source.model
    logs = source.logs
    opened = time.perf_counter()
    diagnosis = diagnose_flights.explain(
        model, seed=args.seed, without=opening.numbers(args.without, logs)
    )
    explained = time.perf_counter()
    seconds = {
        "open": opened - begun,
        "explain": explained - opened,
        "verdict": explained - begun,
        "logs": len(logs),
        "effects": len(model.effects),
        "windows": diagnosis.windows,
        "named": len(diagnosis.theta),
    }
    if not args.no_report and diagnosis.work is not None:
        with tempfile.TemporaryDirectory() as folder:
            explain_cli.write_report(Path(folder), diagnosis, model, logs, args.seed)
        seconds["report"] = time.perf_counter() - explained
    return seconds


def run(args: argparse.Namespace) -> int:
    """Measure, print, keep."""
    runs = [measure(args) for _ in range(args.repeats)]
    stages = [stage for stage in ("open", "explain", "verdict", "report") if stage in runs[0]]
    device = resolve_for_warp(args.device)
    bar = VERDICT_S["cuda" if device.startswith("cuda") else "cpu"]
    bars = {"verdict": f"{bar:g}", "report": f"{REPORT_S:g}"}
    rows = tuple(
        (stage, *(f"{stage_seconds[stage]:.1f}" for stage_seconds in runs), bars.get(stage, ""))
        for stage in stages
    )
    header = ("stage [s]", *(f"run {i + 1}" for i in range(len(runs))), "bar")
    first = runs[0]
    title = (
        f"{first['logs']} logs, {first['windows']} windows, {first['effects']} effects,"
        f" {first['named']} named"
    )
    notes = (
        (
            f"Device {device}, {cores()} CPU cores. Wall time without Python's start;"
            " a first run may compile kernels."
        ),
        (
            "verdict = open + explain. The bars hold for ten throws and a minute of flight, on two"
            " quiet cores or an H200."
        ),
    )
    return finish(
        Report(
            "explain",
            "How long a diagnosis takes",
            (Table(title, header, rows),),
            notes,
            {"runs": runs},
        ),
        args,
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = start.parser_of(__doc__, record=False)
    opening.add_arguments(parser)
    parser.add_argument("--no-report", action="store_true", help="measure the verdicts only")
    add_arguments_of_measurements(parser, 2)
    parser.set_defaults(device="cpu")
    return start.main(parser, run, argv)


if __name__ == "__main__":
    sys.exit(main())

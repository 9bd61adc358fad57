"""Draws the trainings of the record ``engine-training-h100``: landing errors over wall time."""

import math
import sys
from pathlib import Path
from typing import Any

from visthrow.common.statistics import Interval
from visthrow.common.storage import atomic_write
from visthrow.paper import measurements
from visthrow.paper.report import charts


def line(series: int, solver: str, rows: list[dict[str, Any]]) -> charts.Line:
    """Curve of one training: 200 throws at 2.0 m of each policy that was kept."""
    values = []
    for row in rows:
        half = 1.96 * row["error_std"] / math.sqrt(row["success"] * row["throws"])
        mean = row["error_mean"]
        values.append(Interval(mean, mean - half, mean + half))
    return charts.Line(f"through {solver}", [row["seconds"] for row in rows], values, series)


def main() -> None:
    record = measurements.load(measurements.FOLDER / "engine-training-h100.json")
    thrown = record["figures"]["throws"].items()
    lines = tuple(line(k, solver, rows) for k, (solver, rows) in enumerate(thrown))
    panel = charts.Panel(record["title"], "wall time [s]", lines)
    picture = charts.curves([panel], "landing error at 2.0 m [m]", log=True)
    atomic_write(Path(sys.argv[1]), picture)


if __name__ == "__main__":
    main()

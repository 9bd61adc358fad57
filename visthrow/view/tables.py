"""Tables of throws: Markdown for people, CSV for programs. Every table names its plant."""

import csv
import io
from collections.abc import Sequence

import numpy as np

from visthrow.common.toml_text import tables_beside
from visthrow.view.parts import align

_TABLES = tables_beside(__file__, "data/paper.toml")

PAPER = {
    (layout, float(target)): tuple(figures)
    for layout, rows in _TABLES["throws"].items()
    for target, figures in rows.items()
}
"""Layout and target [m] -> landing error [m] and duration [s], mean and standard deviation each."""

PAPER_ABLATIONS = {name: tuple(figures) for name, figures in _TABLES["ablations"].items()}
"""Variant -> landing error [m] and duration [s], mean and standard deviation each, and a
description of the landing points.
"""

PAPER_FRONT: list[list[float]] = _TABLES["front"]
"""Release speed [m/s], w_t, rho, landing error [m], duration [s], position [m] and velocity error
[m/s] at release of the paper's TO+MPC.
"""

PAPER_NOTE = (
    "The paper's figures are ten throws a target, of a real vehicle for policies and in its own"
    " pendulum model for TO+MPC; ours are simulated. No vehicle was flown for this project, so the"
    " two columns do not measure the same thing."
)

HEADER = (
    "policy | target [m] | throws | landing error [m] | duration [s] | landed | bias x / y [m]"
    " | smoothness | the paper's: error [m], duration [s]"
)


def format_paper_result(name: str, target: float) -> str:
    """Return the paper's error and duration as text, mean and standard deviation each, or "-"."""
    paper = PAPER.get((name, target))
    return "-" if paper is None else "{:.3f} ± {:.3f}, {:.3f} ± {:.3f}".format(*paper)


def markdown(rows: Sequence[dict], title: str) -> str:
    """Return a Markdown table of :meth:`visthrow.task.measurement.Throws.summary` with ``policy``
    and ``layout`` added.
    """
    return f"{title}\n\n{align(HEADER.split(' | '), [_cells(row) for row in rows], heads=1)}\n"


def _cells(row: dict) -> tuple[str, ...]:
    head = (row["policy"], f"{row['target']:.1f}", str(row["throws"]))
    paper = format_paper_result(row["layout"], row["target"])
    success = f"{100 * row['success']:.1f} %"
    if not row["success"]:
        return (*head, "-", "-", success, "-", "-", paper)
    error, duration = (
        f"{row[f'{name}_mean']:.3f} ± {row[f'{name}_std']:.3f}" for name in ("error", "duration")
    )
    return (
        *head,
        error,
        duration,
        success,
        f"{row['bias_x']:+.3f} / {row['bias_y']:+.3f}",
        f"{row['smoothness']:.3f}",
        paper,
    )


def csv_text(throws: Sequence[tuple[str, str, object]]) -> str:
    """Return CSV with one row for each throw; ``throws``: names of policy and plant, and
    :class:`visthrow.task.measurement.Throws`.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = (
        "policy, plant, target [m], throw, success, landing x [m], landing y [m],"
        " landing error [m], duration [s], clearance [m], smoothness"
    )
    writer.writerow(names.split(", "))
    for policy, plant, results in throws:
        measured = (results.error, results.duration, results.clearance, results.smoothness)
        numbers = np.column_stack([results.landing_w, *measured])
        for i, row in enumerate(numbers):
            cells = ("" if np.isnan(x) else f"{x:.6g}" for x in row)
            head = (policy, plant, results.target, i, int(results.success[i]))
            writer.writerow([*head, *cells])
    return text.getvalue()

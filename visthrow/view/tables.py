"""Tables of throws:

Markdown for people, CSV for programs. Every table says which plant it was measured on.
"""

import csv
import io
from collections.abc import Sequence

import numpy as np

from visthrow.view.parts import aligned

PAPER = {
    ("state", 1.5): (0.082, 0.035, 1.090, 0.009),
    ("state", 2.0): (0.105, 0.099, 1.154, 0.015),
    ("state", 2.5): (0.133, 0.082, 1.188, 0.015),
    ("vision", 1.5): (0.101, 0.058, 1.051, 0.011),
    ("vision", 2.0): (0.101, 0.106, 1.125, 0.029),
    ("TO+MPC", 1.5): (0.127, 0.019, 1.546, 0.010),
    ("TO+MPC", 2.0): (0.167, 0.033, 1.605, 0.016),
    ("TO+MPC", 2.5): (0.285, 0.026, 1.648, 0.012),
}
"""Layout and target -> landing error [m] and duration [s], mean and deviation, ten throws each
(Tables III and VI): policies on the paper's vehicle, the model-based TO+MPC in its own simulated
pendulum.
"""

PAPER_ABLATIONS = {
    "full": (0.105, 0.099, 1.154, 0.015, "groups about the target"),
    "no_aerodynamics": (0.342, 0.085, 1.069, 0.008, "undershoots"),
    "no_motor_lag": (0.254, 0.134, 1.109, 0.032, "undershoots"),
    "simple_controller": (0.386, 0.103, 1.115, 0.042, "overshoots, lateral bias"),
    "rigid_cable": (0.306, 0.051, 1.049, 0.009, "undershoots"),
}
"""Variant -> landing error [m] and duration [s], mean and deviation, and where the throws land:
five throws each of the paper's vehicle at 2.0 m, ten for the full model (Table V and the scatter
beside it).
"""

PAPER_NOTE = (
    "The paper's figures are ten throws a target, of a real vehicle for policies and in its own"
    " pendulum model for TO+MPC; ours are simulated. No vehicle was flown for this project, so the"
    " two columns do not measure the same thing."
)

COLUMNS = (
    "policy",
    "target [m]",
    "throws",
    "landing error [m]",
    "duration [s]",
    "landed",
    "bias x / y [m]",
    "smoothness",
    "the paper's: error [m], duration [s]",
)


def of_paper(name: str, target: float) -> str:
    """Return the paper's error and duration, mean and deviation, as text; "-" without them."""
    paper = PAPER.get((name, target))
    return "-" if paper is None else "{:.3f} ± {:.3f}, {:.3f} ± {:.3f}".format(*paper)


def markdown(rows: Sequence[dict], title: str) -> str:
    """Table of summaries, :meth:`visthrow.task.measurement.Throws.summary` with ``policy`` and
    ``layout`` added.
    """
    return f"{title}\n\n{aligned(COLUMNS, [_cells(row) for row in rows], heads=1)}\n"


def _cells(row: dict) -> tuple[str, ...]:
    head = (row["policy"], f"{row['target']:.1f}", str(row["throws"]))
    paper = of_paper(row["layout"], row["target"])
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
    """One row a throw, of policies' names, plants' names and
    :class:`visthrow.task.measurement.Throws`.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        [
            "policy",
            "plant",
            "target [m]",
            "throw",
            "success",
            "landing x [m]",
            "landing y [m]",
            "landing error [m]",
            "duration [s]",
            "clearance [m]",
            "smoothness",
        ]
    )
    for policy, plant, results in throws:
        for i in range(len(results.success)):
            numbers = (
                *results.landing_w[i],
                results.error[i],
                results.duration[i],
                results.clearance[i],
                results.smoothness[i],
            )
            writer.writerow(
                [
                    policy,
                    plant,
                    results.target,
                    i,
                    int(results.success[i]),
                    *("" if np.isnan(x) else f"{x:.6g}" for x in numbers),
                ]
            )
    return text.getvalue()

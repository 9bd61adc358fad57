"""Markdown, CSV and the picture of the front."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from visthrow.baseline.front import PAPER_FRONT, PAPER_TABLE, points_of
from visthrow.common import style
from visthrow.common.statistics import pareto
from visthrow.common.storage import atomic_write

PAPER_VEHICLE = {"state": (1.154, 0.105), "vision": (1.125, 0.101)}
"""The paper's policies on its vehicle at 2.0 m: duration [s] and landing error [m]. Nothing of ours was flown."""

NOTE = (
    "All our figures are simulated; the plant stands in each row. The paper's TO+MPC figures come from its own pendulum "
    "model, its policies' from a real vehicle. e_p and e_v: payload's position and velocity at separation against the "
    "plan; tracking: root mean square distance from the planned path until the release. Own-model throws vary in start "
    "only (position, velocity, attitude, cable; configs/start/hover.toml); on the plants noise, latency and extras vary too."
)


def _grid(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    widths = [max(len(r[i]) for r in [head, *rows]) for i in range(len(head))]
    line = lambda r: "| " + " | ".join(c.ljust(w) for c, w in zip(r, widths)) + " |"  # noqa: E731
    return "\n".join([line(head), "|" + "|".join("-" * (w + 2) for w in widths) + "|", *map(line, rows)])


def _pair(row: dict, name: str, scale: float = 1.0, digits: int = 3) -> str:
    if f"{name}_mean" not in row:
        return "-"
    return f"{scale * row[f'{name}_mean']:.{digits}f} ± {scale * row[f'{name}_std']:.{digits}f}"


def _row(row: dict) -> tuple[str, ...]:
    times = f"{row['step_p50_ms']:.1f} / {row['step_p99_ms']:.1f}" if "step_p50_ms" in row else "-"
    made_up = "-" if row["plant"] == "pendulum" else row["compensation"]
    return (
        row["plant"], made_up, f"{row['speed']:.2f}", f"{row['w_t']:g}", f"{row['rho']:g}",
        _pair(row, "error"), _pair(row, "duration"), _pair(row, "position_error", 100, 1), _pair(row, "velocity_error", 100, 1),
        _pair(row, "tracking", 100, 1), f"{100 * row['success']:.0f} %", times,
    )  # fmt: skip


_HEAD = ("plant", "made up for", "v [m/s]", "w_t", "rho", "error [m]", "duration [s]", "e_p [cm]", "e_v [cm/s]", "tracking [cm]",
         "landed", "step p50 / p99 [ms]")  # fmt: skip


def markdown(
    targets: Sequence[dict],
    swept: Sequence[dict],
    policies: Sequence[dict],
    sums: dict,
    throws: int,
    bounds: str = "payload and thrust",
) -> str:
    """All tables; ``bounds`` says what the plans bound."""
    parts = [f"# Trajectory optimisation and MPC: {throws} throws a row, bounds on {bounds}", NOTE, "## By target"]
    rows = []
    for row in targets:
        paper = PAPER_TABLE.get(row["target"]) if row["plant"] == "pendulum" else None
        beside = "-" if paper is None else f"{paper[0]:.3f} ± {paper[1]:.3f} m, {paper[2]:.3f} ± {paper[3]:.3f} s"
        rows.append((f"{row['target']:.1f}", *_row(row), beside))
    parts.append(_grid(("target [m]", *_HEAD, "paper's own model"), rows))
    if swept:
        parts += [f"## Sweep at {swept[0]['target']:.1f} m", _grid(_HEAD, [_row(row) for row in swept])]
        forms = ("{:g}", "{:g}", "{:g}", "{:.3f}", "{:.3f}", "{:.1f}", "{:.1f}")
        scales = (1, 1, 1, 1, 1, 100, 100)
        paper = [tuple(f.format(k * x) for f, k, x in zip(forms, scales, row)) for row in PAPER_FRONT]
        head = ("v [m/s]", "w_t", "rho", "error [m]", "duration [s]", "e_p [cm]", "e_v [cm/s]")
        parts += ["## The paper's front at 2.0 m (its own model)", _grid(head, paper)]
    if policies:
        rows = [(r["policy"], r["plant"], f"{r['throws']}", _pair(r, "error"), _pair(r, "duration")) for r in policies]
        parts += ["## Learnt policies", _grid(("policy", "plant", "throws", "error [m]", "duration [s]"), rows)]
    if sums:
        parts += ["## Front in figures", _sums(sums)]
    return "\n\n".join(parts) + "\n"


def _sums(sums: dict) -> str:
    rows = []
    for plant, item in sums.items():
        for key, value in item.items():
            rows.append((plant, key, f"{value:.4g}" if isinstance(value, float) else str(value)))
    return _grid(("plant", "figure", "value"), rows)


def csv_text(rows: Sequence[dict]) -> str:
    """One line a row, all its figures."""
    names = list(dict.fromkeys(key for row in rows for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)
    return text.getvalue()


def draw(
    path: str | Path, swept: Sequence[dict], policies: Sequence[dict], throws: int, bounds: str = "payload and thrust"
) -> None:
    """Draw duration against landing error of the sweep on each plant, with fronts, learnt policies and the paper's.

    Raises:
        StorageError: the place cannot be written.
    """
    style.use()
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(8.6, 5.2), layout="constrained")
    for i, plant in enumerate(dict.fromkeys(row["plant"] for row in swept)):
        points = points_of([row for row in swept if row["plant"] == plant])
        if not len(points):
            continue
        front = points[pareto(points)]
        label = f"TO+MPC, {SHORT.get(plant, plant)}" + ("" if plant == "pendulum" else ",\nall delays made up for")
        axis.plot(*points.T, style.MARKERS[i], color=style.COLOURS[i], ms=5, alpha=0.4, mew=0)
        axis.plot(*front.T, style.MARKERS[i] + "-", color=style.COLOURS[i], ms=5.5, lw=1.4, label=label)
    paper = np.array([(row[4], row[3]) for row in PAPER_FRONT])
    axis.plot(*paper.T, "x--", color=style.QUIET, ms=6, lw=1.2, label="TO+MPC, the paper's own pendulum")
    for i, row in enumerate(policies):
        colour = style.COLOURS[3 + i % 3]
        label = f"learnt {row['policy']} policy, {SHORT.get(row['plant'], row['plant'])}"
        axis.plot(
            row["duration_mean"],
            row["error_mean"],
            "*",
            color=colour,
            ms=15,
            mec="white",
            mew=0.7,
            label=label,
            zorder=5,
        )
    real = np.array(list(PAPER_VEHICLE.values()))
    axis.plot(
        *real.T, "*", color=style.QUIET, ms=12, mec="white", ls="none", label="the paper's policies, real vehicle"
    )
    axis.set_yscale("log")
    axis.set_yticks(
        [t for t in (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)], ["0.001", "0.003", "0.01", "0.03", "0.1", "0.3", "1"]
    )
    axis.minorticks_off()
    axis.set(xlabel="from start to landing [s]", ylabel="mean landing error [m]")
    axis.grid(True)
    axis.set_title(
        f"Agility against accuracy at 2.0 m: {throws} throws a point, plans bound {bounds};\nlines join the best",
        loc="left",
    )
    axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8.5)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    plt.close(figure)
    atomic_write(path, buffer.getvalue())


SHORT = {
    "pendulum": "own pendulum (ideal)", "hybrid": "training simulator", "reference": "reference plant",
    "reference-realistic": "realistic reference",
}  # fmt: skip
"""Plant -> its name in the picture's legend."""

"""Section on the gap that vision leaves: curves of the shipped policies, and trainings with less or
other sight.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from visthrow.common import statistics as st
from visthrow.paper.report.result_set import ANY, SHIPPED, ResultSet, errors, landed
from visthrow.paper.report.throws import SHORT
from visthrow.throws.results import Result
from visthrow.view import figures, parts
from visthrow.view.parts import Grid, Picture, Section, Text

PLANT = "hybrid"
TARGET = 2.0


@dataclass(frozen=True)
class GapSweep:
    """One value of the config, changed alone."""

    key: str
    title: str
    xlabel: str
    own: float  # in the units of the axis; the value that both policies are flown with
    scale: Callable[[Any], float] = float
    policies: tuple[str, ...] = ("vision",)


SWEEPS = (
    GapSweep(
        "camera.noise.step_std", "keypoint noise", "per step, 1 at the edge of the image", 0.01
    ),
    GapSweep(
        "camera.noise.bias_std", "keypoint bias", "per throw, 1 at the edge of the image", 0.001
    ),
    GapSweep(
        "camera.noise.latency",
        "latency of the keypoints",
        "[ms] behind the vehicle's own pose",
        0.0,
        lambda x: 20.0 * x,
    ),
    GapSweep("camera.noise.drop_probability", "drop-out", "share of keypoints lost", 0.0),
    GapSweep(
        "camera.mount.rotation_error_std",
        "camera turned",
        "[deg] per axis, standard deviation",
        0.0,
        math.degrees,
    ),
    GapSweep(
        "camera.mount.position_error_std",
        "camera displaced",
        "[mm] per axis, standard deviation",
        0.0,
        lambda x: 1e3 * x,
    ),
    GapSweep(
        "task.observation.latency",
        "age of all poses",
        "[ms]",
        10.0,
        lambda x: 500.0 * (x[0] + x[1]),
        SHIPPED,
    ),
    GapSweep(
        "task.noise.observation_step",
        "noise of the vehicle's pose",
        "per step, SI units",
        0.01,
        float,
        SHIPPED,
    ),
)
"""What was swept; values of the lists ``gap`` and ``quick``."""

TRAINED = {
    "no_validity": "no validity bits",
    "history_0": "no history",
    "history_1": "history of 1",
    "history_2": "history of 2",
    "full": "full: history of 3, 220 deg, validity",
    "history_6": "history of 6",
    "fov_120": "field of view 120 deg",
    "fov_150": "field of view 150 deg",
    "fov_180": "field of view 180 deg",
    "no_latency": "poses without age in training",
}
"""Variant of a vision training -> its name, in the order of the table."""


def section(thrown: ResultSet) -> Section:
    """Curves, what stands behind them, and the trainings."""
    panels = []
    rows = []
    missing = []
    for sweep in SWEEPS:
        lines = []
        for series, policy in enumerate(SHIPPED[::-1]):
            if policy in sweep.policies:
                points = curve(thrown, sweep, policy)
                if len(points) > 1:
                    lines.append(_line(sweep, policy, points, series))
                    rows += _rows(sweep, policy, points)
        if not lines:
            missing.append(sweep.title)
        panels.append(figures.Panel(sweep.title, sweep.xlabel, tuple(lines), "not thrown yet"))
    content = [
        Text(
            "The shipped policies are flown in the training simulator at 2.0 m with one value"
            " changed and everything else as it is flown. Nothing is retrained. `vision` saw late,"
            " lost and wrong keypoints in its training. Rings mark the policies' own value, bands"
            " are 95 % intervals over throws."
        )
    ]
    if rows:
        text = "Mean landing error of the throws that landed, against one imperfection at a time."
        head = (
            "imperfection",
            "value",
            "policy",
            "throws",
            "landed",
            "landing error [m]",
            "added to its own [m]",
        )
        curves = Picture("gap", figures.curves(panels, "landing error [m]", log=True), text)
        content += [curves, Grid("The curves in figures", head, tuple(rows))]
    return parts.section(
        "gap", "What vision costs, and why", *content, *_trained(thrown, missing), missing=missing
    )


def curve(thrown: ResultSet, sweep: GapSweep, policy: str) -> list[tuple[float, Result]]:
    """Points of a curve, the policy's own value among them: value in the axis' units and throws,
    ascending.
    """
    points = {
        round(sweep.scale(value), 9): r
        for value, r in thrown.by_departure(policy, sweep.key, PLANT, TARGET)
        if r.good.any()
    }
    nominal = thrown.shipped(policy, PLANT, TARGET)
    if nominal is not None and points:
        points[sweep.own] = nominal
    return sorted(points.items())


def _line(
    sweep: GapSweep, policy: str, points: list[tuple[float, Result]], series: int
) -> figures.Line:
    nominal = next((i for i, (value, _) in enumerate(points) if value == sweep.own), None)
    intervals = [st.mean(r.of("error")) for _, r in points]
    return figures.Line(
        f"{policy} policy", [value for value, _ in points], intervals, series, nominal
    )


def _rows(
    sweep: GapSweep, policy: str, points: list[tuple[float, Result]]
) -> list[tuple[str, ...]]:
    nominal = dict(points).get(sweep.own)
    rows = []
    for value, r in points:
        if r is nominal:
            added = "its own"
        elif nominal is None:
            added = "-"
        else:
            added = st.difference(errors([r]), errors([nominal])).text(sign=True)
        rows.append(
            (
                f"{sweep.title}, {sweep.xlabel}",
                f"{value:.3g}",
                policy,
                str(len(r.good)),
                landed(r),
                st.mean(r.of("error")).text(),
                added,
            )
        )
    return rows


def _trained(thrown: ResultSet, missing: list[str]) -> list:
    """Vision policies that were trained with other sight, each in its own simulator and on the
    reference plant.
    """
    marks = []
    rows = []
    plants = ("hybrid", "reference-realistic")
    for series, plant in enumerate(plants):
        full = thrown.seeds("vision", "full", plant, TARGET, {})
        for variant, title in TRAINED.items():
            # a reference plant is what it is, whatever the training had
            nominal = {} if plant == "hybrid" else ANY
            if variant == "full":
                results = full
            else:
                results = thrown.seeds("vision", variant, plant, TARGET, nominal)
            if not results:
                missing.append(f"trained with {title} ({SHORT[plant]})")
                continue
            error = st.mean(errors(results))
            marks.append(figures.Mark(title, error, series))
            if variant == "full" or not full:
                ratio = "-"
            else:
                ratio = st.ratio(errors(results), errors(full)).text(2)
            rows.append(
                (title, SHORT[plant], str(len(results)), landed(*results), error.text(), ratio)
            )
    if not rows:
        return []
    order = list(TRAINED.values())
    marks.sort(key=lambda mark: order.index(mark.label))
    rows.sort(key=lambda row: order.index(row[0]))
    head = ("trained with", "plant", "trainings", "landed", "landing error [m]", "ratio to full")
    text = (
        "Vision policies trained with other sight; 95 % intervals, over throws alone where there is"
        " one training."
    )
    return [
        Picture(
            "gap_trained",
            figures.marks(marks, "landing error at 2.0 m [m]", [SHORT[p] for p in plants]),
            text,
        ),
        Grid("Trained with other sight", head, tuple(rows)),
    ]

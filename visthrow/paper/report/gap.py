"""Section on the gap between vision and state: the shipped policies with imperfect vision, and
policies that were trained with different vision.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from visthrow.common import statistics as st
from visthrow.paper.report import charts
from visthrow.paper.report.result_set import (
    ANY,
    SHIPPED,
    SHORT,
    WORDS,
    Points,
    ResultSet,
    cells,
    errors,
    line,
)
from visthrow.view import parts
from visthrow.view.parts import Grid, Picture, Section, Text

PLANT = "hybrid"
TARGET = 2.0


@dataclass(frozen=True)
class GapSweep:
    """A sweep of a single value of the config."""

    key: str
    title: str
    xlabel: str
    trained_at: float  # value under which both policies are flown, in units of the axis
    scale: float = 1.0  # factor from the config to the axis; for a range its mean is used
    policies: tuple[str, ...] = ("vision",)


SWEEPS = tuple(GapSweep(**table) for table in WORDS["sweeps"])
"""The sweeps; their values are those of the lists ``gap`` and ``quick``."""

TRAINED: dict[str, str] = WORDS["trained"]
"""Variant of a vision training -> its name, in the order of the table."""


def section(thrown: ResultSet) -> Section:
    """Return the section with the curves, their figures, and the trainings."""
    panels = []
    rows = []
    missing = []
    for sweep in SWEEPS:
        lines = []
        for series, policy in enumerate(SHIPPED[::-1]):
            points = curve(thrown, sweep, policy) if policy in sweep.policies else []
            if len(points) > 1:
                lines.append(line(f"{policy} policy", points, series, sweep.trained_at))
                rows += _rows(sweep, points)
        if not lines:
            missing.append(sweep.title)
        panels.append(charts.Panel(sweep.title, sweep.xlabel, tuple(lines), "not thrown yet"))
    content = [
        Text(
            "The shipped policies are flown in the training simulator at 2.0 m with one value"
            " changed. Nothing is retrained. `vision` was trained with late, lost and wrong"
            " keypoints. Rings mark the policies' own value, bands are 95 % intervals over throws."
        )
    ]
    if rows:
        text = "Mean landing error of the throws that landed, against one imperfection at a time."
        header = (
            "imperfection | value | policy | throws | landed | landing error [m]"
            " | added to its own [m]"
        )
        curves = Picture("gap", charts.curves(panels, "landing error [m]", log=True), text)
        content += [curves, Grid.from_rows("The curves in figures", header, rows)]
    return parts.section(
        "gap",
        "What vision costs, and why",
        *content,
        *_list_trained(thrown, missing),
        missing=missing,
    )


def curve(thrown: ResultSet, sweep: GapSweep, policy: str) -> Points:
    """Return the points of a curve, including the policy's own value: value in units of the axis,
    ascending, and throws.
    """
    points = {
        round(sweep.scale * float(np.mean(value)), 9): r
        for value, r in thrown.throws_by_value(policy, sweep.key, PLANT, TARGET)
    }
    nominal = thrown.shipped_throws(policy, PLANT, TARGET)
    if nominal is not None and points:
        points[sweep.trained_at] = nominal
    return sorted(points.items())


def _rows(sweep: GapSweep, points: Points) -> Iterator[dict[str, str]]:
    nominal = dict(points).get(sweep.trained_at)
    for value, r in points:
        added = "its own" if r is nominal else "-"
        if nominal is not None and r is not nominal:
            added = st.difference(errors([r]), errors([nominal])).text(sign=True)
        row = cells(r) | {"value": f"{value:.3g}", "added to its own [m]": added}
        yield row | {"imperfection": f"{sweep.title}, {sweep.xlabel}"}


def _list_trained(thrown: ResultSet, missing: list[str]) -> list:
    """Return picture and table of vision policies that were trained with different vision, in their
    own simulator and on the reference plant.
    """
    marks = []
    rows = []
    plants = ("hybrid", "reference-realistic")
    for (variant, title), (series, plant) in product(TRAINED.items(), enumerate(plants)):
        full = thrown.seeds("vision", "full", plant, TARGET, {})
        # the reference plant is the same for all trainings, so any departures are accepted
        nominal = {} if plant == "hybrid" or variant == "full" else ANY
        results = thrown.seeds("vision", variant, plant, TARGET, nominal)
        if not results:
            missing.append(f"trained with {title} ({SHORT[plant]})")
            continue
        marks.append(charts.Mark(title, st.mean(errors(results)), series))
        row = cells(*results) | {"trained with": title}
        if variant != "full" and full:
            row["ratio to full"] = st.ratio(errors(results), errors(full)).text(2)
        rows.append(row)
    if not rows:
        return []
    header = "trained with | plant | trainings | landed | landing error [m] | ratio to full"
    text = (
        "Vision policies trained with different vision; 95 % intervals, only over throws if there"
        " is one training."
    )
    axis = "landing error at 2.0 m [m]"
    picture = charts.marks(marks, axis, [SHORT[plant] for plant in plants])
    return [
        Picture("gap_trained", picture, text),
        Grid.from_rows("Trained with different vision", header, rows),
    ]

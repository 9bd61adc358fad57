"""Draw the report's pictures (intervals, fronts, curves) in the style of
:mod:`visthrow.view.style`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy import ndarray

from visthrow.common.statistics import Interval
from visthrow.paper.baseline.front import pareto
from visthrow.view import style
from visthrow.view.figures import LOOKS, WIDTH, label_axes, look_of, panel_axes
from visthrow.view.parts import png_of


@dataclass(frozen=True)
class Mark:
    """A value with its interval, and that of the paper."""

    label: str
    interval: Interval
    series: int  # index of colour and marker
    paper: Interval | None = None


@dataclass(frozen=True)
class Line:
    """A curve with a band."""

    label: str
    x: Sequence[float]
    intervals: Sequence[Interval]
    series: int = 0
    trained_at: int | None = None  # index of the point at the policy's own value


@dataclass(frozen=True)
class Panel:
    """Axes of one picture."""

    title: str
    xlabel: str
    lines: tuple[Line, ...]
    missing: str = ""  # text of a panel without lines


@dataclass(frozen=True)
class Trade:
    """Durations and errors on one plant."""

    title: str
    # series, label, points (N, 2): duration [s], error [m]
    fronts: tuple[tuple[int, str, ndarray], ...]
    stars: tuple[tuple[str, Interval, Interval], ...]  # label, duration [s], error [m]
    crosses: tuple[tuple[str, ndarray], ...]  # label, the paper's points (N, 2)


def marks(
    rows: Sequence[Mark],
    xlabel: str,
    series: Sequence[str],
    zero: float | None = None,
    log: bool = False,
) -> bytes:
    """Draw values with intervals below each other, crosses for the paper's values, and a line at
    ``zero``, the value of no difference; return a PNG.
    """
    names = list(dict.fromkeys(row.label for row in rows))
    count = len({row.series for row in rows})
    height = 1.2 + 0.26 * len(names) * max(1.0, 0.55 * count)
    figure, axis = style.single((WIDTH, height))
    handles = {}
    for row in rows:
        (colour, marker) = look_of(row.series)
        value = row.interval
        paper = row.paper
        y = -names.index(row.label) - 0.2 * (row.series - 0.5 * (count - 1))
        axis.plot([value.low, value.high], [y, y], "-", color=colour, **LOOKS["interval"])
        handles[row.series] = axis.plot(value.value, y, marker, color=colour, **LOOKS["value"])[0]
        if paper is not None:
            ends = [max(paper.low, 0.1 * paper.value) if log else paper.low, paper.high]
            axis.plot(ends, [y + 0.14] * 2, "-", **LOOKS["paper_interval"])
            handles[len(series)] = axis.plot(paper.value, y + 0.14, "x", **LOOKS["paper_value"])[0]
    if zero is not None:
        axis.axvline(zero, **LOOKS["zero"])
    if log:
        _log_axis(axis, "x")
    axis.set_yticks([-i for i in range(len(names))], names)
    axis.set_ylim(-len(names) + 0.45, 0.55)
    axis.tick_params(axis="y", length=0)
    axis.grid(True, axis="x")
    axis.set_axisbelow(True)
    axis.set_xlabel(xlabel)
    if len(handles) > 1:
        keys = sorted(handles)
        names = [*series, "the paper's vehicle"]
        figure.legend(
            [handles[key] for key in keys], [names[key] for key in keys], loc="outside right upper"
        )
    return png_of(figure)


def _log_axis(axis, name: str) -> None:
    axis.set(**{f"{name}scale": "log"})
    which = getattr(axis, f"{name}axis")
    which.get_major_locator().set_params(subs=(1.0, 2.0, 5.0))
    which.set_major_formatter("{x:g}")
    which.set_minor_formatter("")


def _stars(axis: Any, stars: Sequence[tuple]) -> dict[str, object]:
    """Draw policies with their intervals, (label, duration, error) each; return the legend's
    entries.
    """
    labels: dict[str, object] = {}
    for i, (label, duration, error) in enumerate(stars):
        colour = style.COLOURS[3 + i]
        bar = {"color": colour, **LOOKS["bar"]}
        axis.plot([duration.value] * 2, [error.low, error.high], "-", **bar)
        axis.plot([duration.low, duration.high], [error.value] * 2, "-", **bar)
        star = {"color": colour, **LOOKS["star"]}
        (labels[label],) = axis.plot(duration.value, error.value, "*", **star)
    return labels


def trades(panels: Sequence[Trade]) -> bytes:
    """Draw agility against accuracy with one panel for each plant and lines through the Pareto
    fronts; return a PNG.
    """
    figure, axes = panel_axes(len(panels), len(panels), WIDTH, 5.2, 0.0, sharex=True)
    labels: dict[str, object] = {}
    for axis, panel in zip(axes[0], panels):
        for series, label, points in panel.fronts:
            colour, marker = look_of(series)
            best = points[pareto(points)]
            axis.plot(*points.T, marker, color=colour, **LOOKS["settings"])
            labels[label] = axis.plot(*best.T, marker + "-", color=colour, **LOOKS["front"])[0]
        for label, points in panel.crosses:
            look = LOOKS["paper_stars" if len(points) <= 2 else "paper_front"]
            labels[label] = axis.plot(*points.T, **look)[0]
        labels |= _stars(axis, panel.stars)
        empty = [label for _, label, points in panel.fronts if not len(points)]
        if empty or not panel.fronts:
            caption = "not swept yet"
            if empty:
                caption = "no setting landed all its throws:\n" + "\n".join(empty)
            axis.text(0.03, 0.02, caption, transform=axis.transAxes, **LOOKS["remark"])
        axis.set_title(panel.title, fontsize=10.5)
        axis.set_xlabel("from start to landing [s]")
        _log_axis(axis, "y")
        axis.grid(True, which="major")
    axes[0, 0].set_ylabel("mean landing error [m]")
    figure.legend(labels.values(), labels.keys(), loc="outside lower center", ncols=2, fontsize=9)
    return png_of(figure)


def curves(panels: Sequence[Panel], ylabel: str, log: bool = False) -> bytes:
    """Draw curves with bands of their intervals, with the same scale in all panels and a ring at
    the policy's own value; return a PNG.
    """
    columns = min(3, len(panels))
    figure, axes = panel_axes(
        len(panels), columns, WIDTH if columns > 1 else 0.62 * WIDTH, 2.75, 0.4
    )
    labels: dict[str, object] = {}
    for axis, panel in zip(axes.flat, panels):
        for line in panel.lines:
            labels.setdefault(line.label, _curve(axis, line))
        if not panel.lines:
            text = panel.missing or "no results"
            axis.text(0.5, 0.5, text, transform=axis.transAxes, **LOOKS["missing"])
        axis.set_title(panel.title, fontsize=10.5)
        axis.set_xlabel(panel.xlabel)
        axis.grid(True)
        axis.set_axisbelow(True)
        if log:
            _log_axis(axis, "y")
        else:
            axis.set_ylim(bottom=0.0)
    label_axes(axes, None, ylabel)
    if len(labels) > 1:
        limit = 4 if columns > 1 else 2
        how = {"loc": "outside upper center", "ncols": min(len(labels), limit)}
        figure.legend(labels.values(), labels.keys(), **how)
    return png_of(figure)


def _curve(axis, line: Line):
    colour, marker = look_of(line.series)
    x = np.asarray(line.x, dtype=float)
    low, value, high = np.array([(i.low, i.value, i.high) for i in line.intervals]).T
    axis.fill_between(x, low, high, color=colour, **LOOKS["band"])
    (curve_line,) = axis.plot(x, value, marker + "-", color=colour, **LOOKS["curve"])
    if line.trained_at is not None:
        axis.plot(x[line.trained_at], value[line.trained_at], "o", **LOOKS["own"])
    return curve_line


def draw_learning(groups: Sequence[tuple[str, Sequence[ndarray]]]) -> bytes:
    """Draw landing errors during training with one panel for each group; return a PNG. A run has
    two rows: environment steps (N,) and errors (N,).
    """
    figure, axes = panel_axes(len(groups), min(6, len(groups)), WIDTH, 1.5, 0.3, sharex=True)
    for axis, (title, runs) in zip(axes.flat, groups):
        for i, run in enumerate(runs):
            colour, _ = look_of(i)
            axis.plot(run[0] / 1e6, run[1], color=colour, lw=1.2)
        _log_axis(axis, "y")
        axis.set_title(title, fontsize=7.5)
        axis.tick_params(labelsize=7.5)
        axis.grid(True, which="major")
    label_axes(axes, "million steps", "error [m]", fontsize=8)
    return png_of(figure)

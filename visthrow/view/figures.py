"""Draw landing points, and lay out pictures with several panels, in the style of
:mod:`visthrow.view.style`.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy import ndarray

from visthrow.common.toml_text import tables_beside
from visthrow.view import style
from visthrow.view.parts import png_of

WIDTH = 9.2  # width of a picture that fills the page [inch]


LOOKS = style.looks_of(tables_beside(__file__, "data/looks.toml"))
"""Part of a picture -> matplotlib's keywords."""

CIRCLES = (0.1, 0.2, 0.4)  # radii of circles about the target in scatter panels [m]


def look_of(series: int) -> tuple[str, str]:
    """Return colour and marker of a series."""
    return style.COLOURS[series % len(style.COLOURS)], style.MARKERS[series % len(style.MARKERS)]


def panel_axes(
    count: int, columns: int, width: float, height: float, margin: float, sharex: bool = False
) -> tuple[Any, Any]:
    """Return a figure with axes for ``count`` panels; ``width``: of the figure, ``height``: of each
    row, ``margin``: additional height [inch].
    """
    rows = -(-count // columns)
    size = (width, height * rows + margin)
    figure, axes = style.subplots(rows, columns, size, sharex=sharex, sharey=True)
    for axis in axes.flat[count:]:
        axis.set_visible(False)
    return figure, axes


def label_axes(axes: Any, below: str | None, ylabel: str, **look: Any) -> None:
    """Label the outer axes of a grid."""
    for axis in axes[-1] if below else ():
        axis.set_xlabel(below, **look)
    for axis in axes[:, 0]:
        axis.set_ylabel(ylabel, **look)


def scatter(
    panels: Sequence[tuple[str, Sequence[tuple[str, ndarray]]]],
    columns: int = 3,
    heading: str = "",
) -> bytes:
    """Draw landing points from above, with the direction of the throw upwards; return a PNG.

    A panel is a title and, for each colour, a label and landing points relative to the target,
    shape (N, 2) [m]: along the throw, and to the left."""
    sets = [points for _, series in panels for _, points in series if len(points)]
    reach = max((np.abs(points).max() for points in sets), default=0.2)
    half = float(np.clip(1.06 * reach, 0.12, 0.7))
    columns = min(columns, len(panels))
    size = WIDTH / max(columns, 3)
    wide, margin = (max(size * columns, 6.4), 1.1) if heading else (size * columns, 0.8)
    figure, axes = panel_axes(len(panels), columns, wide, size, margin, sharex=True)
    for axis, (title, series) in zip(axes.flat, panels):
        _target(axis, half)
        for i, (label, points) in enumerate(series):
            _landings(axis, points, half, i, label)
        axis.set(xlim=(-half, half), ylim=(-half, half), aspect="equal")
        axis.set_title(title, fontsize=10.5 if columns <= 3 else 8.5)
    label_axes(axes, "lateral, to the right [m]", "along the throw [m]")
    handles, labels = axes.flat[0].get_legend_handles_labels()
    if len(labels) > 1:
        figure.legend(
            handles,
            labels,
            loc=f"outside {'lower' if heading else 'upper'} center",
            ncols=min(len(labels), 3),
            markerscale=2.5,
            title="small marks: landings; large marks: their means",
        )
    if heading:
        figure.suptitle(heading, fontsize=11.5)
    return png_of(figure)


def _target(axis, half: float) -> None:
    from matplotlib.patches import Circle

    for radius in CIRCLES:
        if radius < half:
            axis.add_patch(Circle((0, 0), radius, **LOOKS["circle"]))
        if 0.3 * half < radius < half:
            place = (0.7071 * radius, -0.7071 * radius)
            axis.annotate(f"{radius:g} m", place, **LOOKS["circle_label"])
    axis.plot(0, 0, "+", **LOOKS["target"])
    axis.grid(True)
    axis.set_axisbelow(True)


def _landings(axis, points: ndarray, half: float, series: int, label: str) -> None:
    """Draw landing points, hollow at the edge if they are outside the panel, and their mean."""
    colour, marker = look_of(series)
    clipped = np.clip(points, -half, half)
    visible = np.all(clipped == points, axis=1)
    look = {"color": colour, "marker": marker, **LOOKS["landing"]}
    look["alpha"] = 0.8 if len(points) <= 40 else 0.35
    axis.scatter(-points[visible, 1], points[visible, 0], label=label, **look)
    out = clipped[~visible]
    look = {"edgecolor": colour, "marker": marker, **LOOKS["landing_outside"]}
    axis.scatter(-out[:, 1], out[:, 0], **look)
    if len(points):
        center = points.mean(0)
        axis.plot(-center[1], center[0], marker, color=colour, **LOOKS["landing_mean"])

"""Landing points from above, one panel a target, as in the paper's figure."""

import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from visthrow.common import style
from visthrow.common.storage import atomic_write

RADII = (0.1, 0.2)
"""Circles about the goal [m]."""

PANEL = 2.6
"""Side of a panel [inch]."""

LEGEND = 2.4
"""Width of an entry of the legend [inch]."""

LEAST_HALF_WIDTH, MOST_HALF_WIDTH = 0.25, 0.6
"""Of a panel [m]."""


def draw(path: str | Path, throws: Sequence[tuple[str, Sequence]], subtitle: str) -> None:
    """Draw the landing scatter.

    Args:
        path: PNG file.
        throws: for each policy its name and one :class:`visthrow.training.protocol.Throws` a target, the same targets for all.
        subtitle: plant and number of throws.

    Raises:
        StorageError: the place cannot be written.
    """
    style.use()
    import matplotlib.pyplot as plt

    targets = [of.target for of in throws[0][1]]
    half = _half_width(throws)
    panel = PANEL if len(targets) > 1 else 1.25 * PANEL
    width = max(0.95 + len(targets) * (panel + 0.6), 6.4)
    abreast = max(1, min(len(throws), int(width / LEGEND)))
    height = panel + 1.6 + 0.22 * (math.ceil(len(throws) / abreast) - 1)
    figure = plt.figure(figsize=(width, height))
    first = 0.5 * (width - len(targets) * (panel + 0.6) + 0.6) + 0.2
    for column, target in enumerate(targets):
        left = first + column * (panel + 0.6)
        axis = figure.add_axes((left / width, 0.58 / height, panel / width, panel / height))
        _goal(axis, half)
        for index, (name, row) in enumerate(throws):
            _points(axis, row[column], index, half, name if column == 0 else None)
        axis.set(xlim=(-half, half), ylim=(-half, half), aspect="equal")
        axis.set_title(f"target {target:.1f} m")
        axis.set_xlabel("lateral error, to the right [m]")
        if column == 0:
            axis.set_ylabel("error along the throw [m]")
    top = {"loc": "upper center", "bbox_to_anchor": (0.5, 1.0 - 0.3 / height), "columnspacing": 1.6}
    figure.legend(*figure.axes[0].get_legend_handles_labels(), ncols=abreast, **top)
    figure.suptitle(f"Landing points from above: {subtitle}", fontsize=11.5, y=1.0 - 0.1 / height, va="top")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    plt.close(figure)
    atomic_write(path, buffer.getvalue())


def _half_width(throws) -> float:
    off = [np.abs(of.landing_w - (of.target, 0.0)) for _, row in throws for of in row]
    largest = np.nanmax(np.concatenate([*off, [[0.0, 0.0]]]))
    return float(np.clip(1.08 * largest, LEAST_HALF_WIDTH, MOST_HALF_WIDTH))


def _goal(axis, half: float) -> None:
    from matplotlib.patches import Circle

    for radius in RADII:
        if radius < half:
            axis.add_patch(Circle((0, 0), radius, fill=False, color=style.QUIET, lw=0.9, ls=(0, (4, 3)), zorder=1))
            axis.annotate(
                f"{radius:g} m", (radius * 0.7071, -radius * 0.7071), xytext=(2, -2), textcoords="offset points",
                color=style.QUIET, fontsize=8, ha="left", va="top", zorder=2,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.85},
            )  # fmt: skip
    axis.plot(0, 0, "+", color=style.INK, ms=13, mew=1.6, zorder=4)
    axis.grid(True, zorder=0)
    axis.set_axisbelow(True)


def _points(axis, of, index: int, half: float, label: str | None) -> None:
    """Error along x upwards, y to the left as seen from above. Points outside the panel stand at its edge, hollow."""
    good = of.landing_w[of.success] - (of.target, 0.0)
    shown = np.clip(good, -half, half)
    inside = np.all(shown == good, axis=1)
    colour, marker = style.COLOURS[index % len(style.COLOURS)], style.MARKERS[index % len(style.MARKERS)]
    alpha = 0.75 if len(good) <= 60 else 0.5
    common = {"marker": marker, "zorder": 3}
    filled = {"s": 20, "color": colour, "alpha": alpha, "lw": 0.3, "edgecolor": "white", "label": label}
    hollow = {"s": 24, "facecolor": "none", "edgecolor": colour, "clip_on": False}
    axis.scatter(-good[inside, 1], good[inside, 0], **common, **filled)
    axis.scatter(-shown[~inside, 1], shown[~inside, 0], **common, **hollow)

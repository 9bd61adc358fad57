"""The common style of all pictures, with colours that colour-blind readers can distinguish.

Source: Okabe and Ito, Color Universal Design, 2008, for the colours.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Colours of series, in order."""

MARKERS = ("o", "^", "s", "D", "v", "P")  # of series, so that colour is not the only distinction

INK = "#222222"
QUIET = "#767676"
FAINT = "#D9D9D9"
VEHICLE = "#3A3F47"
ROPE = "#8A6D3B"
PAYLOAD = "#D55E00"
GOAL = "#009E73"
FRONT = COLOURS[0]  # rotors
REAR = "#9AA5B1"
BEFORE = COLOURS[1]  # the plain model
AFTER = COLOURS[0]  # the model with a diagnosis's effects


def looks_of(tables: Mapping[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return matplotlib's keywords for each part of a picture.

    ``tables``: table of each part, in which a colour may be a name in this module, and ``ls`` a
    list with the lengths of dash and gap."""
    looks = {}
    for part, table in tables.items():
        look = dict(table)
        for key in look.keys() & {"color", "mec"}:
            look[key] = globals().get(look[key], look[key])
        if isinstance(look.get("ls"), list):
            look["ls"] = (0, tuple(look["ls"]))
        looks[part] = look
    return looks


def use() -> None:
    """Configure matplotlib for files in this style; call it before the first figure."""
    import matplotlib.style

    matplotlib.use("Agg")
    matplotlib.style.use(Path(__file__).with_name("data") / "pictures.mplstyle")


def subplots(rows: int, columns: int, size: tuple[float, float], **how: Any) -> tuple[Any, Any]:
    """Return a figure in this style and its axes, shape (rows, columns); ``size``: width and height
    [inch].
    """
    use()
    import matplotlib.pyplot as plt

    how = {"layout": "constrained", "squeeze": False, **how}
    return plt.subplots(rows, columns, figsize=size, **how)


def single(size: tuple[float, float]) -> tuple[Any, Any]:
    """Return a figure in this style and its single axes; ``size``: width and height [inch]."""
    figure, axes = subplots(1, 1, size)
    return figure, axes[0, 0]

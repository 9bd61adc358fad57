"""One look for all pictures: sizes, greys, and colours that are told apart by colour-blind readers.

Source: Okabe and Ito, Color Universal Design, 2008, for the eight colours.
"""

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Colours of compared things, in order."""

MARKERS = ("o", "^", "s", "D", "v", "P")  # beside the colour, so that it never stands alone

INK = "#222222"
QUIET = "#767676"
FAINT = "#D9D9D9"
VEHICLE = "#3A3F47"
ROPE = "#8A6D3B"
PAYLOAD = "#D55E00"
GOAL = "#009E73"


def use() -> None:
    """Set matplotlib to draw files in this style; call it before the first figure."""
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams.update(
        {
            "font.family": "DejaVu Sans",
            "font.size": 10,
            "axes.titlesize": 11,
            "axes.labelsize": 10,
            "legend.fontsize": 9.5,
            "legend.frameon": False,
            "axes.edgecolor": QUIET,
            "axes.labelcolor": INK,
            "text.color": INK,
            "xtick.color": QUIET,
            "ytick.color": QUIET,
            "xtick.labelcolor": INK,
            "ytick.labelcolor": INK,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.linewidth": 0.8,
            "grid.color": FAINT,
            "grid.linewidth": 0.7,
            "savefig.dpi": 160,
            "figure.facecolor": "white",
        }
    )

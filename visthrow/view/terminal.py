"""Plots in characters, for a terminal that has nothing else: a curve over time, points about a
target. No escape codes.
"""

import math
from collections.abc import Sequence

RISES = (
    0.01,
    0.02,
    0.03,
    0.05,
    0.1,
    0.2,
    0.3,
    0.5,
    1.0,
    2.0,
    3.0,
    5.0,
)  # values that an axis may end at [m]


def curve(
    rows: Sequence[tuple[str, Sequence[tuple[float, float]]]], width: int, height: int, unit: str
) -> list[str]:
    """Values over time on a logarithmic axis, a mark a series; later series over earlier ones.

    Returns ``height + 2`` lines.

    Args:
        rows: mark and (time [s], value) of each series; values that are not finite or not above 0
            are left out.
        width, height: of the plot without its labels, in characters. unit: of the values, for the
            axis.
    """
    points = [
        (mark, t, v) for mark, series in rows for t, v in series if math.isfinite(v) and v > 0.0
    ]
    values = [v for _, _, v in points] or [1.0]
    top = next((rise for rise in RISES if rise >= max(values)), max(values))
    bottom = next((rise for rise in reversed(RISES) if rise <= min(values)), min(values))
    bottom = min(bottom, 0.5 * top)
    end = max([t for _, t, _ in points] or [1.0])
    grid = [[" "] * width for _ in range(height)]
    for mark, t, v in points:
        row = round((height - 1) * math.log(top / v) / math.log(top / bottom))
        grid[min(max(row, 0), height - 1)][
            min(int(width * t / end), width - 1) if end > 0 else 0
        ] = mark
    levels = [top * (bottom / top) ** (i / (height - 1)) for i in range(height)]
    ticks = {0, height // 2, height - 1}
    lines = [
        f"{f'{level:.3g}' if i in ticks else '':>6} |{''.join(cells)}"
        for i, (level, cells) in enumerate(zip(levels, grid))
    ]
    span = f"{end:.0f} s" if end < 600 else f"{end / 60:.0f} min"
    return [*lines, f"{unit:>6} +{'-' * width}", f"{'':>8}0{span:>{width - 1}}"]


def scatter(
    points: Sequence[tuple[float, float]], reach: float, width: int, height: int
) -> list[str]:
    """Points (to the right, up) of the middle [m], from above: how many lie in each cell, 9 for
    more, + where the middle is free.

    The reach is half of the square that is shown [m]; points beyond it stand at the edge. Returns
    ``height + 2`` lines."""
    counts = [[0] * width for _ in range(height)]
    for right, up in points:
        column = min(max(int((right / reach + 1.0) * width / 2.0), 0), width - 1)
        row = min(max(int((1.0 - up / reach) * height / 2.0), 0), height - 1)
        counts[row][column] += 1
    middle = (height // 2, width // 2)
    cells = [
        "".join(
            str(min(n, 9)) if n else "+" if (i, j) == middle else " " for j, n in enumerate(row)
        )
        for i, row in enumerate(counts)
    ]
    edge = f"+{'-' * width}+"
    return [edge, *(f"|{row}|" for row in cells), edge]


def side_by_side(first: Sequence[str], right: Sequence[str], gap: int = 3) -> list[str]:
    """Two blocks of lines next to each other."""
    rows = max(len(first), len(right))
    width = max(map(len, first), default=0)
    padded = [(block[i] if i < len(block) else "") for block in (first, right) for i in range(rows)]
    return [f"{a:<{width}}{'':<{gap}}{b}".rstrip() for a, b in zip(padded[:rows], padded[rows:])]


def clock(seconds: float) -> str:
    """Return a duration as minutes and seconds, hours where there are any."""
    if not math.isfinite(seconds):
        return "-"
    minutes, seconds_left = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds_left:02d}" if hours else f"{minutes}:{seconds_left:02d}"

"""Text tables as laboratories export them (Motive, Vicon, Qualisys, TUM, EuRoC): which lines hold
numbers, what columns are called, in which units.

Tables of motion capture carry several lines above their numbers: settings, the name of a body, what
is measured of it, its unit. A table's numbers begin where rows of one width, mostly of numbers,
begin; lines of that width above them name the columns, the others are settings.

Source: exports of OptiTrack Motive 1.2x and 3 (CSV), Vicon Nexus and Tracker (CSV), Qualisys Track
Manager (TSV, 3D and 6D); trajectories of TUM (blank-separated) and EuRoC."""

import csv
import io
import re
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from visthrow.common.storage import count_lines
from visthrow.common.toml_text import tables_beside

MARKS = (",", ";", "\t", " ")
SAMPLED = 60  # lines of numbers from which the separator is determined
_UNIT_WORDS = tables_beside(__file__)
_NUMBER = re.compile(r"[-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?|[-+]?(nan|inf|infinity)", re.I)
_WORDS = ("true", "false")
_FRAME = re.compile(r"sub ?frame|frame( ?(number|no\.?|#))?|time.*|timestamp.*", re.I)
_IDS = re.compile(r"\d+|([0-9a-f]+:)?[0-9a-f]{8,}", re.I)
_KINDS = {"Type", "Parent", "Rigid Body", "Rigid Body Marker", "Marker", "Bone", "Bone Marker"}
"""Of Motive's assets: words of lines that name no column."""
_KEY = re.compile(r"[A-Z]+(_[A-Z]+)+|EVENT")  # first cell of a line of Qualisys' settings
SECTIONS = ("Objects", "Trajectories", "Segments", "Model Outputs", "Joints", "Devices")
"""Tables of a file of Vicon, each below its title; the first of these that is there is read."""
RATES = ("FREQUENCY", "Export Frame Rate", "Capture Frame Rate", "Frame Rate")
UNIT_OF_LENGTH = "Length Units"
TUM = "timestamp tx ty tz qx qy qz qw"
KITTI = "Rot[0] Rot[3] Rot[6] x Rot[1] Rot[4] Rot[7] y Rot[2] Rot[5] Rot[8] z"
"""Columns of trajectories that are written without a head; of matrices column after column."""


Rows = list[tuple[int, list[str]]]
"""Numbers of lines, and their cells."""


@dataclass
class TextTable:
    """A text table, its cells still text."""

    names: list[str]  # of the columns, with their unit in brackets where it is known
    rows: Rows
    comma: bool  # whether decimals are written with a comma
    settings: dict[str, str] = field(default_factory=dict)  # of the lines above
    rate: float = 0.0  # of the frames, where the table says it [Hz]
    left_out: list[str] = field(default_factory=list)  # other tables of the file


def is_number(cell: str) -> bool:
    """Tell whether a cell holds a number, with a point or a comma."""
    return bool(_NUMBER.fullmatch(cell.strip()))


def unit_of(word: str) -> str | None:
    """Our spelling of a unit, "" for what has none; None for a word that is no unit."""
    return _UNIT_WORDS.get(word.strip().strip("[]()").strip().lower())


def layout_of(text: str, name: str = "") -> TextTable:
    """Lay out a text table that messages call by a name; without a line of numbers its rows are
    empty.
    """
    mark = _separator(text.splitlines())
    blank = mark == " "
    rows, left_out = _section(_cells(text, mark, name))
    widths = Counter(len(cells) for _, cells in rows[-1000:] if _holds_numbers(cells))
    if not widths:
        return TextTable(rows[0][1] if rows else [], [], False)
    width = widths.most_common(1)[0][0]
    start = _find_first_row(rows, width)
    head = rows[:start]
    body = rows[start:]
    named, settings, rate = _sort_head(head, _names_start(rows, start), width, blank)
    unnamed = width > len(named[-1] if named else [])
    if unnamed and len(body) > 1 and all(cells[-1] == "" for _, cells in body):
        body = [(line, cells[:-1]) for line, cells in body]  # each line ends with a separator
        width -= 1
    names = _names(named, width, settings) if named else _marker_names(width, settings)
    names = names or _headless_names(body, width, blank)
    return TextTable(names, body, _commas(mark, body), settings, rate, left_out)


def _cells(text: str, mark: str, name: str) -> Rows:
    """Cells of each line that holds any."""
    blank = mark == " "
    lines = count_lines(io.StringIO(text, newline=""), len(text), name)
    reader = csv.reader(lines, delimiter=mark, skipinitialspace=blank)
    rows = []
    for cells in reader:
        cells = [cell.strip() for cell in cells]
        if blank and cells and cells[-1] == "":
            cells.pop()
        if any(cells):
            rows.append((reader.line_num, cells))
    return rows


def _find_first_row(rows: Rows, width: int) -> int:
    """Return the row at which the numbers begin: identifiers above them are numbers too, but three
    rows of numbers in a line are the table.
    """
    good = [_holds_numbers(cells) for _, cells in rows]
    fits = [len(cells) == width and valid for (_, cells), valid in zip(rows, good)]
    firm = (i for i in range(len(rows)) if fits[i] and all(good[i : i + 3]))
    return next(firm, fits.index(True))


def _names_start(rows: Rows, start: int) -> int:
    """Return the row at which the names of the columns begin: below the last empty line, if that
    does not stand between the names and the numbers.
    """
    below_gap = [i for i in range(1, start + 1) if rows[i][0] > rows[i - 1][0] + 1]
    return below_gap[-1] if below_gap and below_gap[-1] < start else 0


def _section(rows: Rows) -> tuple[Rows, list[str]]:
    """Return the table to read of a file that holds several, and what is left out."""
    titles = {cells[0].strip(): i for i, (_, cells) in enumerate(rows) if not any(cells[1:])}
    starts = {title: titles[title] for title in SECTIONS if title in titles}
    if len(starts) < 2:
        return rows, []
    chosen = next(iter(starts))
    end = min((start for start in starts.values() if start > starts[chosen]), default=len(rows))
    omitted = [f"the table {title}: {chosen} is read" for title in starts if title != chosen]
    return rows[starts[chosen] : end], omitted


def _separator(lines: list[str]) -> str:
    """Return the mark that cuts most lines into the same number of cells, most of them numbers."""
    sample = [line for line in lines[-2000:] if line.strip()][-SAMPLED:]
    return max(MARKS, key=lambda mark: round(_regularity(sample, mark), 6))


def _regularity(sample: list[str], mark: str) -> float:
    """Return the share of lines that a mark cuts into the usual number of cells, times the share of
    numbers in them; 0 where it cuts none.
    """
    rows = [next(csv.reader([line.strip()], delimiter=mark)) for line in sample]
    if mark == " ":
        rows = [[cell for cell in row if cell] for row in rows]
    if not rows:
        return 0.0
    width, count = Counter(map(len, rows)).most_common(1)[0]
    if width < 2:
        return 0.0
    whole = [cell for row in rows if len(row) == width for cell in row if cell.strip()]
    numbers = sum(map(is_number, whole)) / max(len(whole), 1)
    return numbers * count / len(rows) + 1e-3 * (mark == ";")


def _holds_numbers(cells: list[str]) -> bool:
    """Whether at least half of a line's filled cells are numbers or lists, one of the first three
    among them; behind more columns of text two thirds must be.
    """
    filled = [cell for cell in cells if cell]
    good = sum(
        is_number(cell) or cell.lower() in _WORDS or (cell[:1] in "[(" and cell[-1:] in "])")
        for cell in filled
    )
    early = any(map(is_number, (c.strip("[]() ") or c for c in filled[:3])))
    return 2 * good >= len(filled) > 0 and (early or 3 * good >= 2 * len(filled))


def _commas(mark: str, body: Rows) -> bool:
    cells = [cell for _, row in body[:SAMPLED] for cell in row]
    return (
        mark != ","
        and any("," in c and is_number(c) for c in cells)
        and not any("." in c and is_number(c) for c in cells)
    )


def _sort_head(
    head: Rows, cut: int, width: int, blank: bool
) -> tuple[list[list[str]], dict[str, str], float]:
    """Lines above the numbers: those that name columns, the settings, and the rate."""
    named = []
    settings: dict[str, str] = {}
    rate = 0.0
    for i, (_, cells) in enumerate(head):
        cells = _strip_comment(cells, width)
        if not any(cells):
            continue
        if cells.count("") == len(cells) - 1 and is_number("".join(cells)):
            rate = float("".join(cells))
        elif blank and len(cells) != width:
            settings[cells[0]] = " ".join(cells[1:])  # a sentence
        elif "NO_OF_FRAMES" in settings and _KEY.fullmatch(cells[0]):
            settings[cells[0]] = "\t".join(cells[1:])
        elif i >= cut and _names_columns(cells, width):
            named.append(cells + [""] * (width - len(cells)))
        else:
            settings |= dict(zip(cells[::2], cells[1::2]))
            settings.setdefault(cells[0], "")
    stated = (float(settings[key]) for key in RATES if is_number(settings.get(key, "")))
    return named, settings, rate or next(stated, 0.0)


def _names_columns(cells: list[str], width: int) -> bool:
    """Whether a line is as wide as the table, and fills more than half of it or starts blank."""
    count = sum(map(bool, cells))
    return len(cells) <= width and (count > width / 2 or not cells[0])


def _strip_comment(cells: list[str], width: int) -> list[str]:
    """Cells of a line of the head without the mark of a comment and surplus blanks at its end."""
    if cells[0].startswith(("#", "%")):
        first = cells[0].lstrip("#% ")
        cells = [first, *cells[1:]] if first else cells[1:]
    while len(cells) > width and not cells[-1]:
        cells.pop()
    return cells


def _names(named: list[list[str]], width: int, settings: dict[str, str]) -> list[str]:
    """Names of columns, of all lines that name them, unlike each other."""
    several = len(named) > 1
    units, parts = _units_and_words(named, width)
    final = next((row for row in reversed(named) if not _is_row_of_units(row)), named[-1])
    names = []
    for i, (last, words) in enumerate(zip(final, parts)):
        name = last if i == 0 or _FRAME.fullmatch(last) else ".".join(words)
        name = name.replace(":", ".") if several else name
        names.append(_join(name, units[i], settings))
    if "BODY_NAMES" in settings or "DATA_INCLUDED" in settings:
        names = _add_body_names(names)
    return [name or f"column {i}" for i, name in enumerate(names, start=1)]


def _units_and_words(named: list[list[str]], width: int) -> tuple[list[str], list[list[str]]]:
    """Return each column's unit, "" where no line says it, and the words that name it."""
    several = len(named) > 1
    units = [""] * width
    parts: list[list[str]] = [[] for _ in range(width)]
    for row in named:
        if several and _is_row_of_units(row):
            units = [unit_of(cell) or "" for cell in row]
        elif not _identifies(row, several):
            _add_names(parts, row)
    return units, parts


def _is_row_of_units(row: list[str]) -> bool:
    """Whether every filled cell of a row is a unit."""
    return all(unit_of(cell) is not None for cell in row if cell)


def _identifies(row: list[str], several: bool) -> bool:
    """Whether a row holds identifiers, or kinds of Motive's assets, and names nothing."""
    filled = [cell for cell in row if cell]
    numbers = len(filled) > 1 and all(_IDS.fullmatch(cell) for cell in filled[1:])
    return numbers or (several and bool(filled) and _KINDS.issuperset(filled))


def _add_names(parts: list[list[str]], row: list[str]) -> None:
    """Add a row's words to the names of their columns: where the row's first cell is empty, a
    body's name stands above the first of its columns alone.
    """
    last = ""
    for i, cell in enumerate(row):
        last = cell or ("" if row[0] else last)
        if last and last not in parts[i]:
            parts[i].append(last)


def _join(name: str, unit: str, settings: dict[str, str]) -> str:
    """Return a name with its unit; a subject that bears the name of its body is named once."""
    parts = name.split(".")
    name = ".".join(p for i, p in enumerate(parts) if i == 0 or p != parts[i - 1])
    if not unit and UNIT_OF_LENGTH in settings and "Position" in parts:
        unit = unit_of(settings[UNIT_OF_LENGTH]) or ""
    if (
        not unit
        and "Rotation" in parts
        and settings.get("Rotation Type", "Quaternion") != "Quaternion"
    ):
        unit = "deg"
    return f"{name} [{unit}]" if unit else name


def _add_body_names(names: list[str]) -> list[str]:
    """Qualisys' columns: the body's name stands before its first, and its lengths are in mm."""
    joined = []
    body = ""
    for name in names:
        head, _, tail = name.rpartition(" ")
        if head and tail in ("X", "Y", "Z"):
            body = head
            name = tail
        if body and not _FRAME.fullmatch(name):
            if name in ("X", "Y", "Z"):
                unit = "mm"
            elif name in ("Roll", "Pitch", "Yaw"):
                unit = "deg"
            else:
                unit = ""
            name = f"{body}.{name}" + (f" [{unit}]" if unit else "")
        joined.append(name)
    return joined


def _headless_names(body: Rows, width: int, blank: bool) -> list[str]:
    """Names of a trajectory without a head, known by what its numbers are: TUM's eight columns end
    in a unit quaternion xyzw, KITTI's twelve are a rotation matrix and a place, row by row.
    """
    cells = [row for _, row in body[:SAMPLED]]
    numbers = all(is_number(cell) and "," not in cell for row in cells for cell in row)
    if blank and numbers and width == 8:
        quat = np.array(cells, dtype=float)[:, 4:]
        if np.allclose(np.sum(quat**2, axis=1), 1.0, atol=0.01):
            return TUM.split()
    if blank and numbers and width == 12:
        turn = np.array(cells, dtype=float).reshape(-1, 3, 4)[:, :, :3]
        if np.allclose(turn @ turn.transpose(0, 2, 1), np.eye(3), atol=0.01):
            return KITTI.split()
    return [f"column {i}" for i in range(1, width + 1)]


def _marker_names(width: int, settings: dict[str, str]) -> list[str]:
    """Qualisys' 3D export may have no line of names, but the markers' names above it."""
    markers = [word for word in settings.get("MARKER_NAMES", "").split("\t") if word]
    before = ["Frame", "Time"][: width - 3 * len(markers)] if markers else []
    if not markers or len(before) + 3 * len(markers) != width:
        return []
    return before + [f"{marker}.{axis} [mm]" for marker in markers for axis in "XYZ"]

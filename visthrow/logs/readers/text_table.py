"""Layout of text tables of laboratories (Motive, Vicon, Qualisys, TUM, EuRoC): rows of numbers,
names and units of the columns.

Tables of motion capture have several lines above the numbers: settings, names of bodies, measured
quantities, units. The numbers begin at the first of several rows of equal width that consist mostly
of numbers. Lines of that width above them name the columns; the other lines are settings.

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
SAMPLED = 60  # number of last lines that determine the separator
_UNIT_WORDS = tables_beside(__file__)
_NUMBER = re.compile(r"[-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?|[-+]?(nan|inf|infinity)", re.I)
_WORDS = ("true", "false")
_FRAME = re.compile(r"sub ?frame|frame( ?(number|no\.?|#))?|time.*|timestamp.*", re.I)
_IDS = re.compile(r"\d+|([0-9a-f]+:)?[0-9a-f]{8,}", re.I)
_KINDS = {"Type", "Parent", "Rigid Body", "Rigid Body Marker", "Marker", "Bone", "Bone Marker"}
"""Words of Motive's lines on kinds of assets, which name no column."""
_KEY = re.compile(r"[A-Z]+(_[A-Z]+)+|EVENT")  # first cell of a line of Qualisys' settings
SECTIONS = ("Objects", "Trajectories", "Segments", "Model Outputs", "Joints", "Devices")
"""Titles of the tables in a file of Vicon, by priority: the first that exists is read."""
RATES = ("FREQUENCY", "Export Frame Rate", "Capture Frame Rate", "Frame Rate")
UNIT_OF_LENGTH = "Length Units"
TUM = "timestamp tx ty tz qx qy qz qw"
KITTI = "Rot[0] Rot[3] Rot[6] x Rot[1] Rot[4] Rot[7] y Rot[2] Rot[5] Rot[8] z"
"""Columns of trajectories without a header; the names of matrix elements count column by column."""


Rows = list[tuple[int, list[str]]]
"""Line number and cells of each row."""


@dataclass
class TextTable:
    """A text table, with its cells as text."""

    names: list[str]  # of the columns, with their unit in brackets if it is known
    rows: Rows
    comma: bool  # whether decimals have a comma
    settings: dict[str, str] = field(default_factory=dict)  # from the lines above the numbers
    rate: float = 0.0  # of the frames [Hz]; 0: unknown
    left_out: list[str] = field(default_factory=list)  # other tables of the file


def is_number(cell: str) -> bool:
    """Return whether a cell holds a number, with a decimal point or comma."""
    return bool(_NUMBER.fullmatch(cell.strip()))


def unit_of(word: str) -> str | None:
    """Return our spelling of a unit; "" for a quantity without unit, None if the word is no
    unit.
    """
    return _UNIT_WORDS.get(word.strip().strip("[]()").strip().lower())


def layout_of(text: str, name: str = "") -> TextTable:
    """Return the layout of a text table; ``name``: of the table in messages. Without a line of
    numbers, there are no rows.
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
        body = [(line, cells[:-1]) for line, cells in body]  # every line ends with a separator
        width -= 1
    names = _names(named, width, settings) if named else _marker_names(width, settings)
    names = names or _headless_names(body, width, blank)
    return TextTable(names, body, _commas(mark, body), settings, rate, left_out)


def _cells(text: str, mark: str, name: str) -> Rows:
    """Return the stripped cells of each line that is not blank."""
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
    """Return the index of the first row of numbers. Three rows of numbers in succession are needed,
    as identifiers above the table may be numbers too.
    """
    good = [_holds_numbers(cells) for _, cells in rows]
    fits = [len(cells) == width and valid for (_, cells), valid in zip(rows, good)]
    firm = (i for i in range(len(rows)) if fits[i] and all(good[i : i + 3]))
    return next(firm, fits.index(True))


def _names_start(rows: Rows, start: int) -> int:
    """Return the index of the row at which the names of the columns begin: the one after the last
    empty line, unless that line directly precedes the numbers.
    """
    below_gap = [i for i in range(1, start + 1) if rows[i][0] > rows[i - 1][0] + 1]
    return below_gap[-1] if below_gap and below_gap[-1] < start else 0


def _section(rows: Rows) -> tuple[Rows, list[str]]:
    """Return the rows of the table to be read from a file of several, and a text for each of the
    others.
    """
    titles = {cells[0].strip(): i for i, (_, cells) in enumerate(rows) if not any(cells[1:])}
    starts = {title: titles[title] for title in SECTIONS if title in titles}
    if len(starts) < 2:
        return rows, []
    chosen = next(iter(starts))
    end = min((start for start in starts.values() if start > starts[chosen]), default=len(rows))
    omitted = [f"the table {title}: {chosen} is read" for title in starts if title != chosen]
    return rows[starts[chosen] : end], omitted


def _separator(lines: list[str]) -> str:
    """Return the separator with the highest :func:`_regularity`."""
    sample = [line for line in lines[-2000:] if line.strip()][-SAMPLED:]
    return max(MARKS, key=lambda mark: round(_regularity(sample, mark), 6))


def _regularity(sample: list[str], mark: str) -> float:
    """Return the share of lines that a separator splits into the most frequent number of cells,
    times the share of numbers in these lines; 0 if it splits none.
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
    """Return whether at least half of a line's filled cells are numbers or lists; two thirds, if
    none of the first three is a number.
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
    """Return the lines above the numbers that name columns, the settings, and the rate [Hz]."""
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
    """Return whether a line names columns: it is at most as wide as the table, and more than half
    filled or with a blank first cell.
    """
    count = sum(map(bool, cells))
    return len(cells) <= width and (count > width / 2 or not cells[0])


def _strip_comment(cells: list[str], width: int) -> list[str]:
    """Return the cells of a header line without comment mark and without surplus blank cells."""
    if cells[0].startswith(("#", "%")):
        first = cells[0].lstrip("#% ")
        cells = [first, *cells[1:]] if first else cells[1:]
    while len(cells) > width and not cells[-1]:
        cells.pop()
    return cells


def _names(named: list[list[str]], width: int, settings: dict[str, str]) -> list[str]:
    """Return the names of the columns, composed from all lines that name them."""
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
    """Return the unit of each column ("" if unknown), and the words of its name."""
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
    """Return whether every filled cell of a row is a unit."""
    return all(unit_of(cell) is not None for cell in row if cell)


def _identifies(row: list[str], several: bool) -> bool:
    """Return whether a row holds identifiers or kinds of Motive's assets, and no names."""
    filled = [cell for cell in row if cell]
    numbers = len(filled) > 1 and all(_IDS.fullmatch(cell) for cell in filled[1:])
    return numbers or (several and bool(filled) and _KINDS.issuperset(filled))


def _add_names(parts: list[list[str]], row: list[str]) -> None:
    """Add the words of a row to the names of the columns, in place.

    If the row's first cell is empty, a word also applies to the blank cells after it: a body's name
    is above the first of its columns only."""
    last = ""
    for i, cell in enumerate(row):
        last = cell or ("" if row[0] else last)
        if last and last not in parts[i]:
            parts[i].append(last)


def _join(name: str, unit: str, settings: dict[str, str]) -> str:
    """Return a column's name with its unit in brackets, without repeated words: subject and body
    may have the same name.
    """
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
    """Return Qualisys' names with the body's name and the unit added to each of its columns.

    The body's name precedes the first of them only; lengths are in mm."""
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
    """Return the column names of a table without a header, recognised by its numbers: TUM's eight
    columns end in a unit quaternion xyzw; KITTI's twelve are rotation matrix and position, row by
    row.
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
    """Return the column names of Qualisys' 3D export without a line of names, from the setting
    ``MARKER_NAMES``; [] if it does not fit.
    """
    markers = [word for word in settings.get("MARKER_NAMES", "").split("\t") if word]
    before = ["Frame", "Time"][: width - 3 * len(markers)] if markers else []
    if not markers or len(before) + 3 * len(markers) != width:
        return []
    return before + [f"{marker}.{axis} [mm]" for marker in markers for axis in "XYZ"]

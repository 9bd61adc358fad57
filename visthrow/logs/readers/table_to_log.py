"""Conversion of CSV (plain, gzip, xz) and parquet tables to flight logs, by a mapping.

Our own exports need no mapping."""

import csv
import gzip
import json
import lzma
import math
import re
import zlib
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from visthrow.common.errors import LogError, suggest
from visthrow.common.rotations import (
    conjugate,
    multiply,
    quat_of_euler,
    quat_of_matrix,
    quat_of_vector,
)
from visthrow.common.storage import require_room, unpack
from visthrow.logs.axes import OURS, turn_of
from visthrow.logs.flightlog import STANDARD_CHANNELS, Channel, FlightLog
from visthrow.logs.mapping import ChannelMap, Split, TableMap, TimeColumn
from visthrow.logs.readers.text_table import TextTable, is_number, layout_of
from visthrow.logs.unit_names import to_si

Table = dict[str, np.ndarray]
"""Column -> values; numbers as float64 (NaN where the cell is empty), anything else as text."""

_EXPORTED = re.compile(
    r"(?P<name>\w+?)(?:\[(?P<index>[\d,]+)\])? \[(?P<unit>.+?)(?:,"
    r" (?P<frame>world|body|camera|image|mocap))?\]"
)
# larger numbers are invalid in any unit; the square of this one is still finite
_LARGEST = 1e100
_WORDS = {"True": 1.0, "False": 0.0}
_LIST = re.compile(r"[\[(].*[\])]")
_PARTS = re.compile(r"[,;\s]+")
_OPENERS = {".gz": gzip.open, ".xz": lzma.open}


class Columns(dict[str, np.ndarray]):
    """Columns of a table by name, with settings of the file.

    Attributes:
        left_out: Parts of the file that are not among the columns, with the reason.
        settings: Settings in the lines above the numbers, such as those of a motion capture.
    """

    def __init__(self, *columns: Mapping[str, np.ndarray]) -> None:
        """Create a table of columns, or an empty one."""
        super().__init__(*columns)
        self.left_out: list[str] = []
        self.settings: dict[str, str] = {}


def read_table(path: str | Path) -> Columns:
    """Read a table.

    Cells may be separated by commas, semicolons, tabs or blanks. Decimals may have a comma. A cell
    may hold a list (``[1.0, 2.0]`` becomes ``name[0]``, ``name[1]``). Several lines may name the
    columns (:mod:`visthrow.logs.readers.text_table`); without such a line their names are
    ``column 1`` and so on. Frames of a known rate get a column ``time [s]``. Raises LogError: the
    table cannot be read, has no rows, or a row has another number of cells than the header.

    Args:
        path: ``.csv``, ``.csv.gz``, ``.csv.xz``, ``.tsv``, ``.txt`` or ``.parquet``.
    """
    path = Path(path)
    if path.suffix == ".parquet":
        return Columns(_parquet(path))
    layout = _layout_of_file(path)
    names = _distinct(layout.names)
    table = Columns()
    table.settings = layout.settings
    table.left_out = layout.left_out
    for name, cells in zip(names, zip(*(row for _, row in layout.rows))):
        if any(cells):
            table |= _lists(name, cells) or {name: _column(cells, layout.comma)}
        elif not name.startswith("column "):  # an unnamed blank column is due to a separator
            table.left_out.append(f"{name}: blank throughout")
    _add_time(table, layout.rate)
    return table


def _layout_of_file(path: Path) -> TextTable:
    """Return the layout of a text table, whose rows all have as many cells as its header.

    Raises LogError: the file cannot be read, or is no such table."""
    packed = _OPENERS.get(path.suffix)
    try:
        data = unpack(path, packed, LogError) if packed else path.read_bytes()
        text = data.decode("utf-8-sig")
        if text.lstrip().startswith("{"):
            raise LogError(f"{path}: JSON; expected a table, a line for each instant")
        layout = layout_of(text, str(path))
    except (OSError, EOFError, UnicodeDecodeError, lzma.LZMAError, zlib.error, csv.Error) as error:
        raise LogError(
            f"{path}: cannot be read: {error}; expected a CSV table, plain, .gz or .xz"
        ) from error
    count = len(layout.names)
    if count < 2:
        raise LogError(f"{path}: no header line with the columns' names; expected a CSV table")
    if layout.rows and len(layout.rows[-1][1]) < count:  # cut short while it was written
        layout.rows.pop()
    if not layout.rows:
        raise LogError(f"{path}: a header of {count} columns and no rows below it")
    for line, row in layout.rows:
        if len(row) != count:
            raise LogError(f"{path}: line {line} has {len(row)} cells; the header has {count}")
    return layout


def _distinct(names: list[str]) -> list[str]:
    """Return the names of columns with a number appended to each repetition."""
    counts: Counter[str] = Counter()
    distinct = []
    for name in names:
        counts[name] += 1
        distinct.append(name if counts[name] == 1 else f"{name} ({counts[name]})")
    return distinct


def _add_time(table: Columns, rate: float) -> None:
    """Add a column of time stamps to frames of a known rate [Hz], unless there is one, in place."""
    frames = next((table[name] for name in table if name.lower().startswith("frame")), None)
    timed = any(name.lower().startswith("time") for name in table)
    if rate > 0.0 and not timed and table:
        if frames is None:
            frames = np.arange(len(next(iter(table.values()))), dtype=float)
        if frames.dtype.kind == "f":
            table["time [s]"] = (frames - frames[0]) / rate


def _lists(name: str, cells: tuple[str, ...]) -> Table:
    """Split a column of lists into one column per element; return no column if its first filled
    cell holds no list.
    """
    first = next((cell.strip() for cell in cells if cell.strip()), "")
    if not _LIST.fullmatch(first):
        return {}
    rows = [
        [float(part) if is_number(part) else math.nan for part in _PARTS.split(c.strip("[]() \t"))]
        for c in cells
    ]
    width = max(map(len, rows))
    values = np.array([row + [math.nan] * (width - len(row)) for row in rows])
    return {f"{name}[{i}]": values[:, i] for i in range(width)}


def _column(cells: tuple[str, ...], comma: bool = False) -> np.ndarray:
    if comma:
        cells = tuple(cell.replace(",", ".") for cell in cells)
    try:
        return np.array(cells, dtype=np.float64)
    except ValueError:
        pass
    try:
        return np.array(
            [float(_WORDS.get(cell, cell)) if cell.strip() else math.nan for cell in cells]
        )
    except ValueError:
        return np.array(cells)


def _parquet(path: Path) -> Table:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        shape = pq.read_metadata(path)
        require_room(path, 8 * shape.num_rows * shape.num_columns, LogError)
        table = pq.read_table(path)
    except (pa.ArrowException, OSError) as error:
        raise LogError(f"{path}: cannot be read: {error}; expected a parquet table") from error
    columns = {}
    for name in table.column_names:
        values = table[name].to_numpy(zero_copy_only=False)
        if values.dtype.kind in "bifu":
            columns[name] = values.astype(np.float64)
        else:
            columns[name] = _column(tuple(map(_text, values)))
    if not columns or not table.num_rows:
        raise LogError(f"{path}: a parquet table without rows")
    return columns


def _text(value: object) -> str:
    return "" if value is None or value != value else str(value)


def logs_of(table: Table, mapping: TableMap, source: str) -> list[FlightLog]:
    """Convert a table to flight logs; ``source``: name of the table in messages.

    Raises LogError: a column is missing or holds no numbers, or no log is left after splitting.
    """
    count = len(next(iter(table.values())))
    parts = _parts(table, mapping, count, source)
    logs = [_log(table, mapping, rows, label, source) for rows, label in parts]
    if not logs:
        shortest = mapping.split.shortest if mapping.split else 0.0
        raise LogError(f"{source}: {count} rows, but no stretch of {shortest:g} s without a gap")
    return logs


def _numbers(table: Table, name: str, source: str) -> np.ndarray:
    """Return the numbers of a column, negated if a minus precedes its name."""
    if name not in table and name[:1] == "-":
        return -_numbers(table, name[1:], source)
    if name not in table:
        raise LogError(f"{source}: no column '{name}'; {suggest(name, table)}")
    if table[name].dtype.kind not in "fiub":
        row, cell = next(
            (i, c)
            for i, c in enumerate(table[name].tolist(), start=1)
            if c.strip() and not is_number(c)
        )
        raise LogError(
            f"{source}: column '{name}' holds text such as '{cell}' in row {row}; expected numbers"
        )
    return table[name]


def _stamps(table: Table, clock: TimeColumn, source: str) -> np.ndarray:
    offset = clock.offset + clock.offsets.get(Path(source).name, 0.0)
    if not clock.column:
        return clock.row_period * np.arange(len(next(iter(table.values())))) + offset
    return _numbers(table, clock.column, source) * to_si(clock.unit, "time")[1] + offset


def _parts(
    table: Table, mapping: TableMap, count: int, source: str
) -> list[tuple[np.ndarray, str]]:
    """Return the indices of the rows and the label of each log."""
    split = mapping.split or Split()
    parts = [(np.arange(count), "")]
    if split.column:
        if split.column not in table:
            raise LogError(f"{source}: no column '{split.column}'; {suggest(split.column, table)}")
        values = table[split.column]
        parts = [
            (np.flatnonzero(values == value), f"{value:g}" if isinstance(value, float) else value)
            for value in dict.fromkeys(values.tolist())
        ]
    if split.gap == split.shortest == 0.0:
        return parts
    time = _stamps(table, mapping.time, source)
    if split.gap > 0.0:
        pieces = []
        for rows, label in parts:
            ends = np.flatnonzero(np.diff(time[rows]) > split.gap) + 1
            pieces += [(piece, f"{label}#{i}") for i, piece in enumerate(np.split(rows, ends))]
        parts = pieces
    return [
        (rows, label)
        for rows, label in parts
        if split.shortest == 0.0 or (len(rows) and np.ptp(time[rows]) >= split.shortest)
    ]


def _log(table: Table, mapping: TableMap, rows: np.ndarray, label: str, source: str) -> FlightLog:
    meta: dict[str, Any] = {"source": source, "part": label, "rows": len(rows), "ingest": {}}
    meta["left_out"] = list(getattr(table, "left_out", ()))
    channels = {}
    taken = slice(None) if mapping.split is None else rows  # for all clocks alike
    for entry in mapping.channels:
        clock = mapping.clocks[entry.clock] if entry.clock and mapping.clocks else mapping.time
        time = _stamps(table, clock, source)[taken]
        columns = [_numbers(table, name, source)[taken] for name in entry.columns]
        if {len(column) for column in columns} != {len(time)}:
            raise LogError(
                f"{source}: channel '{entry.name}': {len(time)} stamps, columns of"
                f" {', '.join(str(len(c)) for c in columns)}; expected one table and its clock"
            )
        values = np.column_stack(columns)
        channel, notes = make_channel(time, values, entry, source)
        channels[entry.name] = channel
        meta["ingest"][entry.name] = notes | {"clock": entry.clock or "main"}
    return FlightLog(channels, meta)


def make_channel(
    time: np.ndarray,
    values: np.ndarray,
    entry: ChannelMap,
    source: str,
    bad: np.ndarray | None = None,
) -> tuple[Channel, dict]:
    """Convert columns to a channel.

    Rows without a time stamp, or whose stamp does not increase, are left out and counted. Of a
    single stamp that is later than all that follow, only that row is left out.

    Args:
        time: Stamps [s], shape (T,); NaN if missing.
        values: The columns, shape (T, C).
        entry: Their mapping.
        source: Name of the table in messages.
        bad: Rows that the source marks as invalid, shape (T,); None: none.

    Returns:
        The channel, and the number of rows for each reason of being left out or invalid.
    """
    spec = STANDARD_CHANNELS.get(entry.name)
    unit, factor = to_si(entry.unit, f"channel '{entry.name}'")
    rows = forward_rows(time)
    notes = _counts_of(time)
    blank = np.all(np.isnan(values[rows]), axis=1)  # rows of other channels
    notes["blank"] = int(np.sum(blank))
    time = time[rows[~blank]]
    values = values[rows[~blank]]
    valid = np.all(np.abs(values) < _LARGEST, axis=1)  # false for NaN
    valid &= ~find_lost_rows(values)
    if bad is not None:
        valid &= ~bad[rows[~blank]]
        notes["invalid by the source"] = int(np.sum(bad[rows[~blank]]))
    if entry.held and len(values):
        fresh = _find_changes(values)
        notes["held"] = int(np.sum(~fresh))
        time = time[fresh]
        values = values[fresh]
        valid = valid[fresh]
    values = _convert(np.where(valid[:, None], values, 0.0), entry, factor)
    if entry.kind != "vector":
        unit = "1"
        norm = np.linalg.norm(values, axis=1)
        valid &= np.abs(norm - 1.0) < 0.1
        values = values / np.where(norm > 0.0, norm, 1.0)[:, None]
    notes["invalid"] = int(np.sum(~valid))
    if (spec is not None and spec.shape == ()) or (spec is None and len(entry.columns) == 1):
        values = values[:, 0]
    if spec is not None and unit in spec.unit.split(", "):
        unit = spec.unit
    frame = spec.frame if spec is not None else (entry.frame or "none")
    try:
        return Channel(time, values, unit, frame, valid), notes
    except LogError as error:
        raise LogError(f"{source}: channel '{entry.name}': {error}") from error


def _find_changes(values: np.ndarray) -> np.ndarray:
    """Return whether each row differs from the one before, bool, shape (T,); true for the first."""
    same = (values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
    return np.append(True, ~np.all(same, axis=1))


def _counts_of(stamps: np.ndarray) -> dict[str, int]:
    """Count rows, and those whose stamps are missing, repeated or earlier than the one before."""
    finite = np.isfinite(stamps)
    steps = np.diff(stamps[finite])
    return {
        "rows": len(stamps),
        "unstamped": int(np.sum(~finite)),
        "repeated": int(np.sum(steps == 0.0)),
        "backwards": int(np.sum(steps < 0.0)),
    }


def forward_rows(stamps: np.ndarray) -> np.ndarray:
    """Return the indices of rows with increasing stamps: those later than all before, or those
    earlier than all after, whichever are more. Rows without a stamp are left out.
    """
    rows = np.flatnonzero(np.isfinite(stamps))
    time = stamps[rows]
    later = np.diff(np.maximum.accumulate(time), prepend=-np.inf) > 0.0
    earlier = np.diff(np.minimum.accumulate(time[::-1])[::-1], append=np.inf) > 0.0
    return rows[earlier if np.sum(earlier) > np.sum(later) else later]


def find_lost_rows(values: np.ndarray) -> np.ndarray:
    """Return the rows in which a motion capture has lost the body and writes zeros, bool, shape
    (T,).

    Such rows of three or more columns are all zero, and their neighbours are far from zero.
    ``values``: shape (T, C)."""
    zero = np.all(values == 0.0, axis=1)
    if values.shape[1] < 3 or not np.any(zero) or np.all(zero):
        return np.zeros(len(values), bool)
    size = np.linalg.norm(np.nan_to_num(values), axis=1)
    usual = np.percentile(np.abs(np.diff(size[~zero])), 99) if np.sum(~zero) > 2 else 0.0
    edges = np.flatnonzero(np.diff(zero, prepend=False, append=False))
    lost = np.zeros(len(values), bool)
    for start, end in edges.reshape(-1, 2):
        neighbours = np.append(size[:start][-1:], size[end : end + 1])
        lost[start:end] = np.all(neighbours > 10.0 * usual)
    return lost


def _convert(values: np.ndarray, entry: ChannelMap, factor: float) -> np.ndarray:
    values = (values * entry.scale + entry.offset) * factor
    if entry.kind == "vector":
        if entry.axes and values.shape[1] == 3:
            return values @ turn_of(entry.axes).T
        return values
    if entry.kind == "matrix":
        good = np.abs(np.linalg.norm(values, axis=1) - np.sqrt(3.0)) < 0.1
        whole = np.where(good[:, None], values, np.eye(3).ravel())
        matrices = whole.reshape(-1, 3, 3).transpose(0, 2, 1)  # column by column
        quat = quat_of_matrix(matrices) * good[:, None]
    elif entry.kind == "rotvec":
        quat = quat_of_vector(values)
    elif entry.kind == "euler":
        quat = np.array([quat_of_euler(*row) for row in values.tolist()]).reshape(-1, 4)
    else:
        quat = values[:, [1, 2, 3, 0]] if entry.order == "wxyz" else values
    if not entry.axes and not entry.body_axes:
        return quat
    world = quat_of_matrix(turn_of(entry.axes or OURS))
    body = conjugate(quat_of_matrix(turn_of(entry.body_axes or OURS)))
    return np.stack(multiply(multiply(world, quat.T), body), -1)


def log_of_export(table: Table, path: Path) -> FlightLog | None:
    """Convert a table of :func:`visthrow.logs.export.export` back to a flight log; None for any
    other table. Only parquet holds the metadata.

    Raises LogError: a channel lacks columns or is invalid.
    """
    names = [_EXPORTED.fullmatch(column) for column in table if column != "time [s]"]
    if "time [s]" not in table or not all(names):
        return None
    time = _numbers(table, "time [s]", str(path))
    read = {}
    channels = {}
    for match in names:
        index = tuple(map(int, match["index"].split(","))) if match["index"] else ()
        place = match["unit"], match["frame"] or "none"
        cells = read.setdefault(match["name"], (place, {}))[1]
        cells[index] = _numbers(table, match[0], str(path))
    try:
        for name, (place, cells) in read.items():
            spec = STANDARD_CHANNELS.get(name)
            # a standard unit may hold a comma
            unit, frame = place if spec is None else (spec.unit, spec.frame)
            shape = tuple(np.max(list(cells), axis=0) + 1) if () not in cells else ()
            if len(cells) != math.prod(shape):
                raise LogError(
                    f"channel '{name}' has {len(cells)} columns; expected {math.prod(shape)}"
                )
            values = np.full((len(time), *shape), np.nan)
            for index, column in cells.items():
                values[(slice(None), *index)] = column
            # false for NaN
            present = np.all(np.abs(values.reshape(len(time), -1)) < _LARGEST, axis=1)
            channels[name] = Channel(time[present], values[present], unit, frame)
        return FlightLog(channels, {"source": str(path), **_metadata(path)})
    except LogError as error:
        raise LogError(f"{path}: {error}") from error


def _metadata(path: Path) -> dict:
    """Return the metadata of our own parquet export; {} for other files."""
    if path.suffix != ".parquet":
        return {}
    import pyarrow.parquet as pq

    stored = (pq.read_schema(path).metadata or {}).get(b"visthrow")
    return json.loads(stored) if stored else {}

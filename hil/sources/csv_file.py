"""Poses from a CSV file (plain or gzip), columns named by a mapping that also states each unit."""

import csv
import gzip
import io
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hil.errors import SourceError
from hil.poses.pose import BODIES, Pose
from visthrow.common.errors import ConfigError, suggest

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "m": 1.0, "cm": 1e-2, "mm": 1e-3, "m/s": 1.0, "mm/s": 1e-3,
         "rad": 1.0, "deg": math.pi / 180, "rad/s": 1.0, "deg/s": math.pi / 180, "1": 1.0}  # fmt: skip
"""Unit -> its size in ours."""

_ALLOWED = {
    "time": ("s", "ms", "us", "ns"),
    "pos": ("m", "cm", "mm"),
    "quat": ("1",),
    "euler": ("rad", "deg"),
    "vel": ("m/s", "mm/s"),
    "rate": ("rad/s", "deg/s"),
}
_WIDTH = {"time": 1, "quat": 4}


@dataclass(frozen=True)
class Column:
    """Columns of one quantity and their unit."""

    names: tuple[str, ...]  # in the order of the source's axes; a quaternion's in the order that the frames state
    unit: str  # of UNITS


@dataclass(frozen=True)
class CsvParams:
    """Mapping of one body's columns.

    Raises:
        ConfigError: a unit or a number of columns that the quantity cannot have.
    """

    body: str  # "vehicle", "payload" or "goal"
    pos: Column
    time: Column | None = None  # None: rows are evenly spaced by row_period
    row_period: float = 0.0  # between two rows [s], where there is no time column
    quat: Column | None = None
    euler: Column | None = None  # roll, pitch, yaw (yaw first, then pitch, then roll), where there is no quaternion
    vel: Column | None = None
    rate: Column | None = None

    def __post_init__(self) -> None:
        if self.body not in BODIES:
            raise ConfigError(f"body '{self.body}'; {suggest(self.body, BODIES)}")
        for name, units in _ALLOWED.items():
            column = getattr(self, name)
            if column is None:
                continue
            if column.unit not in units:
                raise ConfigError(f"{name} in '{column.unit}'; expected one of: {', '.join(units)}")
            if len(column.names) != _WIDTH.get(name, 3):
                raise ConfigError(
                    f"{name} of {len(column.names)} columns {list(column.names)}; expected {_WIDTH.get(name, 3)}"
                )
        if (self.time is None) != (self.row_period > 0.0):
            raise ConfigError("give either a time column or a row_period above 0 s")
        if self.quat is not None and self.euler is not None:
            raise ConfigError("give either quat or euler, not both")


def read_csv(path: str | Path, bodies: tuple[CsvParams, ...], quaternion: str = "xyzw") -> list[Pose]:
    """Poses of the bodies in a CSV file; arrivals are the stamps, counted from the first row.

    Args:
        path: with a header line; ``.gz`` is unpacked.
        bodies: mapping of each body.
        quaternion: order that quaternions made from angles are to be written in, that of the source's frames.

    Raises:
        SourceError: no such file, no such column, no mapping at all, or a cell that is no number (an empty one reads as NaN).
    """
    path = Path(path)
    header, table = _read(path)
    if not bodies:
        raise SourceError(
            f"{path}: source.columns is empty; expected which columns hold the poses of vehicle and payload, and in which units, "
            f"as in configs/hil/crazyflie_log.toml. The file has: {', '.join(header)}"
        )
    poses: list[Pose] = []
    for params in bodies:
        poses += _poses(params, header, table, path, quaternion)
    return poses


def read_columns(path: str | Path, column: Column) -> np.ndarray:
    """Columns of a CSV file in our unit, shape (rows, len(column.names)).

    Raises:
        SourceError: as `read_csv`.
    """
    header, table = _read(Path(path))
    return _columns(column, header, table, Path(path))


def _read(path: Path) -> tuple[list[str], np.ndarray]:
    """Header and numbers of a file."""
    try:
        data = path.read_bytes()
        text = (gzip.decompress(data) if path.suffix == ".gz" else data).decode("utf-8")
    except (OSError, EOFError, UnicodeDecodeError) as error:
        raise SourceError(f"{path}: cannot be read: {error}; expected a CSV file, plain or .gz") from error
    rows = csv.reader(io.StringIO(text))
    header = [name.strip() for name in next(rows, [])]
    if not header:
        raise SourceError(f"{path}: no line with the columns' names; expected a CSV file, plain or .gz")
    table = np.array(list(_numbers(rows, len(header), path)), dtype=float).reshape(-1, len(header))
    return header, table


def _numbers(rows: Iterator[list[str]], width: int, path: Path) -> Iterator[list[float]]:
    for number, row in enumerate(rows, start=2):
        if not row:
            continue
        if len(row) != width:
            raise SourceError(f"{path}: line {number} has {len(row)} cells; the header has {width}")
        try:
            yield [float(cell) if cell.strip() else math.nan for cell in row]
        except ValueError as error:
            raise SourceError(f"{path}: line {number}: {error}; expected numbers") from error


def _columns(column: Column, header: list[str], table: np.ndarray, path: Path) -> np.ndarray:
    for name in column.names:
        if name not in header:
            raise SourceError(f"{path}: no column '{name}'; {suggest(name, header)}")
    return table[:, [header.index(name) for name in column.names]] * UNITS[column.unit]


def _poses(params: CsvParams, header: list[str], table: np.ndarray, path: Path, quaternion: str) -> Iterator[Pose]:
    def columns(column: Column | None) -> np.ndarray | None:
        return None if column is None else _columns(column, header, table, path)

    count = len(table)
    time = params.row_period * np.arange(count) if params.time is None else columns(params.time)[:, 0]
    pos, quat, vel, rate = (columns(getattr(params, name)) for name in ("pos", "quat", "vel", "rate"))
    euler = columns(params.euler)
    if euler is not None:
        quat = _quaternions(euler, quaternion)
    start = float(time[0]) if count else 0.0
    for row in range(count):
        if math.isfinite(time[row]):
            yield Pose(
                float(time[row]), float(time[row]) - start, params.body, _row(pos, row), _row(quat, row),
                _row(vel, row), _row(rate, row),
            )  # fmt: skip


def _row(values: np.ndarray | None, row: int) -> tuple | None:
    return None if values is None else tuple(values[row].tolist())


def _quaternions(euler: np.ndarray, order: str) -> np.ndarray:
    half = 0.5 * euler
    (cr, cp, cy), (sr, sp, sy) = np.cos(half).T, np.sin(half).T
    x, y = sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy
    z, w = cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy
    return np.column_stack((w, x, y, z) if order == "wxyz" else (x, y, z, w))

"""Recordings as columns: ROS 1 and 2 bags, MCAP, MATLAB, HDF5, C3D and the Crazyflie's SD card.

A recording holds several tables, each with its own clock: column ``drone/pose:position.x`` belongs
to the table ``drone/pose``, whose stamps are ``drone/pose:time`` [s]. A mapping treats them like
the columns of one table, with a clock for each channel.

Source: crazyflie-firmware, tools/usdlog/cfusdlog.py (the card's format); rosbags, mcap, scipy.io
and h5py read the others."""

import io
import json
import math
import struct
import warnings
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from visthrow.common.errors import LogError
from visthrow.common.extras import load_extra
from visthrow.common.storage import require_room
from visthrow.logs.readers.table_to_log import Columns, Table

# Largest number of columns of a signal. Wider matrices are images, point clouds or covariances; the
# state of a simulator may have tens of numbers.
WIDEST = 64
_CARD = 0xBC
_CARD_TYPES = set("BbHhIiQqfdeL?")


def read_recording(path: Path) -> Table:
    """Read all columns of numbers from a file with an extension of :data:`READERS`, the folder of a
    ROS 2 bag, or a log of the Crazyflie's SD card.

    Raises LogError: a package is missing, or the file cannot be read or holds no numbers.
    """
    reader, what = READERS.get(path.suffix.lower(), (_card, "a recording"))
    if path.is_dir():
        reader = _bag
        what = "a folder of a ROS 2 bag"
    try:
        table = reader(path)
    except LogError:
        raise
    except Exception as error:  # other packages raise exceptions of any type
        raise LogError(f"{path}: cannot be read: {error!r}; expected {what}") from error
    if not table:
        raise LogError(f"{path}: it has no columns of numbers")
    return table


def is_card(path: Path) -> bool:
    """Return whether a file without a known extension is a log of a Crazyflie's SD card."""
    with path.open("rb") as file:
        head = file.read(5)
    return len(head) == 5 and head[0] == _CARD and struct.unpack("<H", head[1:3])[0] in (1, 2)


CARD_STAMPS = {1: ("<HI", 1e-3), 2: ("<HQ", 1e-6)}
"""Version of a card's log -> struct format of an event's number and stamp, and the stamp's unit
[s].
"""


@dataclass
class _CardEvent:
    """A kind of event in a card's log, which becomes a table."""

    name: str
    fields: list[str]
    form: str
    rows: list[tuple[float, ...]]


def _card(path: Path) -> Table:
    """Read a card's log; each kind of event becomes a table."""
    data = path.read_bytes()
    version, kinds = _card_head(path, data)
    events, position = _card_events(path, data, kinds)
    form, unit = CARD_STAMPS[version]
    while position + struct.calcsize(form) <= len(data) - 4:
        number, time = struct.unpack_from(form, data, position)
        if number not in events:
            raise LogError(
                f"{path}: event {number} near byte {position} was not declared; the file is damaged"
            )
        event = events[number]
        position += struct.calcsize(form)
        event.rows.append((time * unit, *struct.unpack_from(event.form, data, position)))
        position += struct.calcsize(event.form)
    start = min((event.rows[0][0] for event in events.values() if event.rows), default=0.0)
    table: Table = {}
    for event in events.values():
        if event.rows:
            time, *columns = np.array(event.rows, dtype=float).T
            table[f"{event.name}:time"] = time - start
            names = [f"{event.name}:{field}" for field in event.fields]
            table |= dict(zip(names, columns))
    return table


def _card_head(path: Path, data: bytes) -> tuple[int, int]:
    """Return the version of a card's log and its number of kinds of events."""
    if len(data) < 9 or data[0] != _CARD:
        raise LogError(
            f"{path}: begins with {data[:1].hex() or 'nothing'}, not bc; expected a log from a"
            " Crazyflie's card"
        )
    if struct.unpack("<I", data[-4:])[0] != zlib.crc32(data[:-4]):
        raise LogError(f"{path}: its checksum is wrong: cut short or damaged")
    version, kinds = struct.unpack_from("<HH", data, 1)
    if version not in CARD_STAMPS:
        raise LogError(
            f"{path}: version {version} of a Crazyflie's card; versions 1 and 2 are known"
        )
    return version, kinds


def _card_events(path: Path, data: bytes, kinds: int) -> tuple[dict[int, _CardEvent], int]:
    """Return the declared kinds of events by their number, and the position of the first event."""
    position = 5
    events = {}
    for _ in range(kinds):
        number = struct.unpack_from("<H", data, position)[0]
        name, position = _word(data, position + 2)
        count = struct.unpack_from("<H", data, position)[0]
        position += 2
        event = _CardEvent(name, [], "<", [])
        for _ in range(count):
            field, position = _word(data, position)
            event.fields.append(field[:-3])
            event.form += field[-2]
        if not _CARD_TYPES.issuperset(event.form[1:]):
            raise LogError(
                f"{path}: a variable of {name} has an unknown type; known:"
                f" {''.join(sorted(_CARD_TYPES))}"
            )
        events[number] = event
    return events, position


def _word(data: bytes, position: int) -> tuple[str, int]:
    end = data.index(b"\x00", position)
    return data[position:end].decode(), end + 1


def _matlab(path: Path) -> Table:
    from scipy.io import loadmat, whosmat

    try:
        require_room(path, sum(8 * math.prod(shape) for _, shape, _ in whosmat(path)), LogError)
        return _flatten(loadmat(path, simplify_cells=True))
    except NotImplementedError:  # version 7.3 is HDF5
        return _hdf5(path)
    except TypeError as error:
        raise LogError(
            f"{path}: holds an object of MATLAB, such as a table; expected arrays and structs, as"
            " table2struct(T, 'ToScalar', true) makes them"
        ) from error


def _hdf5(path: Path) -> Table:
    h5py = load_extra("h5py", "recordings", f"{path}: an HDF5 file", LogError)
    arrays: dict[str, Any] = {}

    def note(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            arrays[name] = item

    with h5py.File(path) as file:
        file.visititems(note)
        require_room(path, sum(item.nbytes for item in arrays.values()), LogError)
        return _flatten({name: item[()] for name, item in arrays.items()})


def _flatten(tree: dict[str, Any], prefix: str = "") -> Table:
    """Turn a tree of arrays into columns: vectors unchanged, matrices column by column, with time
    along the longer side.
    """
    table: Table = {}
    for name, value in tree.items():
        if name.startswith("__"):
            continue
        if isinstance(value, dict):
            table |= _flatten(value, f"{prefix}{name}.")
            continue
        values = np.asarray(value)
        if values.dtype.names:
            table |= _flatten(
                {field: values[field] for field in values.dtype.names}, f"{prefix}{name}."
            )
        elif values.dtype.kind == "O" and values.size <= WIDEST:  # a cell, or several structs
            table |= _flatten({f"{name}[{i}]": _open(x) for i, x in enumerate(values.flat)}, prefix)
        elif values.dtype.kind in "biuf":
            values = values.squeeze()
            values = values.T if values.ndim == 2 and values.shape[0] < values.shape[1] else values
            if values.ndim == 1 and len(values) > 1:
                table[prefix + name] = values.astype(float)
            elif values.ndim == 2 and values.shape[1] <= WIDEST:
                table |= {
                    f"{prefix}{name}[{i}]": column.astype(float)
                    for i, column in enumerate(values.T)
                }
    return table


def _open(item: Any) -> Any:
    """Return the fields of a MATLAB struct in a cell; anything else unchanged."""
    fields = getattr(item, "_fieldnames", None)
    return item if fields is None else {name: getattr(item, name) for name in fields}


def _bag(path: Path) -> Table:
    """Read the topics of a ROS 1 or ROS 2 bag; the time is the header's stamp if there is one."""
    load_extra("rosbags.highlevel", "recordings", f"{path}: a ROS bag", LogError)
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    folder = path.parent if (path.parent / "metadata.yaml").exists() else path
    topics = Topics()
    store = get_typestore(Stores.ROS2_HUMBLE)
    with AnyReader([path if path.is_dir() else folder], default_typestore=store) as reader:
        for connection, stamp, raw in reader.messages():
            topics.add(
                connection.topic,
                f"{connection.topic} ({connection.msgtype})",
                1e-9 * stamp,
                raw,
                lambda raw, kind=connection.msgtype: reader.deserialize(raw, kind),
            )
    return topics.table()


def _mcap(path: Path) -> Table:
    """Read the channels of an MCAP file, in JSON or as ROS messages."""
    reading = load_extra("mcap.reader", "recordings", f"{path}: an MCAP file", LogError)
    reader = reading.make_reader(io.BytesIO(path.read_bytes()))
    summary = reader.get_summary()
    chunks = summary.chunk_indexes if summary is not None else []
    require_room(path, sum(chunk.uncompressed_size for chunk in chunks), LogError)
    topics = Topics()
    listed = summary.channels.values() if summary is not None else ()
    encodings = {channel.message_encoding for channel in listed}
    messages = reader.iter_messages() if not encodings or encodings - {"cdr", "ros1"} else ()
    for _, channel, message in messages:
        encodings.add(channel.message_encoding)
        if channel.message_encoding not in ("cdr", "ros1"):
            label = f"{channel.topic} ({channel.message_encoding})"
            decode = json.loads if channel.message_encoding == "json" else _undecodable
            topics.add(channel.topic, label, 1e-9 * message.log_time, message.data, decode)
    table = topics.table()
    if not encodings or encodings & {"cdr", "ros1"}:
        bag = _bag(path)
        table |= bag
        table.left_out += [part for part in bag.left_out if part.partition(" ")[0] not in encodings]
    return table


def _undecodable(raw: bytes) -> Any:
    raise ValueError("its encoding is not supported")


LARGEST_MESSAGE = 20_000
"""Largest size of a message [bytes]. Larger ones are images or point clouds, not signals."""


class Topics:
    """A collector of the numbers in messages, with a table for each topic. Topics that cannot be
    read are listed and left out.
    """

    def __init__(self) -> None:
        """Create a collector without topics."""
        self._rows: dict[str, list[dict[str, float]]] = {}
        self._left_out: dict[str, str] = {}

    def add(
        self, topic: str, label: str, arrival: float, raw: bytes, decode: Callable[[bytes], Any]
    ) -> None:
        """Add a message.

        ``label``: name of the topic for the user; ``arrival``: time [s]; ``decode``: function that
        turns the bytes into an object."""
        topic = topic.strip("/").replace(":", ".")
        if topic in self._left_out:
            return
        if len(raw) > LARGEST_MESSAGE:
            self._left_out[topic] = f"{label}: messages of {len(raw)} bytes hold no signal"
            return
        try:
            row: dict[str, float] = {}
            add_numbers(row, decode(raw))
        except Exception as error:  # other packages raise exceptions of any type
            self._left_out[topic] = f"{label}: cannot be decoded: {error!r}"[:200]
            return
        heads = ("header.stamp", "stamp", "timestamp")
        stamp = next((stamp_ for head in heads if (stamp_ := _stamp(row, head))), 0.0)
        row = {"time": stamp or arrival, "arrival": arrival} | row
        self._rows.setdefault(topic, []).append(row)

    def table(self) -> Columns:
        """Return the columns of all topics, with NaN where a message lacks a field.

        Raises LogError: none of the topics can be read."""
        start = min(
            (row["time"] for messages in self._rows.values() for row in messages), default=0.0
        )
        table = Columns()
        for topic, messages in self._rows.items():
            names = list(dict.fromkeys(name for row in messages for name in row))
            blank = dict.fromkeys(names, np.nan)
            whole = [row if len(row) == len(names) else blank | row for row in messages]
            columns = np.array(list(map(itemgetter(*names), whole))).T
            for name, values in zip(names, columns):
                clock = name in ("time", "arrival")
                table[f"{topic}:{name}"] = values - start if clock else values
        table.left_out = list(self._left_out.values())
        if not table and self._left_out:
            raise LogError("none of its topics can be read: " + "; ".join(self._left_out.values()))
        return table


def _stamp(row: dict[str, float], head: str) -> float:
    """Return the seconds of a ROS stamp; 0 if the message has none."""
    whole = row.get(f"{head}.sec", row.get(f"{head}.secs", 0.0))
    part = row.get(f"{head}.nanosec", row.get(f"{head}.nsecs", 0.0))
    return whole + 1e-9 * part


@cache
def _places(name: str, count: int) -> tuple[str, ...]:
    return tuple(f"{name}[{i}]" for i in range(count))


@cache
def _members(kind: type, name: str) -> tuple[tuple[str, str], ...]:
    """Return the fields of a message's type, and the full name of each."""
    members = [m for m in getattr(kind, "__dataclass_fields__", ()) if not m.startswith("__")]
    return tuple((member, f"{name}.{member}" if name else member) for member in members)


def add_numbers(row: dict[str, float], value: Any, name: str = "") -> None:
    """Add all numbers of a message to a row, by name, recursively."""
    if isinstance(value, (bool, int, float, np.integer, np.floating)):
        row[name] = float(value)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        if value.size <= WIDEST:
            row.update(zip(_places(name, value.size), map(float, value.ravel().tolist())))
    elif isinstance(value, dict):
        for key, item in value.items():
            add_numbers(row, item, f"{name}.{key}" if name else key)
    elif isinstance(value, (list, tuple, np.ndarray)) and len(value) <= WIDEST:
        for place, item in zip(_places(name, len(value)), value):
            add_numbers(row, item, place)
    else:
        for member, place in _members(type(value), name):
            add_numbers(row, getattr(value, member), place)


def _c3d(path: Path) -> Table:
    """Read the markers of a C3D file, in its unit; NaN for hidden markers. The time follows from
    frame number and rate.
    """
    c3d = load_extra("c3d", "recordings", f"{path}: a C3D file", LogError)
    with path.open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reader = c3d.Reader(file)
        if not reader.point_used:
            raise LogError(f"{path}: a C3D file without markers")
        # Analog channels are not read. So their scales, which some writers omit, are not needed.
        plain = (1.0, np.ones(reader.analog_used), np.zeros(reader.analog_used))
        reader.get_analog_transform_parameters = lambda: plain
        # the list of labels may be longer than the number of points
        labels = [label.strip() for label in reader.point_labels[: reader.point_used]]
        units = reader.get("POINT:UNITS")
        unit = units.string_value.strip() if units is not None else "mm"
        frames = [(number, points[:, :4].copy()) for number, points, _ in reader.read_frames()]
    if not frames or not labels:
        raise LogError(f"{path}: a C3D file without markers")
    numbers = np.array([number for number, _ in frames], dtype=float)
    # x, y, z, residual; the residual of a hidden marker is below 0
    points = np.array([frame for _, frame in frames])
    hidden = points[:, :, 3] < 0.0
    table = Columns({"time [s]": (numbers - numbers[0]) / reader.point_rate})
    for i, label in enumerate(labels):
        for axis in range(3):
            name = f"{label.replace(':', '.')}.{'XYZ'[axis]} [{unit}]"
            table[name] = np.where(hidden[:, i], np.nan, points[:, i, axis])
    return table


READERS: dict[str, tuple[Callable[[Path], Table], str]] = {
    ".c3d": (_c3d, "a C3D file"),
    ".mat": (_matlab, "a MATLAB file"),
    ".h5": (_hdf5, "an HDF5 file"),
    ".hdf5": (_hdf5, "an HDF5 file"),
    ".bag": (_bag, "a ROS 1 bag"),
    ".db3": (_bag, "a ROS 2 bag"),
    ".mcap": (_mcap, "an MCAP file"),
}
"""Extension -> reader, and a description of the format."""

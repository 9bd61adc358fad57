"""Messages of autopilot logs as arrays: PX4's ULog, ArduPilot's DataFlash (.BIN), MAVLink (.tlog).

Only this module opens these files. Names, units and axes are those of the autopilot;
``visthrow.logs.readers.autopilot_logs`` turns messages into flight logs, ``hil.poses.sources`` into
poses. Files are read as bytes: nothing in them is evaluated or used as a device or condition.
Onboard-safe.

Source: PX4 ULog file format; ArduPilot, AP_Logger/LogStructure.h; MAVLink's .tlog (big-endian
microseconds before each message)."""

import io
import math
import os
import struct
import tempfile
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from visthrow.common.errors import LogError
from visthrow.common.extras import load_extra
from visthrow.logs.readers.recordings import add_numbers

Fields = dict[str, np.ndarray]
"""Field -> values, shape (T,); ``time``: of the measurement [s], ``arrival``: of the record [s]."""

FieldsByMessage = dict[tuple[str, int], Fields]
"""Name and instance of a message -> its fields."""

# How often a reader may step back to the same byte. A damaged length would make it do so forever.
MOST_RETURNS = 8

# Start of every DataFlash message. The parser would search any other file byte by byte.
_HEAD = b"\xa3\x95"
_INSTANCE = ("I", "C", "Instance")  # fields of DataFlash that number sensors and estimator cores
_STDERR = 2


@dataclass
class Messages:
    """The requested messages of a log."""

    path: Path
    kind: str  # ulog, dataflash, telemetry
    fields: FieldsByMessage = field(default_factory=dict)
    meta: dict[str, Any] = field(default_factory=dict)
    parameters: dict[str, float] = field(default_factory=dict)  # of the autopilot

    def first(self, name: str) -> Fields | None:
        """Return the fields of a message's lowest instance; None if the log has no such message."""
        return next(iter(self.instances(name).values()), None)

    def instances(self, name: str) -> dict[int, Fields]:
        """Return the fields of each instance of a message, the lowest first."""
        return {
            number: self.fields[key, number] for key, number in sorted(self.fields) if key == name
        }

    @property
    def names(self) -> list[str]:
        """Names of the messages."""
        return sorted({name for name, _ in self.fields})


def read_ulog(path: str | Path, names: Collection[str]) -> Messages:
    """Read topics of PX4's ``.ulg``; the time is ``timestamp_sample`` if the topic has it, else
    ``timestamp``.

    Raises LogError: pyulog is not installed, or the file is no ULog.
    """
    ulog = load_extra("pyulog", "logs", f"{path}: a PX4 log", LogError)
    with _report_parser_errors(path, "a PX4 log (.ulg)"):
        log = ulog.ULog(Forward(Path(path).read_bytes()), list(names))
    messages = Messages(Path(path), "ulog")
    for data in log.data_list:
        if "timestamp" in data.data:
            messages.fields[data.name, data.multi_id] = _add_times(data.data)
    drops = [(drop.timestamp * 1e-6, drop.duration * 1e-3) for drop in log.dropouts]
    messages.meta = {"dropouts": drops, "damaged": bool(log.file_corruption)}
    messages.parameters = {str(name): float(x) for name, x in log.initial_parameters.items()}
    return messages


def _add_times(data: Fields) -> Fields:
    """Add the times of measurement and of logging [s] to the fields of a PX4 topic."""
    arrival = data["timestamp"] * 1e-6
    sample = data.get("timestamp_sample")
    time = arrival if sample is None else np.where(sample > 0, sample * 1e-6, arrival)
    return {**data, "time": time, "arrival": arrival}


def read_converted(path: str | Path, names: Collection[str]) -> Messages:
    """Read topics of a PX4 log from the tables of ``ulog2csv``, ``LOG_TOPIC_INSTANCE.csv``, which
    hold no parameters.

    ``path``: of one of the tables. Raises LogError: a table cannot be read, or has no time stamps.
    """
    from visthrow.logs.readers.table_to_log import read_table

    path = Path(path)
    messages = Messages(path, "ulog")
    log = name_converted(path, names)[0]
    for file in sorted(path.parent.glob("*.csv")):
        name, topic, instance = name_converted(file, names)
        if topic and name == log:
            data = read_table(file)
            if "timestamp" not in data:
                raise LogError(f"{file}: no column 'timestamp'; expected a table of ulog2csv")
            messages.fields[topic, instance] = _add_times(data)
    return messages


def name_converted(path: Path, names: Collection[str]) -> tuple[str, str, int]:
    """Return log, topic and instance of a table of ``ulog2csv``; ("", "", 0) if its name does not
    end in one of these topics.
    """
    stem, _, instance = path.stem.rpartition("_")
    topics = [name for name in names if stem.endswith(f"_{name}")]
    if path.suffix != ".csv" or not instance.isdecimal() or not topics:
        return "", "", 0
    topic = max(topics, key=len)
    return stem.removesuffix(f"_{topic}"), topic, int(instance)


def read_dataflash(path: str | Path, names: Collection[str]) -> Messages:
    """Read messages of ArduPilot's ``.BIN``; the time is that of the measurement for messages with
    ``CTimeMS`` (VISP).

    Raises LogError: the file is no DataFlash log.
    """
    from pymavlink.DFReader import DFReader_binary

    columns = _Columns()
    firmware = ""
    nan = math.nan
    with _report_parser_errors(path, "an ArduPilot dataflash log (.BIN)") as complaints:
        with Path(path).open("rb") as file:
            head = file.read(2)
        if head != _HEAD:
            raise LogError(f"it begins with {head.hex(' ') or 'nothing'}, not a3 95")
        log = DFReader_binary(str(path))
        available = {fmt.name for fmt in log.formats.values()} & {*names, "MSG"}
        while available and (message := _read_next(log, list(available), columns)) is not None:
            row = message.to_dict()
            instance = next((row[name] for name in _INSTANCE if isinstance(row.get(name), int)), 0)
            text = str(row.get("Message", ""))
            if "ArduPilot" in text or text.startswith(("Ardu", "Rover", "Blimp")):
                firmware = firmware or text
            written = row["TimeUS"] * 1e-6 if "TimeUS" in row else row.get("TimeMS", nan) * 1e-3
            if written == written:
                measured = row["CTimeMS"] * 1e-3 if "CTimeMS" in row else written
                columns.add(
                    (message.get_type(), instance), row | {"time": measured, "arrival": written}
                )
        parameters = {name: float(x) for name, x in log.params.items()}
        log.close()
    meta = {"damaged": bool(complaints), "firmware": firmware}
    return Messages(Path(path), "dataflash", columns.arrays(), meta, parameters)


def _read_next(log: Any, names: list[str], columns: "_Columns") -> Any:
    """Return the next message; None at the end, or if the reader fails after the first message."""
    try:
        return log.recv_match(type=names)
    except Exception:  # pymavlink also lets exceptions of struct and mmap pass
        if not columns.rows:
            raise
        return None


NO_AUTOPILOT = 8
"""MAV_AUTOPILOT_INVALID: the sender of a heartbeat is no autopilot."""


def read_telemetry(path: str | Path, names: Collection[str]) -> Messages:
    """Read messages of a ``.tlog``, each from its first sender, on one clock.

    The time is the sender's stamp. Senders count from their boot or from 1970, and some messages
    have no stamp. So each message's stamps are shifted to the clock that counts from boot, by the
    smallest delay of arrival.

    Raises LogError: the file cannot be read, or holds no MAVLink message.
    """
    columns = _Columns()
    sender = {}
    used = 0
    unread: Counter[str] = Counter()
    for arrival, message in telemetry(path):
        name = message.get_type()
        used += 8 + len(message.get_msgbuf())
        if name not in names:
            continue
        if name == "HEARTBEAT" and message.autopilot == NO_AUTOPILOT:
            continue  # from a ground station or a camera
        whose = (message.get_srcSystem(), message.get_srcComponent())
        if sender.setdefault(name, whose) != whose:
            unread[f"{name} of system {whose[0]}, component {whose[1]}"] += 1
            continue
        row = message.to_dict()
        boot = row.get("time_boot_ms")
        usec = row.get("time_usec", row.get("usec"))
        measured = boot * 1e-3 if boot is not None else usec * 1e-6 if usec else arrival
        columns.add((name, 0), row | {"time": measured, "arrival": arrival})
    fields = columns.arrays()
    _share_clock(fields)
    meta = {"damaged": used < Path(path).stat().st_size}
    meta["left_out"] = [f"{count} {what}: of another sender" for what, count in unread.items()]
    return Messages(Path(path), "telemetry", fields, meta)


OTHER_CLOCK = 1.0
"""Difference of delays above which stamps are of another clock [s]."""


def _share_clock(fields: FieldsByMessage) -> None:
    """Shift the stamps of messages to one clock, that which counts from boot, in place."""
    delays = {
        key: float(np.min(series["arrival"] - series["time"])) for key, series in fields.items()
    }
    booted = [delays[key] for key, series in fields.items() if "time_boot_ms" in series]
    stamped = [
        delay
        for key, delay in delays.items()
        if np.any(fields[key]["arrival"] != fields[key]["time"])
    ]
    reference = float(np.median(booted or stamped or [0.0]))
    for key, series in fields.items():
        if abs(delays[key] - reference) > OTHER_CLOCK:
            series["time"] = series["time"] + delays[key] - reference


def telemetry(path: str | Path) -> Iterator[tuple[float, Any]]:
    """Yield arrival [s] and message for each message of a ``.tlog``; damaged bytes are skipped.

    Raises LogError: the file cannot be read, or holds no MAVLink message.
    """
    from pymavlink.dialects.v20 import ardupilotmega as mav

    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}; expected a .tlog") from error
    decoder = mav.MAVLink(None)
    position = 0
    count = 0
    while position + 8 < len(data):
        length = _mavlink_length(data, position + 8)
        try:
            message = (
                decoder.decode(bytearray(data[position + 8 : position + 8 + length]))
                if length
                else None
            )
        except Exception:  # pymavlink raises many exceptions for damaged messages
            message = None
        # The checksum of an unknown message (number below 0) cannot be verified.
        if message is None or message.get_msgId() < 0:
            position += 1  # look for the next message
            continue
        yield struct.unpack_from(">Q", data, position)[0] * 1e-6, message
        position = position + 8 + length
        count = count + 1
    if not count:
        raise LogError(
            f"{path}: {len(data)} bytes without a single MAVLink message; expected a .tlog"
        )


def _mavlink_length(data: bytes, position: int) -> int:
    """Return the length of the message at a position; 0 if none begins there or it is truncated."""
    head = data[position : position + 3]
    if len(head) < 3 or head[0] not in (0xFE, 0xFD):
        return 0
    length = head[1] + 8 if head[0] == 0xFE else head[1] + 12 + 13 * (head[2] & 1)
    return length if position + length <= len(data) else 0


class _Columns:
    """Rows collected by message and instance; rows without a field of the first row are dropped."""

    def __init__(self) -> None:
        self.rows: dict[tuple[str, int], dict[str, list[float]]] = {}

    def add(self, key: tuple[str, int], row: dict[str, Any]) -> None:
        numbers: dict[str, float] = {}
        add_numbers(numbers, row)
        rows = self.rows.setdefault(key, {name: [] for name in numbers})
        if rows.keys() <= numbers.keys():
            for name, values in rows.items():
                values.append(numbers[name])

    def arrays(self) -> FieldsByMessage:
        return {
            key: {name: np.array(values) for name, values in rows.items()}
            for key, rows in self.rows.items()
        }


class Forward(io.BytesIO):
    """A file in memory that stops a reader which steps back to the same byte of a damaged log again
    and again.
    """

    def __init__(self, data: bytes):
        """Open the file at its first byte."""
        super().__init__(data)
        self._returns: Counter[int] = Counter()

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Move to a byte, as ``io.IOBase.seek`` does.

        Raises LogError: the reader stepped back to that byte more than :data:`MOST_RETURNS` times.
        """
        before = self.tell()
        after = super().seek(offset, whence)
        if after < before:
            self._returns[after] += 1
            if self._returns[after] > MOST_RETURNS:
                raise LogError(f"the length of a message is invalid, near byte {after}")
        return after


@contextmanager
def _report_parser_errors(path: str | Path, what: str) -> Iterator[list[str]]:
    """Turn any exception of a parser into a LogError, and collect the lines that it prints.

    Some parsers print a line for each damaged byte, also from C code: the file descriptor of stderr
    is redirected too. Raises LogError for any exception."""
    output: list[str] = []
    heard = io.StringIO()
    try:
        with tempfile.TemporaryFile() as file:
            saved = os.dup(_STDERR)
            os.dup2(file.fileno(), _STDERR)
            try:
                with redirect_stdout(heard), redirect_stderr(heard):
                    yield output
            finally:
                os.dup2(saved, _STDERR)
                os.close(saved)
                file.seek(0)
                output += [
                    *heard.getvalue().splitlines(),
                    *file.read().decode(errors="replace").splitlines(),
                ]
    except Exception as error:
        detail = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise LogError(f"{path}: cannot be read: {detail}; expected {what}") from error

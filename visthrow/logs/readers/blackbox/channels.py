"""Conversion of blackbox logs, raw or decoded to CSV, to flight logs.

Convention: Betaflight's body axes are ours (x forward, y left, z up; the accelerometer of a level
vehicle at rest reads +1 g along z). Its motors are rear right, front right, rear left, front left.
"""

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from visthrow.common.errors import LogError
from visthrow.common.toml_text import tables_beside
from visthrow.logs.flightlog import Channel, FlightLog
from visthrow.logs.mapping import ChannelMap
from visthrow.logs.readers.blackbox.decoder import BlackboxLog, read_blackbox
from visthrow.logs.readers.table_to_log import Table, make_channel

TABLES = tables_beside(__file__)
MOTOR_ORDER = (3, 1, 2, 0)
"""Index of Betaflight's motor for each of ours: front left, front right, rear left, rear right."""

_CLOCK_TURN = 2**32
_UNIT = re.compile(r"\s*\([^()]*\)$")
_ACC_1G = 2048  # of every Betaflight board since 4.0
_MOTOR_OUTPUT = "158,2047"  # of DShot
_GYRO_SCALE = 1.0  # gyroADC is logged in deg/s since Betaflight 3.1


def logs_of_blackbox(path: str | Path) -> list[FlightLog]:
    """Read all logs of a raw file as flight logs. Raises LogError as :func:`read_blackbox`."""
    logs = read_blackbox(path)
    tables = [dict(zip(log.names, log.main.T.astype(np.float64))) for log in logs]
    return [
        _flight(table, log.header, _raw_meta(log, path, i))
        for i, (log, table) in enumerate(zip(logs, tables), start=1)
    ]


def is_decoded(table: Table) -> bool:
    """Return whether a table is a blackbox log decoded to CSV."""
    names = {_UNIT.sub("", name) for name in table}
    return {"loopIteration", "time", "gyroADC[0]"} <= names


def log_of_decoded(table: Table, path: str | Path) -> FlightLog:
    """Convert a decoded CSV to a flight log. Units are those of the raw log, or in brackets after
    the columns' names.

    Raises LogError: the unit of a column is unknown, or the time stamps are no numbers."""
    plain = {}
    for name, values in table.items():
        bare = _UNIT.sub("", name)
        unit = name[len(bare) :].strip(" ()")
        if values.dtype.kind in "fiu":
            plain[bare] = values * _decoded_factor(bare, unit, path)
    return _flight(plain, {}, {"source": str(path), "kind": "blackbox, decoded"})


def _decoded_factor(name: str, unit: str, path: str | Path) -> float:
    """Return the factor from the unit in brackets to the raw log's unit."""
    factors = TABLES["units"]
    if unit not in factors:
        raise LogError(f"{path}: column '{name}' is in '{unit}'; known: {', '.join(factors)}")
    return factors[unit]


def _raw_meta(log: BlackboxLog, path: str | Path, number: int) -> dict:
    return {
        "source": str(path),
        "kind": "blackbox",
        "part": str(number),
        "frames": log.frames,
        "corrupt": log.corrupt,
        "dropped": log.dropped,
        "complete": log.complete,
        "events": [[name, *values] for name, values in log.events],
        "header": {key: log.header[key] for key in TABLES["kept"] if key in log.header},
    }


def _flight(table: Table, header: dict[str, str], meta: dict) -> FlightLog:
    if "time" not in table:
        raise LogError(f"{meta['source']}: column 'time' has no numbers; expected time stamps")
    stamps = table["time"]
    turns = np.concatenate([[0], np.cumsum(np.diff(stamps) < -_CLOCK_TURN / 2)])
    time = (stamps + _CLOCK_TURN * turns) * 1e-6
    meta["start"] = float(time[0]) if len(time) else 0.0
    meta["ingest"] = {}
    channels: dict[str, Channel] = {}
    for entry in [*_sensor_channels(header), *_map_motors(table, header)]:
        if table.keys() >= set(entry.columns):
            values = np.column_stack([table[column] for column in entry.columns])
            channel, notes = make_channel(time - meta["start"], values, entry, meta["source"])
            channels[entry.name] = channel
            meta["ingest"][entry.name] = notes | {"clock": "flight controller"}
    return FlightLog(channels, meta)


def _number_names(name: str, numbers: Iterable[int]) -> tuple[str, ...]:
    return tuple(f"{name}[{number}]" for number in numbers)


def _sensor_channels(header: dict[str, str]) -> list[ChannelMap]:
    """Return the mappings of sensors and set-points."""
    acc_1g = float(header.get("acc_1G", _ACC_1G)) or _ACC_1G
    scales = {"gyro": _gyro_scale(header), "acc": 1.0 / acc_1g}
    rows = [row | {"scale": scales.get(row.get("scale"), 1.0)} for row in TABLES["sensed"]]
    return [ChannelMap(**row | {"columns": tuple(row["columns"])}) for row in rows]


def _map_motors(table: Table, header: dict[str, str]) -> list[ChannelMap]:
    """Return the mappings of motor commands and motor speeds."""
    low, high = (float(x) for x in header.get("motorOutput", _MOTOR_OUTPUT).split(","))
    span = (high - low) or 1.0
    count = sum(1 for name in table if re.fullmatch(r"motor\[\d\]", name))
    if not count:
        return []
    order = MOTOR_ORDER if count == 4 else range(count)
    motors = _number_names("motor", order)
    entries = [ChannelMap("motor_command", motors, "1", scale=1.0 / span, offset=-low / span)]
    if count == 4:
        poles = float(header.get("motor_poles", 14)) or 14.0
        rpm = _number_names("eRPM", order)
        entries.append(ChannelMap("motor_speed", rpm, "rpm", scale=100.0 * 2.0 / poles))
    return entries


def _gyro_scale(header: dict[str, str]) -> float:
    word = header.get("gyro_scale", "")
    if not word.startswith("0x"):
        return _GYRO_SCALE
    scale = float(np.uint32(int(word, 16)).view(np.float32))
    return scale if np.isfinite(scale) and scale > 0.0 else _GYRO_SCALE

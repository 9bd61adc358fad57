"""Blackbox logs, raw or decoded to CSV, as flight logs.

Convention: Betaflight's body axes are ours (x forward, y left, z up; a level vehicle at rest feels
+1 g along z). Its motors are rear right, front right, rear left, front left."""

import math
import re
from pathlib import Path

import numpy as np

from visthrow.common.errors import LogError
from visthrow.logs.flightlog import Channel, FlightLog
from visthrow.logs.mapping import ChannelMap
from visthrow.logs.readers.blackbox.decoder import BlackboxLog, read_blackbox
from visthrow.logs.readers.table import Table, make_channel
from visthrow.logs.unit_names import G

MOTOR_ORDER = (
    3,
    1,
    2,
    0,
)  # Betaflight's motor of each of ours: front left, front right, rear left, rear right

_CLOCK_TURN = 2**32
_UNIT = re.compile(r"\s*\([^()]*\)$")
_ACC_1G = 2048  # of every Betaflight board since 4.0
_MOTOR_OUTPUT = "158,2047"  # of DShot
_GYRO_SCALE = 1.0  # gyroADC is logged in deg/s since Betaflight 3.1


def logs_of_blackbox(path: str | Path) -> list[FlightLog]:
    """Read a raw file: one flight log each log in it. Raises LogError as :func:`read_blackbox`."""
    logs = read_blackbox(path)
    tables = [dict(zip(log.names, log.main.T.astype(np.float64))) for log in logs]
    return [
        _flight(table, log.header, _raw_meta(log, path, i))
        for i, (log, table) in enumerate(zip(logs, tables), start=1)
    ]


def is_decoded(table: Table) -> bool:
    """Tell whether a table is a blackbox log decoded to CSV."""
    names = {_UNIT.sub("", name) for name in table}
    return {"loopIteration", "time", "gyroADC[0]"} <= names


def log_of_decoded(table: Table, path: str | Path) -> FlightLog:
    """Make a flight log of a decoded CSV; its units are those of the raw log, or stand in brackets
    behind the names.

    Raises LogError: a column has a unit in brackets that is not known, or the stamps are no
    numbers."""
    plain = {}
    for name, values in table.items():
        bare = _UNIT.sub("", name)
        unit = name[len(bare) :].strip(" ()")
        if values.dtype.kind in "fiu":
            plain[bare] = values * _decoded_factor(bare, unit, path)
    return _flight(plain, {}, {"source": str(path), "kind": "blackbox, decoded"})


def _decoded_factor(name: str, unit: str, path: str | Path) -> float:
    """Factor from the bracketed unit to what the raw log holds."""
    factors = {
        "": 1.0,
        "us": 1.0,
        "ms": 1e3,
        "s": 1e6,
        "deg/s": 1.0,
        "rad/s": 180 / math.pi,
        "V": 100.0,
        "A": 100.0,
        "g": _ACC_1G,
        "m/s/s": _ACC_1G / G,
        "flags": 1.0,
        "cm": 1.0,
        "m": 1.0,
        "mAh": 1.0,
        "raw": 1.0,
        "%": 1.0,
    }
    if unit not in factors:
        raise LogError(f"{path}: column '{name}' is in '{unit}'; known: {', '.join(factors)}")
    return factors[unit]


def _raw_meta(log: BlackboxLog, path: str | Path, number: int) -> dict:
    keep = (
        "Firmware revision",
        "looptime",
        "I interval",
        "P interval",
        "motorOutput",
        "acc_1G",
        "vbatref",
        "motor_poles",
    )
    return {
        "source": str(path),
        "kind": "blackbox",
        "part": str(number),
        "frames": log.frames,
        "corrupt": log.corrupt,
        "dropped": log.dropped,
        "complete": log.complete,
        "events": [[name, *values] for name, values in log.events],
        "header": {key: log.header[key] for key in keep if key in log.header},
    }


def _flight(table: Table, header: dict[str, str], meta: dict) -> FlightLog:
    if "time" not in table:
        raise LogError(f"{meta['source']}: no numbers in a column 'time'; a flight needs stamps")
    stamps = table["time"].copy()
    turns = np.concatenate([[0], np.cumsum(np.diff(stamps) < -_CLOCK_TURN / 2)])
    time = (stamps + _CLOCK_TURN * turns) * 1e-6
    meta["start"] = float(time[0]) if len(time) else 0.0
    time = time - meta["start"]
    meta["ingest"] = {}
    channels: dict[str, Channel] = {}

    def add(
        name: str,
        columns: list[str],
        unit: str,
        scale: float = 1.0,
        offset: float = 0.0,
        frame: str = "",
    ) -> None:
        if not all(column in table for column in columns):
            return
        entry = ChannelMap(name, tuple(columns), unit, scale=scale, offset=offset, frame=frame)
        values = np.column_stack([table[column] for column in columns])
        channels[name], notes = make_channel(time, values, entry, meta["source"])
        meta["ingest"][name] = notes | {"clock": "flight controller"}

    xyz = range(3)
    add("rate_b", [f"gyroADC[{i}]" for i in xyz], "deg/s", _gyro_scale(header))
    acc_1g = float(header.get("acc_1G", _ACC_1G)) or _ACC_1G
    add("acc_b", [f"accSmooth[{i}]" for i in xyz], "g", 1.0 / acc_1g, frame="body")
    add("rate_setpoint_b", [f"setpoint[{i}]" for i in xyz], "deg/s", frame="body")
    add("throttle", ["setpoint[3]"], "1/1000")
    add("battery_voltage", ["vbatLatest"], "cV")
    add("current", ["amperageLatest"], "cA")
    low, high = (float(x) for x in header.get("motorOutput", _MOTOR_OUTPUT).split(","))
    count = sum(1 for name in table if re.fullmatch(r"motor\[\d\]", name))
    order = MOTOR_ORDER if count == 4 else range(count)
    if count:
        span = (high - low) or 1.0
        add("motor_command", [f"motor[{i}]" for i in order], "1", 1.0 / span, -low / span)
    poles = float(header.get("motor_poles", 14)) or 14.0
    if count == 4:
        add("motor_speed", [f"eRPM[{i}]" for i in order], "rpm", 100.0 * 2.0 / poles)
    return FlightLog(channels, meta)


def _gyro_scale(header: dict[str, str]) -> float:
    word = header.get("gyro_scale", "")
    if not word.startswith("0x"):
        return _GYRO_SCALE
    scale = float(np.uint32(int(word, 16)).view(np.float32))
    return scale if np.isfinite(scale) and scale > 0.0 else _GYRO_SCALE

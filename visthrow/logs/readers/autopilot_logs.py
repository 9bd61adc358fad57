"""Conversion of autopilot logs (ULog, DataFlash, MAVLink telemetry) to flight logs.

Their world axes are north, east, down, and their body axes forward, right, down. The flight log's
are north, west, up, and forward, left, up."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from visthrow.common.errors import LogError
from visthrow.common.rotations import rotate
from visthrow.common.toml_text import tables_beside
from visthrow.logs.flightlog import Channel, FlightLog
from visthrow.logs.mapping import ChannelMap
from visthrow.logs.readers.messages import (
    Fields,
    Messages,
    name_converted,
    read_converted,
    read_dataflash,
    read_telemetry,
    read_ulog,
)
from visthrow.logs.readers.table_to_log import make_channel
from visthrow.logs.readers.vehicles import Vehicle, vehicle_of

NED = "x,-y,-z"  # our axes in the autopilot's, world and body alike
POSE_PARTS = ("pos_w", "quat_wb", "vel_w", "rate_b")
EARTH_RADIUS = 6378100.0  # ArduPilot's scale of latitude [m]
BODY_FRAME = 3  # VELOCITY_FRAME_BODY_FRD


@dataclass(frozen=True)
class Tap:
    """Fields of a message that make a channel: a row of ``autopilot_fields.toml``, where the
    attributes are explained.
    """

    message: str
    channel: str
    unit: str
    columns: str = ""
    motors: str = ""
    outputs: str = ""
    kind: Any = "vector"
    axes: str = NED
    frame: str = ""
    scale: float = 1.0
    good: str = ""
    only: tuple[str, float, float] | None = None

    def entry(self, vehicle: Vehicle) -> ChannelMap:
        """Return the mapping of the fields; those of motors in the order of the vehicle's
        motors.
        """
        columns = tuple(self.columns.split())
        if self.motors:
            columns = tuple(self.motors.replace("*", str(n)) for n in vehicle.motors)
        if self.outputs:
            columns = tuple(self.outputs.replace("*", str(n + 1)) for n in vehicle.outputs)
        turned = self.kind != "vector"
        return ChannelMap(
            self.channel,
            columns,
            self.unit,
            self.kind,
            "wxyz" if self.kind == "quaternion" else "xyzw",
            axes=self.axes if turned or len(columns) == 3 else "",
            body_axes=NED if turned else "",
            frame=self.frame,
            scale=self.scale,
        )


@cache
def fields_of_autopilots() -> dict[str, Any]:
    """Return the tables of `autopilot_fields.toml`, with rows of taps as :class:`Tap`."""
    tables = tables_beside(__file__, "autopilot_fields.toml")
    for taps in (tables["taps"], tables["pose_taps"]):
        taps |= {kind: tuple(Tap(**row) for row in rows) for kind, rows in taps.items()}
    return tables


MOTORS_ALONE = ("actuator_motors", "esc_status", "ESC")
"""Messages of motors only, without other outputs such as a gimbal's."""
RESETS = tuple(f"{name}_reset_counter" for name in ("xy", "z", "vxy", "vz")) + (
    "reset_counter",
    "Rst",
    "RstCnt",
)
"""Fields that count jumps of an estimate to another origin."""

SWEEP = ("SIDS", "SIDD")
SWEEP_AXES = 7
"""Messages of ArduPilot's SYSTEMID: settings and sweep [deg/s]; and number of the first of its axes
that sweep the rates of roll, pitch and yaw.
"""

READERS = {
    ".ulg": (read_ulog, "ulog"),
    ".bin": (read_dataflash, "dataflash"),
    ".tlog": (read_telemetry, "telemetry"),
    ".csv": (read_converted, "ulog"),
}
"""Extension -> reader of the messages, and the kind of log."""


def choose_converted_tables(files: Iterable[Path]) -> list[Path]:
    """Return one table of each PX4 log that ``ulog2csv`` converted, among some files."""
    topics = {tap.message for tap in fields_of_autopilots()["taps"]["ulog"]}
    logs: dict[str, Path] = {}
    for file in files:
        log, topic, _ = name_converted(file, topics)
        if topic:
            logs.setdefault(log, file)
    return list(logs.values())


def log_of_autopilot(path: str | Path) -> FlightLog:
    """Read the log of an autopilot as a flight log, by its extension.

    Raises LogError: it cannot be read, or has no message on the vehicle's motion.
    """
    reader, kind = READERS[Path(path).suffix.lower()]
    tables = fields_of_autopilots()
    taps = tables["taps"][kind]
    tapped = {tap.message for tap in taps}
    states = {message for message, *_ in tables["flying"][kind]}
    log = reader(path, tapped | states | set(SWEEP))
    vehicle = vehicle_of(log)
    _join_escs(log)
    channels: dict[str, Channel] = {}
    notes: dict[str, dict] = {}
    left_out = list(log.meta.pop("left_out", []))
    for tap in taps:
        if tap.channel not in channels:
            signal = _channel(tap, log, vehicle, str(path), left_out)
            if signal is not None:
                channels[tap.channel], notes[tap.channel] = signal
    left_out += _list_untaken(log, taps)
    _add_sweep(channels, notes, log)
    if not channels:
        raise LogError(
            f"{path}: no message about a vehicle's motion; known: {', '.join(sorted(tapped))}"
        )
    if (flying := _find_flying(log)) is not None:
        channels["flying"] = flying
    starts = [float(channel.time[0]) for channel in channels.values() if len(channel.time)]
    if not starts or not math.isfinite(min(starts)):
        raise LogError(f"{path}: stamps are not finite")
    start = min(starts)  # time counts from the first sample
    channels = {
        name: replace(channel, time=channel.time - start) for name, channel in channels.items()
    }
    meta = {"source": str(path), "start": start, "kind": log.kind, "ingest": notes, **log.meta}
    meta |= {"vehicle": vehicle.kind, "left_out": list(dict.fromkeys(left_out))}
    return FlightLog(channels, meta)


def _channel(
    tap: Tap, log: Messages, vehicle: Vehicle, source: str, left_out: list[str]
) -> tuple[Channel, dict] | None:
    """Return the channel of a tap and the notes on it; None if the log lacks its fields."""
    fields_of_motors = tap.motors or tap.outputs
    if fields_of_motors and not vehicle.motors:
        if log.first(tap.message) is not None:
            left_out.append(
                f"{tap.message}: of a {vehicle.kind}, whose motors are not those of a quadrotor X"
            )
        return None
    entry = tap.entry(vehicle)
    chosen = _choose_moving(log.instances(tap.message), entry.columns, tap)
    if chosen is None:
        return None
    number, fields = chosen
    if tap.message in MOTORS_ALONE:
        count = _count_moving_motors(fields, fields_of_motors)
        if count > len(entry.columns):
            left_out.append(f"{tap.message}: {count} motors move, not the four of a quadrotor")
            return None
    channel, notes = _read(tap, entry, fields, source)
    notes |= {"clock": "autopilot", "message": tap.message, "instance": number}
    if notes["invalid by the source"]:
        notes["flagged"] = ", ".join(flag for flag in tap.good.split() if flag in fields)
    resets = [int(np.sum(np.diff(fields[name]) != 0)) for name in RESETS if name in fields]
    if sum(resets):
        notes["resets"] = sum(resets)
    return channel, notes


def _read(tap: Tap, entry: ChannelMap, fields: Fields, source: str) -> tuple[Channel, dict]:
    """Return the channel that a tap makes of the fields of a message, and the notes on it."""
    with np.errstate(invalid="ignore"):  # damaged floats
        values = np.column_stack([fields[column] for column in entry.columns]).astype(float)
    if entry.name == "vel_w" and "velocity_frame" in fields:
        values = _to_world(values, fields)
    return make_channel(fields["time"], values, entry, source, ~find_valid_rows(fields, tap.good))


def log_of_poses(path: str | Path, kind: str, message: str, instance: int) -> FlightLog:
    """Read the poses of one message of a log of kind "bin" or "ulg", for any file extension.

    The axes are the autopilot's: world north, east, down (PX4 optionally forward, right, down),
    body forward, right, down. The channels are pos_w, quat_wb (xyzw), vel_w and rate_b, if known,
    ``arrival`` [s] and ``resets``. If the message has no attitude, the vehicle's estimated attitude
    and rates are added. ``together`` of the metadata names the channels that share the position's
    stamps. If the message has no such instance, the log is empty.

    Raises LogError: the log cannot be read, lacks the message, or has no attitude.
    """
    taps = _pose_taps(kind)
    log = READERS[f".{kind}"][0](path, {tap.message for tap in taps} | {"ORGN"})
    if message not in log.names:
        raise _make_missing_error(message, kind, log)
    data = log.fields.get((message, instance))
    if data is None:
        return FlightLog({})
    if message == "POS":
        data = data | _to_local(data, log.first("ORGN"))
    sources = {_pose_part(tap): (tap, data) for tap in reversed(taps) if _fits(tap, message, data)}
    together = [*sources]
    if "quat_wb" not in sources:
        for name, source in _find_attitude(taps, log).items():
            sources.setdefault(name, source)
        if "quat_wb" not in sources:
            raise LogError(f"{log.path}: {message} gives no attitude, and the log holds none")
    channels = {name: _read_pose(name, *source, str(path)) for name, source in sources.items()}
    counters = [data[name] for name in (*RESETS, "heading_reset_counter") if name in data]
    arrival = ChannelMap("arrival", ("arrival",), "s"), data["arrival"]
    resets = ChannelMap("resets", ("resets",), "1"), np.sum([0.0 * data["time"], *counters], axis=0)
    for entry, values in (arrival, resets):
        channels[entry.name] = make_channel(data["time"], values[:, None], entry, str(path))[0]
    return FlightLog(channels, {"source": str(path), "together": together})


def _make_missing_error(message: str, kind: str, log: Messages) -> LogError:
    available = ", ".join(name for name in pose_messages(kind) if name in log.names)
    return LogError(
        f"{log.path}: no {message} in this log; of the messages with poses it has:"
        f" {available or 'none'}"
    )


def pose_messages(kind: str) -> list[str]:
    """Return the messages of a log of kind "bin" or "ulg" that hold poses."""
    return sorted({tap.message for tap in _pose_taps(kind) if _pose_part(tap) == "pos_w"})


def _pose_taps(kind: str) -> list[Tap]:
    name = READERS[f".{kind}"][1]
    tables = fields_of_autopilots()
    taps = (*tables["taps"][name], *tables["pose_taps"][name])
    return [tap for tap in taps if _pose_part(tap) in POSE_PARTS]


def _pose_part(tap: Tap) -> str:
    """Return the name of a tap's channel without the prefixes for measured and estimated poses."""
    return tap.channel.removeprefix("mocap_").removeprefix("est_")


def _fits(tap: Tap, message: str, fields: Fields) -> bool:
    """Return whether a tap belongs to a message, and the message has all its fields."""
    return tap.message == message and all(column in fields for column in tap.columns.split())


def _find_attitude(taps: list[Tap], log: Messages) -> dict[str, tuple[Tap, Fields]]:
    """Return the first taps of the vehicle's attitude and rates that the log holds, by channel."""
    sources: dict[str, tuple[Tap, Fields]] = {}
    for tap in taps:
        fields = log.first(tap.message)
        turns = tap.channel in ("quat_wb", "rate_b")
        if turns and fields is not None and _fits(tap, tap.message, fields):
            sources.setdefault(tap.channel, (tap, fields))
    return sources


def _read_pose(part: str, tap: Tap, fields: Fields, source: str) -> Channel:
    """Return a part of a pose in the autopilot's axes, without invalid samples; a position keeps
    them.
    """
    entry = replace(tap.entry(Vehicle()), name=part, axes="", body_axes="")
    channel, _ = _read(tap, entry, fields, source)
    return channel if part == "pos_w" else channel.only(np.asarray(channel.valid))


def _to_world(vel: ndarray, odometry: Fields) -> ndarray:
    """Return velocities in the world frame, shape (T, 3); NaN for velocities in the body frame
    without a known attitude.
    """
    quat = np.column_stack([odometry[f"q[{i}]"] for i in (1, 2, 3, 0)]).astype(float)
    with np.errstate(invalid="ignore"):  # unknown attitudes are NaN
        vel_w = rotate(quat / np.linalg.norm(quat, axis=1, keepdims=True), vel)
    return np.where((odometry["velocity_frame"] == BODY_FRAME)[:, None], vel_w, vel)


def _to_local(data: Fields, origins: Fields | None) -> Fields:
    """Return north, east and down [m] relative to the estimator's origin, or to the first position
    if the log has no origin.
    """
    lat = data["Lat"][0]
    lng = data["Lng"][0]
    if origins is not None and "Type" in origins:
        index = np.flatnonzero(origins["Type"] == 0.0)
        if len(index):
            lat = origins["Lat"][index[-1]]
            lng = origins["Lng"][index[-1]]
    return {
        "N": np.radians(data["Lat"] - lat) * EARTH_RADIUS,
        "E": np.radians(data["Lng"] - lng) * EARTH_RADIUS * math.cos(math.radians(lat)),
        "D": -(data["RelOriginAlt"] if "RelOriginAlt" in data else data["RelHomeAlt"]),
    }


def find_valid_rows(fields: Fields, flags: str) -> ndarray:
    """Return whether each row is valid by those of the flags that the message has, bool, shape
    (T,).
    """
    good = np.ones(len(fields["time"]), bool)
    ranges = fields_of_autopilots()["ranges"]
    for flag in flags.split():
        if flag in fields:
            good &= lies_within(fields[flag], *ranges.get(flag, (1.0, math.inf)))
    return good


def lies_within(values: ndarray, smallest: float, largest: float) -> ndarray:
    """Return whether each value is within bounds, bool, shape (T,)."""
    numbers = np.asarray(values, float)
    return (numbers >= smallest) & (numbers <= largest)


def _choose_moving(
    instances: dict[int, Fields], columns: tuple[str, ...], tap: Tap
) -> tuple[int, Fields] | None:
    """Return the first instance with these columns whose values change, else the first with these
    columns; None if there is none. Rows are limited to those of ``tap.only``.
    """
    candidates = []
    for number, fields in instances.items():
        if all(column in fields for column in columns):
            rows = np.ones(len(fields["time"]), bool)
            if tap.only is not None:
                name, *bounds = tap.only
                rows = lies_within(fields[name], *bounds)
            if np.any(rows):
                candidates.append((number, {name: values[rows] for name, values in fields.items()}))
    moving = [
        instance
        for instance in candidates
        if any(np.ptp(np.nan_to_num(instance[1][c])) > 0.0 for c in columns)
    ]
    return next(iter([*moving, *candidates]), None)


def _list_untaken(log: Messages, taps: tuple[Tap, ...]) -> Iterator[str]:
    """Yield a text for each message of which no row passes the ``only`` of any tap."""
    limited = [tap for tap in taps if tap.only is not None]
    for message in dict.fromkeys(tap.message for tap in limited):
        ranges = sorted({tuple(tap.only) for tap in limited if tap.message == message})
        fields = log.first(message)
        if fields is None:
            continue
        name = ranges[0][0]
        if not any(np.any(lies_within(fields[name], *bounds)) for _, *bounds in ranges):
            received = ", ".join(f"{value:g}" for value in np.unique(fields[name]))
            accepted = ", ".join(f"{lowest:g}" for _, lowest, _ in ranges)
            yield f"{message}: its {name} is {received}; those that are read: {accepted}"


def _count_moving_motors(fields: Fields, pattern: str) -> int:
    """Count the motors of a message whose values change; ``pattern``: of their fields, such as
    ``control[*]``.
    """
    names = [pattern.replace("*", str(number)) for number in range(16)]
    return sum(np.ptp(np.nan_to_num(fields[name])) > 0.0 for name in names if name in fields)


def _join_escs(log: Messages) -> None:
    """Merge ArduPilot's ESC messages, one instance per motor, into one with the stamps of the
    first, in place.
    """
    escs = {i: instance for i, instance in log.instances("ESC").items() if "RPM" in instance}
    if not escs:
        return
    time = next(iter(escs.values()))["time"]
    speeds = {
        f"RPM[{i}]": np.interp(time, instance["time"], instance["RPM"])
        for i, instance in escs.items()
    }
    log.fields["ESC", min(escs)] = {"time": time, **speeds}


def _find_flying(log: Messages) -> Channel | None:
    """Return the channel ``flying``, true if armed and in the air; None if the log has no such
    message.
    """
    signals = []
    for message, field, *bounds in fields_of_autopilots()["flying"][log.kind]:
        fields = log.first(message)
        if fields is not None and field in fields:
            order = np.argsort(fields["time"], kind="stable")
            signals.append((fields["time"][order], lies_within(fields[field], *bounds)[order]))
    if not signals:
        return None
    time = np.unique(np.concatenate([time for time, _ in signals]))
    flying = np.ones(len(time), bool)
    for times, good in signals:
        flying &= good[np.maximum(np.searchsorted(times, time, side="right") - 1, 0)]
    return Channel(time, flying, "bool", "none")


def _add_sweep(channels: dict, notes: dict, log: Messages) -> None:
    """Add the sweep of ArduPilot's SYSTEMID to the commanded rate of its axis, in place, as the
    logged rate does not include it.
    """
    started = log.first(SWEEP[0])
    sweep = log.first(SWEEP[1])
    rates = channels.get("rate_setpoint_b")
    if started is None or sweep is None or rates is None:
        return
    axis = int(np.asarray(started["Ax"])[-1]) - SWEEP_AXES
    if not 0 <= axis < 3:
        return
    time = np.asarray(sweep["time"], float)
    size = np.radians(np.asarray(sweep["Targ"], float))
    added = np.interp(rates.time, time, size, left=0.0, right=0.0) * (1.0 if axis == 0 else -1.0)
    values = rates.values.copy()
    values[:, axis] += added
    channels["rate_setpoint_b"] = replace(rates, values=values)
    notes["rate_setpoint_b"] |= {
        "sweep": f"SIDD about axis {axis}, {time[0]:.1f} to {time[-1]:.1f} s"
    }

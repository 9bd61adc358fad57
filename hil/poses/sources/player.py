"""Poses of recordings: tables and flight logs by their channels, autopilots' logs by their
messages.

``visthrow.logs`` reads all files. Autopilots write world north, east, down (PX4 optionally forward,
right, down), body forward, right, down, quaternions wxyz; poses keep that, and ``hil.poses.frames``
converts them like live ones.

| log | message | what it is |
|---|---|---|
| .BIN | VISP | external pose as received; stamp CTimeMS, arrival TimeUS, reset counter |
| .BIN | XKF1, NKF1 | estimate of one core |
| .BIN | POS | estimate on the globe, with ATT's angles |
| .ulg | vehicle_local_position | estimate, with vehicle_attitude and vehicle_angular_velocity |
| .ulg | vehicle_odometry | estimate |
| .ulg | vehicle_visual_odometry, vehicle_mocap_odometry | external pose as received |

Source: ArduPilot, AP_VisualOdom/LogStructure.h, AP_NavEKF3/LogStructure.h, AP_AHRS/LogStructure.h;
PX4 message definitions VehicleOdometry, VehicleLocalPosition, VehicleAttitude (names of fields
before 1.14 too)."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np

from hil.errors import SourceError
from hil.links.roster import Roster
from hil.poses.pose import BODIES, GOAL, PAYLOAD, VEHICLE, Body, Pose
from hil.poses.sources.mavlink import PAIR_AGE, BodyIds, MavlinkDecoder, seen_of
from visthrow.common.errors import LogError, suggest
from visthrow.common.rotations import quat_of_euler, rotate
from visthrow.config.bounds import Bound, Bounded
from visthrow.logs import read
from visthrow.logs.flightlog import FlightLog
from visthrow.logs.mapping import TableMap
from visthrow.logs.readers import messages
from visthrow.logs.readers.autopilot_logs import validity
from visthrow.logs.readers.messages import Fields, Messages

CHANNELS = {
    VEHICLE: ("pos_w", "quat_wb", "vel_w", "rate_b"),
    PAYLOAD: ("payload_pos_w", "payload_quat_wb", "payload_vel_w", "payload_rate_b"),
    GOAL: ("goal_w", "goal_quat_wb", "goal_vel_w", "goal_rate_b"),
}
"""Channels of a flight log that hold position, attitude, velocity and rates of each body."""

EARTH_RADIUS = 6378100.0  # ArduPilot's scale of latitude [m]
BODY_FRAME = 3  # VELOCITY_FRAME_BODY_FRD

Names = tuple[tuple[str, ...], ...]  # fields; the first set that exists counts


@dataclass(frozen=True)
class PoseMessage:
    """Fields of a message that make a pose, or part of one."""

    pos: Names = ()
    quat: Names = ()  # wxyz
    angles: Names = ()  # roll, pitch, yaw [deg], in place of a quaternion
    vel: Names = ()
    rate: Names = ()
    resets: tuple[str, ...] = ()  # counters; their sum is the pose's
    attitude: str = ""  # message of its attitude, of the same vehicle
    rates: str = ""  # likewise of its rates


def _index(name: str, count: int = 3) -> tuple[str, ...]:
    return tuple(f"{name}[{i}]" for i in range(count))


ANGLES, QUAT = (("Roll", "Pitch", "Yaw"), ("R", "P", "Y")), (_index("q", 4),)
EKF = PoseMessage((("PN", "PE", "PD"),), angles=ANGLES, vel=(("VN", "VE", "VD"),))
ODOMETRY = PoseMessage(
    (_index("position"), ("x", "y", "z")),
    QUAT,
    vel=(_index("velocity"), ("vx", "vy", "vz")),
    rate=(_index("angular_velocity"), ("rollspeed", "pitchspeed", "yawspeed")),
    resets=("reset_counter",),
)
LOCAL_RESETS = tuple(f"{name}_reset_counter" for name in ("xy", "vxy", "z", "vz", "heading"))
DATAFLASH = {
    "VISP": PoseMessage((("PX", "PY", "PZ"),), angles=ANGLES, resets=("Rst", "RstCnt")),
    "XKF1": EKF,
    "NKF1": EKF,
    "POS": PoseMessage((("N", "E", "D"),), attitude="ATT"),
}
ULOG = {
    "vehicle_local_position": PoseMessage(
        (("x", "y", "z"),),
        vel=(("vx", "vy", "vz"),),
        resets=LOCAL_RESETS,
        attitude="vehicle_attitude",
        rates="vehicle_angular_velocity",
    ),
    "vehicle_odometry": ODOMETRY,
    "vehicle_visual_odometry": ODOMETRY,
    "vehicle_mocap_odometry": ODOMETRY,
}
_COMPANIONS = {
    "ATT": PoseMessage(angles=ANGLES),
    "ORGN": PoseMessage((("Lat", "Lng", "Alt"),)),
    "vehicle_attitude": PoseMessage(quat=QUAT),
    "vehicle_angular_velocity": PoseMessage(rate=(_index("xyz"),)),
}


@dataclass(frozen=True)
class LogBody(Bounded):
    """The message of one body in an autopilot's log."""

    body: Body
    message: str  # one of DATAFLASH or ULOG
    instance: Annotated[int, Bound(0)] = 0  # core of XKF1; instance of a ULog topic
    file: str | None = None  # of a logger of its own, say on the payload; else the source's file
    time_offset: float = 0.0  # added to this log's times [s]: loggers do not share a clock


@contextmanager
def _as_source() -> Iterator[None]:
    """Raise a reader's `LogError` as `SourceError`."""
    try:
        yield
    except LogError as error:
        raise SourceError(str(error)) from error


@_as_source()
def read_table(path: str | Path, mapping: TableMap | None) -> list[Pose]:
    """Return poses of a table, or of any file that ``visthrow.logs`` reads, arrivals as the stamps,
    counted from the first; raises `SourceError` where it cannot be read, lacks a column, or holds
    no position.
    """
    logs = read(path, mapping)
    if len(logs) > 1:
        raise LogError(f"{path}: {len(logs)} flights in one file; expected one, named as FILE:PART")
    poses = [pose for body in BODIES for pose in _of_channels(logs[0], body)]
    if not poses:
        positions = ", ".join(names[0] for names in CHANNELS.values())
        raise LogError(
            f"{path}: no row with a position of a body; expected one of the channels {positions};"
            f" it has {', '.join(logs[0].channels)}"
        )
    return poses


def _of_channels(log: FlightLog, body: str) -> list[Pose]:
    """Return poses of one body; of a sample that is not valid the numbers are NaN."""
    position = CHANNELS[body][0]
    if position not in log or not len(log[position].time):
        return []
    times, parts = log[position].time, []
    for name in CHANNELS[body]:
        column: list[tuple | None] = [None] * len(times)
        if name in log:
            values = log[name].values.astype(float)
            values[~log[name].valid] = np.nan
            rows = list(map(tuple, values.tolist()))
            column = [rows[i] if i >= 0 else None for i in _latest(log[name].time, times)]
        parts.append(column)
    start = min(float(channel.time[0]) for channel in log.channels.values() if len(channel.time))
    return [
        Pose(time, time - start, body, *numbers, valid=valid)
        for time, valid, *numbers in zip(times.tolist(), log[position].valid.tolist(), *parts)
    ]


def _latest(times: np.ndarray, stamps: np.ndarray) -> np.ndarray:
    """Return the index of the last time at or before each stamp; -1 without a recent one."""
    index = np.searchsorted(times, stamps, side="right") - 1
    return np.where((index >= 0) & (stamps - times[np.maximum(index, 0)] <= PAIR_AGE), index, -1)


@_as_source()
def read_tlog(
    path: str | Path, bodies: tuple[BodyIds, ...], roster: Roster | None = None
) -> list[Pose]:
    """Return poses of a .tlog; arrivals are seconds from its first message. ``roster`` counts what
    is a body's and no pose.

    Raises `SourceError` where nothing in it is a message.
    """
    roster = roster or Roster()
    decoder = MavlinkDecoder(bodies, lambda m, why: roster.refuse(seen_of(m, None, why)))
    poses, first = [], None
    for arrival, message in messages.telemetry(path):
        first = arrival if first is None else first
        pose = decoder.feed(message, arrival - first)
        if pose is not None:
            poses.append(pose)
    return poses


@_as_source()
def read_autopilot(path: str | Path, bodies: tuple[LogBody, ...], kind: str) -> list[Pose]:
    """Return poses of all bodies in a log of kind "bin" or "ulg", arrivals counted from the first;
    raises `SourceError` for no such file, a missing package, or a message that carries no pose or
    is not in the log.
    """
    table, reader = DATAFLASH, messages.read_dataflash
    if kind == "ulg":
        table, reader = ULOG, messages.read_ulog
    if not bodies:
        raise SourceError(
            f"source.logs is empty; expected a body and one of the messages {', '.join(table)}"
        )
    poses: list[Pose] = []
    for body in bodies:
        if body.message not in table:
            raise SourceError(
                f"message '{body.message}' of the {body.body} carries no pose;"
                f" {suggest(body.message, table)}"
            )
        file = body.file or path
        log = reader(file, [*table, *_COMPANIONS])
        body_poses = _of_messages(log, body, table)
        if not body_poses:
            raise SourceError(
                f"{file}: {body.message} (instance {body.instance}) holds no pose of the"
                f" {body.body}"
            )
        poses += [replace(pose, arrival=pose.arrival + body.time_offset) for pose in body_poses]
    start = min(pose.arrival for pose in poses)
    return [replace(pose, arrival=pose.arrival - start) for pose in poses]


def _of_messages(log: Messages, body: LogBody, table: dict[str, PoseMessage]) -> list[Pose]:
    if body.message not in log.names:
        names = ", ".join(name for name in table if name in log.names) or "none"
        raise LogError(
            f"{log.path}: no {body.message} in this log; of the messages with poses it has: {names}"
        )
    data = log.fields.get((body.message, body.instance))
    if data is None:
        return []
    kind = table[body.message]
    if body.message == "POS":
        data = data | _from_globe(data, log.first("ORGN"))
    try:
        pos, quat, vel, rate = (
            _columns_of(data, kind, name) for name in ("pos", "quat", "vel", "rate")
        )
        count, arrivals, stamps = len(pos), data["arrival"], data["time"]
        if kind.attitude:
            attitude = log.first(kind.attitude)
            if attitude is None:
                raise LogError(
                    f"{log.path}: {body.message} gives no attitude, and the log holds no"
                    f" {kind.attitude}"
                )
            quat = _paired(attitude, _COMPANIONS[kind.attitude], "quat", stamps)
        rates = log.first(kind.rates)
        if rates is not None:
            rate = _paired(rates, _COMPANIONS[kind.rates], "rate", stamps)
    except KeyError as error:
        listed = ", ".join(sorted(data.keys() - {"time", "arrival"}))
        raise LogError(f"{log.path}: no field {error}; {body.message} has {listed}") from error
    vel = _in_world(vel, quat, data.get("velocity_frame"))
    counters = [data[name].astype(int) for name in kind.resets if name in data]
    resets = sum(counters) if counters else np.zeros(count, int)
    valid = validity(log.kind, body.message, data)
    return [
        Pose(
            float(stamps[i]),
            float(arrivals[i]),
            body.body,
            tuple(pos[i].tolist()),
            _row(quat, i),
            _row(vel, i),
            _row(rate, i),
            int(resets[i]),
            valid=bool(valid[i]),
        )
        for i in range(count)
        if not kind.attitude or _row(quat, i) is not None
    ]


def _columns_of(data: Fields, message: PoseMessage, part: str) -> np.ndarray | None:
    """Return the columns of a part of a pose, shape (T, 3 or 4); None where there are none."""
    if part == "quat" and message.angles:
        angles = np.radians(_columns(data, message.angles)).tolist()
        quats = np.array([quat_of_euler(*row) for row in angles]).reshape(-1, 4)
        return quats[:, [3, 0, 1, 2]]
    names = getattr(message, part)
    return _columns(data, names) if names else None


def _columns(data: Fields, choices: tuple[tuple[str, ...], ...]) -> np.ndarray:
    names = next((names for names in choices if names[0] in data), choices[0])
    return np.column_stack([data[name] for name in names]).astype(float)


def _paired(data: Fields, message: PoseMessage, part: str, stamps: np.ndarray) -> np.ndarray:
    """Return a message's last value at or before each stamp; NaN without a recent one."""
    index = _latest(data["time"], stamps)
    values = _columns_of(data, message, part)[np.maximum(index, 0)]
    values[index < 0] = np.nan
    return values


def _in_world(
    vel: np.ndarray | None, quat: np.ndarray | None, frame: np.ndarray | None
) -> np.ndarray | None:
    """Return velocities in the world frame; NaN for a body's without an attitude."""
    if vel is None or frame is None:
        return vel
    body_frame = frame == BODY_FRAME
    usable = np.all(np.isfinite(quat), axis=1) & (np.linalg.norm(quat, axis=1) > 0.0)
    vel_w = np.where((body_frame & ~usable)[:, None], np.nan, vel)
    rows = body_frame & usable
    if np.any(rows):
        turns = quat[rows][:, [1, 2, 3, 0]]
        vel_w[rows] = rotate(turns / np.linalg.norm(turns, axis=1, keepdims=True), vel[rows])
    return vel_w


def _row(values: np.ndarray | None, i: int) -> tuple[float, ...] | None:
    """Return a row; None without values or with NaN, which PX4 writes for unknown."""
    if values is None or np.isnan(values[i]).any():
        return None
    return tuple(values[i].tolist())


def _from_globe(data: Fields, origins: Fields | None) -> Fields:
    """Return north, east and down [m] from the estimator's origin, else from the first position."""
    lat, lng = data["Lat"][0], data["Lng"][0]
    if origins is not None and "Type" in origins:
        index = np.flatnonzero(origins["Type"] == 0.0)
        if len(index):
            lat, lng = origins["Lat"][index[-1]], origins["Lng"][index[-1]]
    return {
        "N": np.radians(data["Lat"] - lat) * EARTH_RADIUS,
        "E": np.radians(data["Lng"] - lng) * EARTH_RADIUS * math.cos(math.radians(lat)),
        "D": -(data["RelOriginAlt"] if "RelOriginAlt" in data else data["RelHomeAlt"]),
    }

"""Poses from recordings: flight logs, by their channels, and .tlog files, by the decoder of the
live link.

``visthrow.logs`` reads all files. Poses of an autopilot's log keep its axes, world north, east,
down and body forward, right, down, with quaternions wxyz; ``hil.poses.frames`` converts them like
live ones. `visthrow.logs.readers.autopilot_logs.pose_messages` names the messages.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy import ndarray

from hil.errors import SourceError
from hil.links.roster import Roster
from hil.poses.pose import BODIES, GOAL, PAYLOAD, VEHICLE, Body, Pose
from hil.poses.sources.mavlink import PAIR_AGE, BodyIds, MavlinkDecoder, traffic_of
from visthrow.common.errors import LogError, suggest
from visthrow.config.bounds import Bound, Bounded
from visthrow.logs import read
from visthrow.logs.flightlog import FlightLog
from visthrow.logs.mapping import TableMap
from visthrow.logs.readers import messages
from visthrow.logs.readers.autopilot_logs import log_of_poses, pose_messages

CHANNELS = {
    VEHICLE: ("pos_w", "quat_wb", "vel_w", "rate_b"),
    PAYLOAD: ("payload_pos_w", "payload_quat_wb", "payload_vel_w", "payload_rate_b"),
    GOAL: ("goal_w", "goal_quat_wb", "goal_vel_w", "goal_rate_b"),
}
"""Channels of a flight log that hold position, attitude, velocity and rates of each body."""


@dataclass(frozen=True)
class LogBody(Bounded):
    """The message of one body in an autopilot's log."""

    body: Body
    message: str  # one of `visthrow.logs.readers.autopilot_logs.pose_messages`
    instance: Annotated[int, Bound(0)] = 0  # core of XKF1; instance of a ULog topic
    file: str | None = None  # of a separate logger, as on the payload; None: the source's file
    time_offset: float = 0.0  # added to this log's times [s]: loggers do not share a clock


@contextmanager
def _convert_errors() -> Iterator[None]:
    """Raise a reader's `LogError` as `SourceError`."""
    try:
        yield
    except LogError as error:
        raise SourceError(str(error)) from error


@_convert_errors()
def read_table(path: str | Path, mapping: TableMap | None) -> list[Pose]:
    """Return poses of a table, or of any file that ``visthrow.logs`` reads, arrivals as the stamps,
    counted from the first; raises `SourceError` where it cannot be read, lacks a column, or holds
    no position.
    """
    logs = read(path, mapping)
    if len(logs) > 1:
        raise LogError(f"{path}: {len(logs)} flights in one file; expected one, named as FILE:PART")
    poses = [pose for body in BODIES for pose in _poses_of_channels(logs[0], body)]
    if not poses:
        positions = ", ".join(names[0] for names in CHANNELS.values())
        raise LogError(
            f"{path}: no row with a position of a body; expected one of the channels {positions};"
            f" it has {', '.join(logs[0].channels)}"
        )
    return poses


def _poses_of_channels(log: FlightLog, body: str) -> list[Pose]:
    """Return poses of one body; the numbers of invalid samples are NaN."""
    position = CHANNELS[body][0]
    if position not in log or not len(log[position].time):
        return []
    times = log[position].time
    parts = []
    for name in CHANNELS[body]:
        column: list[tuple | None] = [None] * len(times)
        if name in log:
            values = log[name].values.astype(float)
            values[~log[name].valid] = np.nan
            rows = list(map(tuple, values.tolist()))
            age = 0.0 if name in log.meta.get("together", ()) else PAIR_AGE
            column = [rows[i] if i >= 0 else None for i in _latest(log[name].time, times, age)]
        parts.append(column)
    start = min(float(channel.time[0]) for channel in log.channels.values() if len(channel.time))
    arrivals = log["arrival"].hold(times) if "arrival" in log else times - start
    resets = log["resets"].hold(times).astype(int) if "resets" in log else np.zeros(len(times), int)
    return [
        Pose(time, arrival, body, *numbers, reset=reset, valid=valid)
        for time, arrival, reset, valid, *numbers in zip(
            times.tolist(), arrivals.tolist(), resets.tolist(), log[position].valid.tolist(), *parts
        )
    ]


def _latest(times: ndarray, stamps: ndarray, age: float) -> ndarray:
    """Return the index of the last time at or before each stamp; -1 without one of at most an age
    [s].
    """
    if not len(times):
        return np.full(len(stamps), -1)
    index = np.searchsorted(times, stamps, side="right") - 1
    return np.where((index >= 0) & (stamps - times[np.maximum(index, 0)] <= age), index, -1)


@_convert_errors()
def read_tlog(
    path: str | Path, bodies: tuple[BodyIds, ...], roster: Roster | None = None
) -> list[Pose]:
    """Return poses of a .tlog; arrivals are seconds from its first message. ``roster`` counts what
    is a body's and no pose.

    Raises `SourceError` where nothing in it is a message.
    """
    roster = roster or Roster()
    decoder = MavlinkDecoder(bodies, lambda m, why: roster.refuse(traffic_of(m, None, why)))
    poses = []
    first = None
    for arrival, message in messages.telemetry(path):
        first = arrival if first is None else first
        pose = decoder.feed(message, arrival - first)
        if pose is not None:
            poses.append(pose)
    return poses


@_convert_errors()
def read_autopilot(path: str | Path, bodies: tuple[LogBody, ...], kind: str) -> list[Pose]:
    """Return poses of all bodies in a log of kind "bin" or "ulg", arrivals counted from the first;
    raises `SourceError` for no such file, a missing package, or a message that carries no pose or
    is not in the log.
    """
    messages = pose_messages(kind)
    if not bodies:
        raise SourceError(
            f"source.logs is empty; expected a body and one of the messages {', '.join(messages)}"
        )
    poses: list[Pose] = []
    for body in bodies:
        if body.message not in messages:
            raise SourceError(
                f"message '{body.message}' of the {body.body} carries no pose;"
                f" {suggest(body.message, messages)}"
            )
        file = body.file or path
        log = log_of_poses(file, kind, body.message, body.instance)
        body_poses = [_pose_of_vehicle(pose, body) for pose in _poses_of_channels(log, VEHICLE)]
        if "quat_wb" not in log.meta.get("together", ()):
            body_poses = [pose for pose in body_poses if pose.quat is not None]
        if not body_poses:
            raise SourceError(
                f"{file}: {body.message} (instance {body.instance}) holds no pose of the"
                f" {body.body}"
            )
        poses += body_poses
    start = min(pose.arrival for pose in poses)
    return [replace(pose, arrival=pose.arrival - start) for pose in poses]


def _pose_of_vehicle(pose: Pose, body: LogBody) -> Pose:
    """Return a pose of an autopilot's own vehicle as one of a body, its quaternion wxyz."""
    quat = None if pose.quat is None else (pose.quat[3], *pose.quat[:3])
    return replace(pose, body=body.body, quat=quat, arrival=pose.arrival + body.time_offset)

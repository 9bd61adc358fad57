"""Poses from a PX4 log (.ulg), read by pyulog (extra ``logs``).

World north, east, down (or forward, right, down where PX4 was told so); body forward, right, down; quaternions wxyz.

| topic | what it is | pose from |
|---|---|---|
| vehicle_local_position | estimate | x y z [m], vx vy vz [m/s], with vehicle_attitude and vehicle_angular_velocity |
| vehicle_odometry | estimate | position, q, velocity, angular_velocity |
| vehicle_visual_odometry, vehicle_mocap_odometry | external pose as received | the same |

Stamps are ``timestamp_sample``, arrivals ``timestamp``. Names of fields before PX4 1.14 (x, y, z, vx, rollspeed) are read
as well.

Source: PX4 message definitions VehicleOdometry, VehicleLocalPosition, VehicleAttitude.
"""

from pathlib import Path
from typing import Any

import numpy as np

from hil.errors import SourceError
from hil.poses.frames import rotate
from hil.poses.pose import Pose, Vector
from hil.sources.logs import LogBody, load_extra, parsing, read_logs
from hil.sources.mavlink import PAIR_AGE
from visthrow.logs.damaged import Forward

LOCAL, ATTITUDE, RATE = "vehicle_local_position", "vehicle_attitude", "vehicle_angular_velocity"
TOPICS = (LOCAL, "vehicle_odometry", "vehicle_visual_odometry", "vehicle_mocap_odometry")
BODY_FRAME = 3
"""VELOCITY_FRAME_BODY_FRD."""


def read_ulg(path: str | Path, bodies: tuple[LogBody, ...]) -> list[Pose]:
    """Poses of a .ulg.

    Raises:
        SourceError: pyulog is missing, no such file, no ULog, a topic that carries no pose or is not in the log.
    """
    return read_logs(path, bodies, TOPICS, _read)


def _read(path: Path, body: LogBody) -> list[Pose]:
    core = load_extra("pyulog", "logs")
    with parsing(path, "a PX4 log (.ulg)"):
        log = core.ULog(Forward(path.read_bytes()), [*TOPICS, ATTITUDE, RATE])
    topics = {(data.name, data.multi_id): data.data for data in log.data_list}
    data = topics.get((body.message, body.instance))
    if data is None:
        names = ", ".join(f"{name} {i}" for name, i in sorted(topics) if name in TOPICS) or "none"
        raise SourceError(f"{path}: no {body.message} {body.instance} in this log; of those with poses it has: {names}")
    try:
        with parsing(path, f"fields of {body.message} as PX4 writes them"):
            return _local(path, data, topics, body) if body.message == LOCAL else _odometry(data, body)
    except SourceError as error:
        if isinstance(error.__cause__, KeyError):
            raise SourceError(f"{path}: no field {error.__cause__}; {body.message} has {', '.join(sorted(data))}") from None
        raise


def _times(data: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and arrivals [s]."""
    arrivals = data["timestamp"] / 1e6
    samples = data.get("timestamp_sample")
    return arrivals if samples is None else np.where(samples > 0, samples / 1e6, arrivals), arrivals


def _columns(data: dict[str, np.ndarray], *names: str) -> np.ndarray:
    return np.column_stack([data[name] for name in names]).astype(float)


def _either(data: dict[str, np.ndarray], new: str, old: tuple[str, str, str]) -> np.ndarray:
    """Three numbers under their name of today, or of before PX4 1.14."""
    names = tuple(f"{new}[{i}]" for i in range(3))
    return _columns(data, *(names if names[0] in data or old[0] not in data else old))


def _odometry(data: dict[str, np.ndarray], body: LogBody) -> list[Pose]:
    stamps, arrivals = _times(data)
    pos, quat = _either(data, "position", ("x", "y", "z")), _columns(data, *(f"q[{i}]" for i in range(4)))
    vel = _either(data, "velocity", ("vx", "vy", "vz"))
    rate = _either(data, "angular_velocity", ("rollspeed", "pitchspeed", "yawspeed"))
    frame = data.get("velocity_frame", np.zeros(len(pos)))
    reset = data.get("reset_counter", np.zeros(len(pos)))
    poses = []
    for i in range(len(pos)):
        attitude, velocity = _known(quat[i]), _known(vel[i])
        if velocity is not None and frame[i] == BODY_FRAME:
            velocity = None if attitude is None else rotate((*attitude[1:], attitude[0]), velocity)
        poses.append(
            Pose(float(stamps[i]), float(arrivals[i]), body.body, tuple(pos[i].tolist()), attitude, velocity,
                 _known(rate[i]), int(reset[i]))
        )  # fmt: skip
    return poses


def _local(path: Path, data: dict[str, np.ndarray], topics: dict[tuple[str, int], Any], body: LogBody) -> list[Pose]:
    attitude, rates = topics.get((ATTITUDE, 0)), topics.get((RATE, 0))
    if attitude is None:
        raise SourceError(f"{path}: {LOCAL} gives no attitude, and the log holds no {ATTITUDE}")
    stamps, arrivals = _times(data)
    pos, vel = _columns(data, "x", "y", "z"), _columns(data, "vx", "vy", "vz")
    turned = _columns(attitude, *(f"q[{i}]" for i in range(4)))
    spun = None if rates is None else _columns(rates, *(f"xyz[{i}]" for i in range(3)))
    before, late = _before(attitude, stamps), _before(rates, stamps)
    counters = [data[name].astype(int) for name in data if name.endswith("reset_counter")]
    resets = sum(counters) if counters else np.zeros(len(pos), int)
    return [
        Pose(float(stamps[i]), float(arrivals[i]), body.body, tuple(pos[i].tolist()), _known(turned[before[i]]),
             _known(vel[i]), None if spun is None or late[i] < 0 else _known(spun[late[i]]), int(resets[i]))
        for i in range(len(pos)) if before[i] >= 0
    ]  # fmt: skip


def _before(data: dict[str, np.ndarray] | None, stamps: np.ndarray) -> np.ndarray:
    """Index of a topic's last sample at or before each stamp; -1 where there is none, or an old one."""
    if data is None:
        return np.full(len(stamps), -1)
    times, _ = _times(data)
    index = np.searchsorted(times, stamps, side="right") - 1
    return np.where((index >= 0) & (stamps - times[np.maximum(index, 0)] <= PAIR_AGE), index, -1)


def _known(values: np.ndarray) -> tuple[float, ...] | Vector | None:
    """PX4 writes NaN for what is not known."""
    return None if np.isnan(values).any() else tuple(values.tolist())

"""Poses from an ArduPilot dataflash log (.BIN).

World north, east, down; body forward, right, down; quaternions wxyz, made from the logged angles.

| message | what it is | pose from |
|---|---|---|
| VISP | external pose as received | PX PY PZ [m], roll pitch yaw [deg]; stamp CTimeMS, arrival TimeUS, reset counter |
| XKF1, NKF1 | estimate of one core | PN PE PD [m], Roll Pitch Yaw [deg], VN VE VD [m/s] |
| POS | estimate on the globe | Lat Lng [deg], height above the origin [m], with ATT's angles |

The file is read as bytes by pymavlink's DFReader alone: no device string, no condition, nothing is evaluated.

Source: ArduPilot, AP_VisualOdom/LogStructure.h, AP_NavEKF3/LogStructure.h, AP_AHRS/LogStructure.h.
"""

import math
from pathlib import Path
from typing import Any

from hil.errors import SourceError
from hil.links.mavlink_link import quaternion_from_euler
from hil.poses.pose import Pose, Quaternion
from hil.sources.logs import LogBody, parsing, read_logs
from hil.sources.mavlink import PAIR_AGE

MESSAGES = ("VISP", "XKF1", "NKF1", "POS")
HEAD = b"\xa3\x95"
"""First bytes of every message; whatever begins otherwise is no such log, and the parser would look for one byte by byte."""

EARTH_RADIUS = 6378100.0
"""ArduPilot's scale of latitude [m]."""


def read_bin(path: str | Path, bodies: tuple[LogBody, ...]) -> list[Pose]:
    """Poses of a .BIN.

    Raises:
        SourceError: no such file, no dataflash log, a message that carries no pose or is not in the log.
    """
    return read_logs(path, bodies, MESSAGES, _read)


def _read(path: Path, body: LogBody) -> list[Pose]:
    from pymavlink.DFReader import DFReader_binary

    builder, poses = _Builder(body), []
    with parsing(path, "an ArduPilot dataflash log (.BIN)"):
        with path.open("rb") as file:
            head = file.read(2)
        if head != HEAD:
            raise SourceError(f"{path}: begins with {head.hex(' ') or 'nothing'}, not a3 95; expected a dataflash log (.BIN)")
        log = DFReader_binary(str(path))
        known = {fmt.name for fmt in log.formats.values()}
        wanted = [body.message, "ATT", "ORGN"] if body.message == "POS" else [body.message]
        while body.message in known and (message := log.recv_match(type=wanted)) is not None:
            pose = builder.feed(message.to_dict())
            if pose is not None:
                poses.append(pose)
        log.close()
    if body.message not in known:
        names = ", ".join(name for name in MESSAGES if name in known) or "none"
        raise SourceError(f"{path}: no {body.message} in this log; of the messages with poses it has: {names}")
    return poses


class _Builder:
    """Makes poses of one body from its messages, in the order of the log."""

    def __init__(self, body: LogBody) -> None:
        self._body, self._origin = body, None
        self._attitude: tuple[float, Quaternion] | None = None

    def feed(self, m: dict[str, Any]) -> Pose | None:
        kind, time = m["mavpackettype"], m["TimeUS"] / 1e6
        if kind == "ORGN" and m.get("Type", 0) == 0:  # of the estimator, not home
            self._origin = (m["Lat"], m["Lng"])
        elif kind == "ATT":
            self._attitude = (time, _quaternion(m["Roll"], m["Pitch"], m["Yaw"]))
        elif kind != self._body.message:
            return None
        elif kind == "POS":
            return self._on_globe(time, m)
        elif kind == "VISP":
            angles = (m[long if long in m else short] for long, short in (("Roll", "R"), ("Pitch", "P"), ("Yaw", "Y")))
            position, reset = (m["PX"], m["PY"], m["PZ"]), int(m.get("Rst", m.get("RstCnt", 0)))
            return Pose(m["CTimeMS"] / 1e3, time, self._body.body, position, _quaternion(*angles), reset=reset)
        elif m.get("C", 0) == self._body.instance:
            quat = _quaternion(m["Roll"], m["Pitch"], m["Yaw"])
            return Pose(time, time, self._body.body, (m["PN"], m["PE"], m["PD"]), quat, (m["VN"], m["VE"], m["VD"]))
        return None

    def _on_globe(self, time: float, m: dict[str, Any]) -> Pose | None:
        if self._attitude is None or time - self._attitude[0] > PAIR_AGE:
            return None
        if self._origin is None:
            self._origin = (m["Lat"], m["Lng"])
        lat, lng = self._origin
        north = math.radians(m["Lat"] - lat) * EARTH_RADIUS
        east = math.radians(m["Lng"] - lng) * EARTH_RADIUS * math.cos(math.radians(lat))
        height = m["RelOriginAlt"] if "RelOriginAlt" in m else m["RelHomeAlt"]
        return Pose(time, time, self._body.body, (north, east, -height), self._attitude[1])


def _quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Attitude wxyz of angles in degrees."""
    return quaternion_from_euler(math.radians(roll), math.radians(pitch), math.radians(yaw))

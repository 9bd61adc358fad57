"""A flight as an MCAP file for Foxglove and other readers: transforms, the scene, the image plane,
commands, all signals. Onboard-safe.

Messages are JSON with Foxglove's schemas where there is one, so that its 3D and image panels show
them without a plug-in. Log time counts from the first sample of the flight."""

import base64
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from camera.keypoints import KeypointCamera
from camera.overlay import draw_overlay
from visthrow.common.errors import LogError
from visthrow.common.extras import load_extra
from visthrow.common.storage import atomic_write
from visthrow.logs.flightlog import FlightLog

IMAGE_PERIOD = 0.04  # between two pictures of the image plane [s]

_NUMBER = {"type": "number"}
_TEXT = {"type": "string"}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


_STAMP = _object(sec={"type": "integer"}, nsec={"type": "integer"})
_XYZ = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_POSE = _object(position=_XYZ, orientation=_object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER))
_ENTITY = _object(
    timestamp=_STAMP,
    frame_id=_TEXT,
    id=_TEXT,
    lines={"type": "array"},
    spheres={"type": "array"},
    cubes={"type": "array"},
)

SCHEMAS = {
    "foxglove.FrameTransform": _object(
        timestamp=_STAMP,
        parent_frame_id=_TEXT,
        child_frame_id=_TEXT,
        translation=_XYZ,
        rotation=_POSE["properties"]["orientation"],
    ),
    "foxglove.PoseInFrame": _object(timestamp=_STAMP, frame_id=_TEXT, pose=_POSE),
    "foxglove.SceneUpdate": _object(
        deletions={"type": "array"}, entities={"type": "array", "items": _ENTITY}
    ),
    "foxglove.CompressedImage": _object(
        timestamp=_STAMP,
        frame_id=_TEXT,
        data={"type": "string", "contentEncoding": "base64"},
        format=_TEXT,
    ),
    "foxglove.Log": _object(timestamp=_STAMP, level={"type": "integer"}, message=_TEXT, name=_TEXT),
    "visthrow.Command": _object(thrust_n=_NUMBER, rate_x=_NUMBER, rate_y=_NUMBER, rate_z=_NUMBER),
    "visthrow.Signal": _object(
        values={"type": "array", "items": _NUMBER}, valid={"type": "boolean"}
    ),
}
"""Name -> JSON schema, of Foxglove's and of ours.

Rates are in rad/s; a signal's unit and frame are its channel's metadata.
"""

Message = tuple[float, str, str, dict[str, Any]]
"""Time [s], topic, schema, content."""


def write(path: str | Path, log: FlightLog, experiment: Any) -> None:
    """Write a flight of :func:`visthrow.throws.recorded.fly`, or of a run, whole or not at all.

    Raises LogError: the package mcap is not installed, or the log has no sample; StorageError: the
    place cannot be written."""
    writing = load_extra("mcap.writer", "recordings", f"{path}: an MCAP file", LogError)
    stamps = [channel.time[0] for channel in log.channels.values() if len(channel.time)]
    if not stamps:
        raise LogError(f"{path}: a flight log without a sample; expected one at least")
    begin = min(stamps)
    stream = io.BytesIO()
    writer = writing.Writer(stream)
    writer.start(library="visthrow")
    schemas = {
        name: writer.register_schema(name, "jsonschema", json.dumps(schema).encode())
        for name, schema in SCHEMAS.items()
    }
    channels: dict[str, int] = {}
    for time, topic, schema, content in sorted(
        _messages(log, experiment, begin), key=lambda message: message[0]
    ):
        if topic not in channels:
            name = topic.removeprefix("/signals/")
            metadata = {"unit": log[name].unit, "frame": log[name].frame} if name != topic else {}
            channels[topic] = writer.register_channel(
                topic, "json", schemas[schema], metadata=metadata
            )
        stamp = round((time - begin) * 1e9)
        writer.add_message(channels[topic], stamp, json.dumps(content).encode(), stamp)
    writer.add_metadata("flight", {key: json.dumps(value) for key, value in log.meta.items()})
    writer.finish()
    atomic_write(path, stream.getvalue())


def _messages(log: FlightLog, experiment: Any, begin: float) -> Iterator[Message]:
    """Messages of a whole flight, topic after topic."""

    def placed(time: float, topic: str, pose: dict[str, Any]) -> Message:
        return (
            time,
            topic,
            "foxglove.PoseInFrame",
            {"timestamp": _stamp(time - begin), "frame_id": "world", "pose": pose},
        )

    if "pos_w" in log and "quat_wb" in log:
        turns = log["quat_wb"].hold(log["pos_w"].time)
        for time, place, turn in zip(log["pos_w"].time, log["pos_w"].values, turns, strict=True):
            moved = {
                "parent_frame_id": "world",
                "child_frame_id": "vehicle",
                "translation": _xyz(place),
                "rotation": _xyzw(turn),
            }
            yield (
                time,
                "/tf",
                "foxglove.FrameTransform",
                {"timestamp": _stamp(time - begin), **moved},
            )
            yield placed(time, "/vehicle", _pose(place, turn))
    for name, topic in (("payload_pos_w", "/payload"), ("goal_w", "/goal")):
        for time, place in _rows(log, name):
            yield placed(time, topic, _pose(place))
    for time, row in _rows(log, "command"):
        yield (
            time,
            "/command",
            "visthrow.Command",
            dict(zip(("thrust_n", "rate_x", "rate_y", "rate_z"), map(float, row), strict=True)),
        )
    yield from _scene(log, experiment, begin)
    yield from _pictures(log, experiment, begin)
    for name, channel in log.channels.items():
        for time, row, valid in zip(
            channel.time, channel.values, np.asarray(channel.valid), strict=True
        ):
            values = [float(x) if np.isfinite(x) else None for x in np.ravel(row)]
            yield (
                time,
                f"/signals/{name}",
                "visthrow.Signal",
                {"values": values, "valid": bool(valid)},
            )
    for time, state, reason in log.meta.get("events", ()):
        message = {
            "timestamp": _stamp(time - begin),
            "level": 3 if state == "abort" else 2,
            "message": f"{state}: {reason}",
            "name": "run",
        }
        yield max(time, begin), "/events", "foxglove.Log", message


def _scene(log: FlightLog, experiment: Any, begin: float) -> Iterator[Message]:
    """Rope, ball and goal as things of the 3D panel."""
    width = 2.0 * experiment.rope.payload_radius
    side = experiment.camera.goal_side
    things: list[tuple[str, str, Any]] = [
        (
            "cable_points_w",
            "rope",
            lambda row: {
                "lines": [
                    {
                        "type": 0,
                        "pose": _pose((0.0, 0.0, 0.0)),
                        "thickness": 0.006,
                        "scale_invariant": False,
                        "points": [_xyz(p) for p in row],
                        "color": _rgba(0.35, 0.3, 0.25),
                        "colors": [],
                        "indices": [],
                    }
                ]
            },
        ),
        (
            "payload_pos_w",
            "ball",
            lambda row: {
                "spheres": [
                    {
                        "pose": _pose(row),
                        "size": _xyz([width] * 3),
                        "color": _rgba(0.8, 0.85, 0.1),
                    }
                ]
            },
        ),
        (
            "goal_w",
            "goal",
            lambda row: {
                "cubes": [
                    {
                        "pose": _pose(row),
                        "size": _xyz([side, side, 0.004]),
                        "color": _rgba(0.2, 0.7, 0.3),
                    }
                ]
            },
        ),
    ]
    for name, entity, shape in things:
        for time, row in _rows(log, name):
            entities = {
                "timestamp": _stamp(time - begin),
                "frame_id": "world",
                "id": entity,
                "frame_locked": False,
                **shape(row),
            }
            yield time, "/scene", "foxglove.SceneUpdate", {"deletions": [], "entities": [entities]}


def _pictures(log: FlightLog, experiment: Any, begin: float) -> Iterator[Message]:
    """The image plane with its keypoints, as pictures of the camera's size."""
    if "keypoints" not in log or "keypoints_valid" not in log:
        return
    camera = KeypointCamera(experiment.camera)
    last = -np.inf
    visible = log["keypoints_valid"].hold(log["keypoints"].time)
    for time, points, valid in zip(
        log["keypoints"].time, log["keypoints"].values, visible, strict=True
    ):
        if time - last < IMAGE_PERIOD - 1e-6:
            continue
        last = time
        image = draw_overlay(
            camera,
            torch.from_numpy(np.array(points, dtype=float)),
            torch.from_numpy(np.array(valid, dtype=bool)),
        )
        data = base64.b64encode(cv2.imencode(".png", image)[1].tobytes()).decode()
        picture = {
            "timestamp": _stamp(time - begin),
            "frame_id": "camera",
            "data": data,
            "format": "png",
        }
        yield time, "/camera/keypoints", "foxglove.CompressedImage", picture


def _rows(log: FlightLog, name: str) -> Iterator[tuple[float, np.ndarray]]:
    if name in log:
        channel = log[name]
        rows = np.flatnonzero(np.asarray(channel.valid))
        yield from zip(channel.time[rows].tolist(), channel.values[rows], strict=True)


def _stamp(seconds: float) -> dict[str, int]:
    nanoseconds = max(round(seconds * 1e9), 0)
    return {"sec": nanoseconds // 10**9, "nsec": nanoseconds % 10**9}


def _xyz(values: Any) -> dict[str, float]:
    return dict(zip("xyz", map(float, values), strict=True))


def _xyzw(values: Any) -> dict[str, float]:
    return dict(zip("xyzw", map(float, values), strict=True))


def _pose(place: Any, turn: Any = (0.0, 0.0, 0.0, 1.0)) -> dict[str, Any]:
    return {"position": _xyz(place), "orientation": _xyzw(turn)}


def _rgba(red: float, green: float, blue: float) -> dict[str, float]:
    return {"r": red, "g": green, "b": blue, "a": 1.0}

"""Write a flight as an MCAP file for Foxglove and other readers: transforms, the scene, the image
plane, commands and all signals. Onboard-safe.

Messages are JSON, with Foxglove's schemas if they exist, so that its 3D and image panels show them
without a plug-in. Log time starts at the first sample of the flight."""

import base64
import io
import json
from collections.abc import Iterable, Iterator
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
from visthrow.common.toml_text import tables_beside
from visthrow.logs.flightlog import FlightLog

IMAGE_PERIOD = 0.04  # time between pictures of the image plane [s]

_SCHEMAS = Path(__file__).parent / "data/mcap_schemas.json"
"""File of name -> JSON schema, Foxglove's and our own.

Rates are in rad/s; a signal's unit and frame are in its channel's metadata.
"""

SCENE = tables_beside(__file__, "data/mcap_scene.toml")
"""Object in the 3D panel -> its style."""

Message = tuple[float, str, str, dict[str, Any]]
"""Time [s], topic, schema, content; `write` adds the time to the content of Foxglove's schemas."""


def write(path: str | Path, log: FlightLog, experiment: Any) -> None:
    """Write a flight of :func:`visthrow.throws.recorded.fly`, or of a run, whole or not at all.

    Raises LogError: the package mcap is not installed, or the log has no sample; StorageError: the
    file cannot be written."""
    writing = load_extra("mcap.writer", "recordings", f"{path}: an MCAP file", LogError)
    stamps = [channel.time[0] for channel in log.channels.values() if len(channel.time)]
    if not stamps:
        raise LogError(f"{path}: a flight log without samples; expected at least one")
    begin = min(stamps)
    stream = io.BytesIO()
    writer = writing.Writer(stream)
    writer.start(library="visthrow")
    schemas = {}
    for name, schema in json.loads(_SCHEMAS.read_text(encoding="utf-8")).items():
        schemas[name] = writer.register_schema(name, "jsonschema", json.dumps(schema).encode())
    channels: dict[str, int] = {}
    messages = sorted(_messages(log, experiment), key=lambda message: max(message[0], begin))
    for time, topic, schema, content in messages:
        if topic not in channels:
            name = topic.removeprefix("/signals/")
            if name != topic:
                metadata = {"unit": log[name].unit, "frame": log[name].frame}
            else:
                metadata = {}
            channel = writer.register_channel(topic, "json", schemas[schema], metadata=metadata)
            channels[topic] = channel
        stamp = round(max(time - begin, 0.0) * 1e9)
        if schema.startswith("foxglove."):
            (stamped,) = content.get("entities", [content])
            stamped["timestamp"] = {"sec": stamp // 10**9, "nsec": stamp % 10**9}
        writer.add_message(channels[topic], stamp, json.dumps(content).encode(), stamp)
    writer.add_metadata("flight", {key: json.dumps(value) for key, value in log.meta.items()})
    writer.finish()
    atomic_write(path, stream.getvalue())


def _messages(log: FlightLog, experiment: Any) -> Iterator[Message]:
    """Yield the messages of a whole flight, topic by topic."""
    if "pos_w" in log and "quat_wb" in log:
        turns = log["quat_wb"].hold(log["pos_w"].time)
        for time, place, turn in zip(log["pos_w"].time, log["pos_w"].values, turns, strict=True):
            moved = {
                "parent_frame_id": "world",
                "child_frame_id": "vehicle",
                "translation": _name("xyz", place),
                "rotation": _name("xyzw", turn),
            }
            yield time, "/tf", "foxglove.FrameTransform", moved
            yield _place(time, "/vehicle", _pose(place, turn))
    for name, topic in (("payload_pos_w", "/payload"), ("goal_w", "/goal")):
        for time, place in _rows(log, name):
            yield _place(time, topic, _pose(place))
    for time, row in _rows(log, "command"):
        command = _name(("thrust_n", "rate_x", "rate_y", "rate_z"), row)
        yield time, "/command", "visthrow.Command", command
    yield from _scene(log, experiment)
    yield from _pictures(log, experiment)
    for name, channel in log.channels.items():
        samples = zip(channel.time, channel.values, np.asarray(channel.valid), strict=True)
        for time, row, valid in samples:
            values = [float(x) if np.isfinite(x) else None for x in np.ravel(row)]
            signal = {"values": values, "valid": bool(valid)}
            yield time, f"/signals/{name}", "visthrow.Signal", signal
    for time, state, reason in log.meta.get("events", ()):
        message = {
            "level": 3 if state == "abort" else 2,
            "message": f"{state}: {reason}",
            "name": "run",
        }
        yield time, "/events", "foxglove.Log", message


def _place(time: float, topic: str, pose: dict[str, Any]) -> Message:
    content = {"frame_id": "world", "pose": pose}
    return time, topic, "foxglove.PoseInFrame", content


def _scene(log: FlightLog, experiment: Any) -> Iterator[Message]:
    """Yield rope, ball and goal as objects of the 3D panel."""

    def make_message(time: float, name: str, kind: str, shape: dict[str, Any]) -> Message:
        entity = {"frame_id": "world", "id": name, "frame_locked": False, kind: [shape]}
        return time, "/scene", "foxglove.SceneUpdate", {"deletions": [], "entities": [entity]}

    for time, row in _rows(log, "cable_points_w"):
        points = [_name("xyz", point) for point in row]
        line = {"pose": _pose((0.0, 0.0, 0.0)), "points": points}
        yield make_message(time, "rope", "lines", line | SCENE["rope"])
    width = 2.0 * experiment.rope.payload_radius
    side = experiment.camera.goal_side
    solids = (
        ("payload_pos_w", "ball", "spheres", (width, width, width)),
        ("goal_w", "goal", "cubes", (side, side, 0.004)),
    )
    for channel, name, kind, size in solids:
        for time, row in _rows(log, channel):
            solid = {"pose": _pose(row), "size": _name("xyz", size)}
            yield make_message(time, name, kind, solid | SCENE[name])


def _pictures(log: FlightLog, experiment: Any) -> Iterator[Message]:
    """Yield the image plane with its keypoints as pictures of the camera's size."""
    if "keypoints" not in log or "keypoints_valid" not in log:
        return
    camera = KeypointCamera(experiment.camera)
    last = -np.inf
    points_of = log["keypoints"]
    visible = log["keypoints_valid"].hold(points_of.time)
    for time, points, valid in zip(points_of.time, points_of.values, visible, strict=True):
        if time - last < IMAGE_PERIOD - 1e-6:
            continue
        last = time
        pixels = torch.from_numpy(np.array(points, dtype=float))
        visible_pixels = torch.from_numpy(np.array(valid, dtype=bool))
        image = draw_overlay(camera, pixels, visible_pixels)
        data = base64.b64encode(cv2.imencode(".png", image)[1].tobytes()).decode()
        picture = {
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


def _name(names: Iterable[str], values: Any) -> dict[str, float]:
    return dict(zip(names, map(float, values), strict=True))


def _pose(place: Any, turn: Any = (0.0, 0.0, 0.0, 1.0)) -> dict[str, Any]:
    return {"position": _name("xyz", place), "orientation": _name("xyzw", turn)}

"""Record a flight for the rerun viewer: the scene in 3D, the image plane, and all signals on one
time line. Onboard-safe.

Time zero is the policy's start. Only the channels in a log are shown: a flight with motion capture
has no motor speeds, and a simulated one no age of its poses. Sizes come from an experiment, or from
an object with ``camera``, ``vehicle.rotors`` and ``rope.payload_radius``."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy import ndarray

from camera.fisheye import Fisheye
from camera.keypoints import GOAL_KEYPOINTS, KeypointCamera
from camera.params import CameraParams
from visthrow.common.errors import StorageError
from visthrow.common.storage import atomic_write
from visthrow.common.toml_text import tables_beside
from visthrow.logs.flightlog import FlightLog
from visthrow.view import style

TIMELINE = "throw_time"
SIGNALS = tables_beside(__file__, "data/signals.toml")
FIELD = 2.0  # margin of the drawn floor around the throw [m]


def write(path: str | Path, log: FlightLog, experiment: Any) -> None:
    """Write a flight of :func:`visthrow.throws.recorded.fly` as a ``.rrd`` file with the viewer's
    layout.

    Raises StorageError: the file cannot be written.
    """
    with open_recording(path, blueprint(np.array(log.meta["goal_w"]), set(log.channels))) as stream:
        send_whole(stream, log, experiment)


def send_whole(stream: rr.RecordingStream, log: FlightLog, experiment: Any) -> None:
    """Send a whole flight; arguments: see :func:`write`."""
    draw_still_parts(stream, log.meta["goal_w"], experiment)
    send(stream, log)
    if "landing" in log:
        _send_landing(stream, log)
    for name, entity in TRAILS.items():
        _trail(stream, log, name, entity)


@contextmanager
def open_recording(
    path: str | Path, layout: rrb.Blueprint | None = None
) -> Iterator[rr.RecordingStream]:
    """Yield a stream whose content is written to a ``.rrd`` file, whole or not at all, with the
    viewer's layout.

    Raises StorageError: the file cannot be written.
    """
    stream = rr.RecordingStream("visthrow", recording_id=None)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "flight.rrd"
        try:
            stream.save(file, default_blueprint=layout)
            yield stream
            stream.flush()
            stream.disconnect()
            content = file.read_bytes()
        except OSError as error:
            raise StorageError(f"cannot write the recording: {error}") from error
    atomic_write(path, content)


def _send(stream: rr.RecordingStream, entity: str, log: FlightLog, name: str, columns: Any) -> None:
    """Send columns with one row for each sample of a channel."""
    time = log[name].time - log.meta["times"]["policy_start"]
    stream.send_columns(entity, [rr.TimeColumn(TIMELINE, duration=time)], columns)


def colour_code(hexadecimal: str, alpha: int = 255) -> list[int]:
    """Return red, green, blue and opacity of ``#rrggbb``."""
    return [*(int(hexadecimal[i : i + 2], 16) for i in (1, 3, 5)), alpha]


TRAILS = {"payload_pos_w": "world/trail/ball", "pos_w": "world/trail/vehicle"}
"""Channel -> entity of its trail, which grows during a throw."""


def _looks() -> dict[str, dict[str, Any]]:
    looks = tables_beside(__file__, "data/rerun_looks.toml")
    for look in looks.values():
        opacity = look.pop("opacity", 255)
        names = look["colors"]
        look["colors"] = [colour_code(getattr(style, name, name), opacity) for name in names]
    return looks


LOOKS = _looks()
"""Entity -> its style in the viewer."""


def draw_still_parts(stream: rr.RecordingStream, goal_w: Any, experiment: Any) -> None:
    """Send the static parts: ground, shapes, styles, the camera's field of view; ``goal_w``:
    target [m], shape (3,).
    """
    _draw_scene(stream, np.asarray(goal_w, dtype=float), experiment)
    _draw_vehicle(stream, experiment.vehicle.rotors)
    _draw_plane(stream, experiment.camera)


def _draw(stream: rr.RecordingStream, entity: str, shape: Any, *places: Any, **values: Any) -> None:
    """Send a static shape with its style in :data:`LOOKS`."""
    stream.log(entity, shape(*places, **values, **LOOKS[entity]), static=True)


def _draw_scene(stream: rr.RecordingStream, goal: ndarray, experiment: Any) -> None:
    """Send ground, goal, ball, rope and trails."""
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    reach = 0.5 * np.abs(goal[:2]) + FIELD
    middle = [*(0.5 * goal[:2]), -0.011]
    _draw(stream, "world/ground", rr.Boxes3D, centers=[middle], half_sizes=[[*reach, 0.01]])
    half = experiment.camera.goal_side / 2.0
    corners = half * np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0], [1, 1, 0]])
    stream.log("world/goal", rr.Transform3D(translation=goal), static=True)
    _draw(stream, "world/goal", rr.LineStrips3D, [corners + [0, 0, 0.003]])
    _draw(stream, "world/goal/centre", rr.Points3D, [[0.0, 0.0, 0.0]])
    radius = experiment.rope.payload_radius
    _draw(stream, "world/ball", rr.Ellipsoids3D, half_sizes=[[radius] * 3])
    for entity in ("world/rope", *TRAILS.values()):
        _draw(stream, entity, rr.LineStrips3D.from_fields)


def send(stream: rr.RecordingStream, log: FlightLog) -> None:
    """Send the moving parts of a flight or of a part of one; :func:`draw_still_parts` sends the
    static ones.
    """
    if "pos_w" in log and "quat_wb" in log:
        turns = log["quat_wb"].hold(log["pos_w"].time)
        pose = rr.Transform3D.columns(translation=log["pos_w"].values, quaternion=turns)
        _send(stream, "world/vehicle", log, "pos_w", pose)
    if "cable_points_w" in log:
        strips = list(log["cable_points_w"].values.astype(np.float32))
        _send(stream, "world/rope", log, "cable_points_w", rr.LineStrips3D.columns(strips=strips))
    for name, entity in (("payload_pos_w", "world/ball"), ("goal_w", "world/goal")):
        if name in log:
            places = rr.Transform3D.columns(translation=log[name].values)
            _send(stream, entity, log, name, places)
    if "keypoints" in log:
        _image(stream, log)
    _signals(stream, log)
    for time, state, reason in log.meta.get("events", ()):
        stream.set_time(TIMELINE, duration=time - log.meta["times"]["policy_start"])
        stream.log(
            "events", rr.TextLog(f"{state}: {reason}", level="WARN" if state == "abort" else "INFO")
        )


def _send_landing(stream: rr.RecordingStream, log: FlightLog) -> None:
    label = f"{100 * log.meta['result']['error']:.1f} cm off"
    _draw(stream, "world/landing", rr.Points3D.from_fields, labels=[label])
    where = rr.Points3D.columns(positions=log["landing"].values.astype(np.float32))
    _send(stream, "world/landing", log, "landing", where)


def _draw_vehicle(stream: rr.RecordingStream, rotors: Any) -> None:
    hubs = np.column_stack((rotors.x, rotors.y, np.full(4, rotors.z)))
    arms = [np.vstack(([0.0, 0.0, rotors.z], hub)) for hub in hubs]
    disc = [rotors.radius, rotors.radius, 0.002]
    centers = hubs + [0, 0, 0.008]
    _draw(stream, "world/vehicle/arms", rr.LineStrips3D, arms)
    _draw(stream, "world/vehicle/body", rr.Boxes3D, half_sizes=[[0.028, 0.018, 0.014]])
    _draw(stream, "world/vehicle/rotors", rr.Ellipsoids3D, centers=centers, half_sizes=[disc] * 4)


def _trail(stream: rr.RecordingStream, log: FlightLog, name: str, entity: str) -> None:
    """Send a trail that grows from the policy's start to the landing."""
    times = log.meta["times"]
    time = log[name].time
    last = times.get("landing", np.inf) + 0.02
    rows = np.flatnonzero((time >= times["policy_start"] - 1e-9) & (time <= last))[1:]
    if len(rows):
        places = log[name].values.astype(np.float32)
        strips = [places[rows[0] - 1 : row + 1] for row in rows]
        column = rr.TimeColumn(TIMELINE, duration=time[rows] - times["policy_start"])
        stream.send_columns(entity, [column], rr.LineStrips3D.columns(strips=strips))


def trail(stream: rr.RecordingStream, name: str, time: float, points: ndarray) -> None:
    """Send the present trail of a body, for a flight in progress.

    Args:
        stream: the recording. name: channel in :data:`TRAILS`.
        time: time of the trail's end, relative to the policy's start [s].
        points: the trail [m], shape (N, 3).
    """
    stream.set_time(TIMELINE, duration=time)
    stream.log(TRAILS[name], rr.LineStrips3D.from_fields(strips=[points.astype(np.float32)]))


GROUPS = {"goal": slice(GOAL_KEYPOINTS), "payload": slice(GOAL_KEYPOINTS, None)}
"""Object -> its keypoints."""


def _draw_plane(stream: rr.RecordingStream, camera: CameraParams) -> None:
    """Send field of view and body axes in normalised image coordinates times 100, a scale that fits
    the viewer's line widths.
    """
    import torch

    lens = Fisheye(camera.fisheye)
    angle = np.linspace(0.0, 2.0 * np.pi, 121)
    circle = 100 * np.column_stack((np.cos(angle), np.sin(angle)))
    right = float(lens.radius_from_angle(torch.tensor(np.pi / 2)) / lens.edge_radius)
    _draw(stream, "camera/field_of_view", rr.LineStrips2D, [circle, right * circle])
    # the label of a strip itself would be in the middle, on the ball
    places = [[0.0, 95.0], [0.0, 100.0 * right - 4.0]]
    names = [f"{camera.fisheye.fov_deg / 2:g}° off the axis", "90°"]
    _draw(stream, "camera/angles", rr.Points2D, places, labels=names)
    # rows: the body's x and y as directions in the image
    axes = 22.0 * KeypointCamera(camera).rot_cb.numpy().T[:2, :2]
    _draw(stream, "camera/body_axes", rr.Arrows2D, vectors=axes)
    _draw(stream, "camera/body_axes/names", rr.Points2D, 1.2 * axes, labels=["x", "y"])
    for name in ("invalid", *GROUPS):
        _draw(stream, f"camera/{name}", rr.Points2D.from_fields)
    for name in GROUPS:
        _draw(stream, f"camera/{name}/outline", rr.LineStrips2D.from_fields)


def _image(stream: rr.RecordingStream, log: FlightLog) -> None:
    """Send keypoints in the plane of :func:`_draw_plane`; invalid ones are grey, at their recorded
    positions.
    """
    points = 100.0 * log["keypoints"].values
    valid = log["keypoints_valid"].values.astype(bool)
    for name, part in GROUPS.items():
        _points(stream, log, f"camera/{name}", points[:, part], valid[:, part])
        _outline(stream, log, name, points[:, part], valid[:, part].all(axis=1))
    _points(stream, log, "camera/invalid", points, ~valid)


def _points(stream, log: FlightLog, entity: str, points: ndarray, visible: ndarray) -> None:
    columns = rr.Points2D.columns(positions=points[visible].astype(np.float32))
    _send(stream, entity, log, "keypoints", columns.partition(visible.sum(axis=1)))


def _outline(stream, log: FlightLog, name: str, points: ndarray, whole: ndarray) -> None:
    """Send the closed outline of a group at times when all its keypoints are visible; the payload's
    keypoints are the midpoints of a box's edges.
    """
    if not whole.any():
        return
    corners = points[whole]
    if name == "payload":
        x = corners[:, [0, 2, 2, 0], 0]
        y = corners[:, [1, 1, 3, 3], 1]
        corners = np.stack((x, y), axis=-1)
    closed = np.concatenate((corners, corners[:, :1]), axis=1).astype(np.float32)
    columns = rr.LineStrips2D.columns(strips=list(closed)).partition(whole.astype(int))
    _send(stream, f"camera/{name}/outline", log, "keypoints", columns)


def _signals(stream: rr.RecordingStream, log: FlightLog) -> None:
    """Send a curve for each component of the channels in the log."""
    tables = dict(SIGNALS["curves"])
    ticks = [name for name in log.channels if name.startswith("tick_")]
    for i, name in enumerate(ticks):
        step = name.removeprefix("tick_")
        tables[name] = {f"tick/{step}": [f"{step} [ms]", i % len(style.COLOURS)]}
    states = ", ".join(log.meta.get("states", ()))
    for channel, curves in tables.items():
        if channel not in log:
            continue
        components = np.atleast_2d(log[channel].values.T.astype(float))
        for (entity, curve), values in zip(curves.items(), components, strict=True):
            label, number, *pale = curve
            colour = _paler(style.COLOURS[number]) if pale else style.COLOURS[number]
            label = label.format(states=states)
            series = rr.SeriesLines(names=[label], colors=[colour_code(colour)])
            stream.log(f"signals/{entity}", series, static=True)
            scale = 1e3 if label.endswith("[ms]") else 1.0  # channels are in seconds
            column = rr.Scalars.columns(scalars=scale * values)
            _send(stream, f"signals/{entity}", log, channel, column)


def _paler(colour: str) -> str:
    return "#" + "".join(f"{(int(colour[i : i + 2], 16) + 255) // 2:02x}" for i in (1, 3, 5))


def blueprint(goal: ndarray, channels: set[str]) -> rrb.Blueprint:
    """Return the viewer's layout for a target [m], shape (3,), and the channels of a log."""
    middle = np.array([0.5 * goal[0], 0.5 * goal[1], 0.9])
    eye = rrb.EyeControls3D(
        position=middle + [0.3, -3.4, 0.9], look_target=middle, eye_up=[0.0, 0.0, 1.0]
    )
    plain = {"background": [245, 246, 248], "line_grid": rrb.LineGrid3D(visible=False)}
    scene = rrb.Spatial3DView(origin="world", name="Throw", eye_controls=eye, **plain)
    bounds = rrb.VisualBounds2D(x_range=[-106, 106], y_range=[-106, 106])
    image = rrb.Spatial2DView(
        origin="camera", name="Fisheye keypoints", background=[12, 12, 14], visual_bounds=bounds
    )
    plots: list[Any] = []
    for plot in SIGNALS["plots"]:
        if channels.issuperset(plot["needs"]) and channels.isdisjoint(plot["lacks"]):
            plots.append(_plot(plot["name"], *plot["range"], *plot["entities"]))
    if "state" in channels:
        plots.append(rrb.TextLogView(origin="events", name="States"))
    top = rrb.Horizontal(scene, image, column_shares=[2.2, 1.0])
    below = rrb.Grid(*plots, grid_columns=3)
    return rrb.Blueprint(rrb.Vertical(top, below, row_shares=[1.7, 1.0]), collapse_panels=True)


def _plot(name: str, low: float, high: float, *entities: str) -> rrb.TimeSeriesView:
    axes = {
        "axis_x": rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal),
        "axis_y": rrb.ScalarAxis(range=(low, high), zoom_lock=False),
        "plot_legend": rrb.PlotLegend(visible=True),
    }
    contents = [f"/signals/{e}/**" for e in entities]
    return rrb.TimeSeriesView(origin="signals", contents=contents, name=name, **axes)

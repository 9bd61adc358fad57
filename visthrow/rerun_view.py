"""The recording of a throw for the rerun viewer: the scene in 3D, the image plane, and all signals on one time line.

The only module that imports rerun. Time zero is the policy's start.
"""

import tempfile
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from camera.fisheye import Fisheye
from camera.keypoints import GOAL_KEYPOINTS
from camera.params import CameraParams
from visthrow import style
from visthrow.errors import StorageError
from visthrow.flightlog import FlightLog
from visthrow.storage import atomic_write
from visthrow.task import Experiment

TIMELINE = "throw_time"
ROTOR_NAMES = ("front left", "front right", "rear left", "rear right")
AXES = ("x", "y", "z")
FIELD = 2.0  # half-width of the drawn floor about the throw [m]


def write(path: str | Path, log: FlightLog, experiment: Experiment) -> None:
    """Write a flight as a ``.rrd`` file with a blueprint that lays out the viewer.

    Args:
        path: The file.
        log: a flight of :func:`visthrow.flight.fly`.
        experiment: for the sizes of vehicle, ball and camera.

    Raises:
        StorageError: the place cannot be written.
    """
    goal = np.array(log.meta["goal_w"])
    stream = rr.RecordingStream("visthrow", recording_id=None)
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "throw.rrd"
        try:
            stream.save(whole, default_blueprint=_blueprint(goal))
            _scene(stream, log, experiment, goal)
            _image(stream, log, experiment.camera)
            _signals(stream, log)
            stream.flush()
            stream.disconnect()
            content = whole.read_bytes()
        except OSError as error:
            raise StorageError(f"cannot write the recording: {error}") from error
    atomic_write(path, content)


def _times(log: FlightLog, name: str) -> rr.TimeColumn:
    return rr.TimeColumn(TIMELINE, duration=log[name].time - log.meta["times"]["policy_start"])


def _colour(hexadecimal: str, alpha: int = 255) -> list[int]:
    return [*(int(hexadecimal[i : i + 2], 16) for i in (1, 3, 5)), alpha]


def _scene(stream: rr.RecordingStream, log: FlightLog, experiment: Experiment, goal: np.ndarray) -> None:
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    middle, reach = 0.5 * goal[:2], 0.5 * np.abs(goal[:2]) + FIELD
    floor = rr.Boxes3D(
        centers=[[*middle, -0.011]], half_sizes=[[*reach, 0.01]], colors=[[232, 230, 224]], fill_mode="solid"
    )
    stream.log("world/ground", floor, static=True)
    half = experiment.camera.goal_side / 2.0
    corners = goal + half * np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0], [1, 1, 0]])
    stream.log(
        "world/goal", rr.LineStrips3D([corners + [0, 0, 0.003]], radii=0.006, colors=[_colour(style.GOAL)]), static=True
    )
    stream.log("world/goal/centre", rr.Points3D([goal], radii=0.012, colors=[_colour(style.GOAL)]), static=True)
    _vehicle(stream, log, experiment)
    radius = experiment.rope.payload_radius
    ball = rr.Ellipsoids3D(half_sizes=[[radius] * 3], colors=[_colour(style.PAYLOAD)], fill_mode="solid")
    stream.log("world/ball", ball, static=True)
    moved = rr.Transform3D.columns(translation=log["payload_pos_w"].values)
    stream.send_columns("world/ball", [_times(log, "payload_pos_w")], moved)
    rope = log["cable_points_w"].values.astype(np.float32)
    stream.log("world/rope", rr.LineStrips3D.from_fields(radii=0.003, colors=[_colour(style.ROPE)]), static=True)
    stream.send_columns("world/rope", [_times(log, "cable_points_w")], rr.LineStrips3D.columns(strips=list(rope)))
    _trail(stream, log, "payload_pos_w", "world/trail/ball", style.PAYLOAD)
    _trail(stream, log, "pos_w", "world/trail/vehicle", style.QUIET)
    if "landing" in log:
        mark = rr.Points3D.from_fields(radii=0.015, colors=[_colour(style.INK)], labels=[_landing(log)])
        stream.log("world/landing", mark, static=True)
        where = rr.Points3D.columns(positions=log["landing"].values.astype(np.float32))
        stream.send_columns("world/landing", [_times(log, "landing")], where)


def _landing(log: FlightLog) -> str:
    return f"{100 * log.meta['result']['error']:.1f} cm off"


def _vehicle(stream: rr.RecordingStream, log: FlightLog, experiment: Experiment) -> None:
    rotors = experiment.vehicle.rotors
    hubs = np.column_stack((rotors.x, rotors.y, np.full(4, rotors.z)))
    arms = [np.vstack(([0.0, 0.0, rotors.z], hub)) for hub in hubs]
    dark = _colour(style.VEHICLE)
    stream.log("world/vehicle/arms", rr.LineStrips3D(arms, radii=0.005, colors=[dark]), static=True)
    hub_size = [[0.028, 0.018, 0.014]]
    stream.log("world/vehicle/body", rr.Boxes3D(half_sizes=hub_size, colors=[dark], fill_mode="solid"), static=True)
    discs = rr.Ellipsoids3D(
        centers=hubs + [0, 0, 0.008], half_sizes=[[rotors.radius, rotors.radius, 0.002]] * 4, fill_mode="solid",
        colors=[_colour(style.COLOURS[0] if hub[0] > 0 else "#9AA5B1") for hub in hubs],  # the front ones stand out
    )  # fmt: skip
    stream.log("world/vehicle/rotors", discs, static=True)
    pose = rr.Transform3D.columns(translation=log["pos_w"].values, quaternion=log["quat_wb"].values)
    stream.send_columns("world/vehicle", [_times(log, "pos_w")], pose)


def _trail(stream: rr.RecordingStream, log: FlightLog, name: str, entity: str, colour: str) -> None:
    """A line that grows from the policy's start to the landing."""
    times, channel = log.meta["times"], log[name]
    rows = np.flatnonzero(
        (channel.time >= times["policy_start"] - 1e-9) & (channel.time <= times.get("landing", np.inf) + 0.02)
    )
    rows = rows[1:]
    if not len(rows):
        return
    first = rows[0] - 1
    strips = [channel.values[first : row + 1].astype(np.float32) for row in rows]
    stream.log(entity, rr.LineStrips3D.from_fields(radii=0.004, colors=[_colour(colour, 170)]), static=True)
    column = rr.TimeColumn(TIMELINE, duration=channel.time[rows] - times["policy_start"])
    stream.send_columns(entity, [column], rr.LineStrips3D.columns(strips=strips))


def _image(stream: rr.RecordingStream, log: FlightLog, camera: CameraParams) -> None:
    """Keypoints in normalised image coordinates times 100, so that the viewer's pixel-sized strokes fit."""
    lens = Fisheye(camera.fisheye)
    angle = np.linspace(0.0, 2.0 * np.pi, 121)
    circle = np.column_stack((np.cos(angle), np.sin(angle)))
    import torch

    right = float(lens.radius_from_angle(torch.tensor(np.pi / 2)) / lens.edge_radius)
    rings = rr.LineStrips2D(
        [100 * circle, 100 * right * circle], colors=[[150, 150, 150], [80, 80, 80]], radii=[0.7, 0.4],
        show_labels=False,
    )  # fmt: skip
    stream.log("camera/field_of_view", rings, static=True)
    places = [[0.0, 95.0], [0.0, 100.0 * right - 4.0]]  # a strip's own label would stand in the middle, on the ball
    names = [f"{camera.fisheye.fov_deg / 2:g}° off the axis", "90°"]
    stream.log("camera/angles", rr.Points2D(places, labels=names, radii=0.1, colors=[150, 150, 150]), static=True)
    points, valid = 100.0 * log["keypoints"].values, log["keypoints_valid"].values.astype(bool)
    groups = {
        "goal": (slice(0, GOAL_KEYPOINTS), [60, 200, 80]),
        "payload": (slice(GOAL_KEYPOINTS, None), [230, 60, 60]),
    }
    for name, (part, colour) in groups.items():
        _points(stream, log, f"camera/{name}", points[:, part], valid[:, part], colour, 1.8)
        _outline(stream, log, f"camera/{name}/outline", points[:, part], valid[:, part], colour, box=name == "payload")
    _points(stream, log, "camera/invalid", points, ~valid, [170, 170, 170], 1.2)


def _points(
    stream, log: FlightLog, entity: str, points: np.ndarray, shown: np.ndarray, colour: list[int], radius: float
) -> None:
    stream.log(entity, rr.Points2D.from_fields(radii=radius, colors=[colour]), static=True)
    columns = rr.Points2D.columns(positions=points[shown].astype(np.float32)).partition(shown.sum(axis=1))
    stream.send_columns(entity, [_times(log, "keypoints")], columns)


def _outline(
    stream, log: FlightLog, entity: str, points: np.ndarray, valid: np.ndarray, colour: list[int], box: bool
) -> None:
    """Closed outline of a group while all of it is seen; the payload's four are the midpoints of a box's edges."""
    whole = valid.all(axis=1)
    strips = []
    for p in points[whole]:
        if box:
            left, top, right, bottom = p[0, 0], p[1, 1], p[2, 0], p[3, 1]
            p = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
        strips.append(np.vstack((p, p[:1])).astype(np.float32))
    stream.log(entity, rr.LineStrips2D.from_fields(radii=0.5, colors=[colour]), static=True)
    if strips:
        columns = rr.LineStrips2D.columns(strips=strips).partition(whole.astype(int))
        stream.send_columns(entity, [_times(log, "keypoints")], columns)


def _signals(stream: rr.RecordingStream, log: FlightLog) -> None:
    def series(entity: str, name: str, values: np.ndarray, label: str, colour: str) -> None:
        stream.log(entity, rr.SeriesLines(names=[label], colors=[_colour(colour)]), static=True)
        stream.send_columns(entity, [_times(log, name)], rr.Scalars.columns(scalars=values.astype(float)))

    command = log["command"].values
    series("signals/thrust", "command", command[:, 0], "collective thrust [N]", style.COLOURS[0])
    for i, axis in enumerate(AXES):
        series(
            f"signals/rate_command/{axis}", "command", command[:, 1 + i], f"{axis} commanded [rad/s]", style.COLOURS[i]
        )
        series(
            f"signals/rate/{axis}",
            "rate_b",
            log["rate_b"].values[:, i],
            f"{axis} flown [rad/s]",
            _paler(style.COLOURS[i]),
        )
    for i, rotor in enumerate(ROTOR_NAMES):
        series(
            f"signals/motors/{i}", "motor_speed", log["motor_speed"].values[:, i], f"{rotor} [rad/s]", style.COLOURS[i]
        )
    series("signals/battery", "battery_voltage", log["battery_voltage"].values, "battery [V]", style.COLOURS[2])
    series("signals/phase/mode", "mode", log["mode"].values, "0 hover controller, 1 policy", style.COLOURS[0])
    series("signals/phase/attached", "attached", log["attached"].values, "payload attached", style.COLOURS[1])
    series(
        "signals/phase/release", "release_command", log["release_command"].values, "release command", style.COLOURS[3]
    )


def _paler(colour: str) -> str:
    return "#" + "".join(f"{(int(colour[i : i + 2], 16) + 255) // 2:02x}" for i in (1, 3, 5))


def _blueprint(goal: np.ndarray) -> rrb.Blueprint:
    middle = np.array([0.5 * goal[0], 0.5 * goal[1], 0.9])
    eye = rrb.EyeControls3D(position=middle + [0.3, -3.4, 0.9], look_target=middle, eye_up=[0.0, 0.0, 1.0])
    scene = rrb.Spatial3DView(
        origin="world",
        name="Throw",
        background=[245, 246, 248],
        eye_controls=eye,
        line_grid=rrb.LineGrid3D(visible=False),
    )
    bounds = rrb.VisualBounds2D(x_range=[-106, 106], y_range=[-106, 106])
    image = rrb.Spatial2DView(origin="camera", name="Fisheye keypoints", background=[12, 12, 14], visual_bounds=bounds)
    axis = rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal)

    def plot(name: str, low: float, high: float, *entities: str) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            name=name, origin="signals", contents=[f"/signals/{e}/**" for e in entities], axis_x=axis,
            axis_y=rrb.ScalarAxis(range=(low, high), zoom_lock=False), plot_legend=rrb.PlotLegend(visible=True),
        )  # fmt: skip

    plots = rrb.Grid(
        plot("Phase", -0.1, 1.1, "phase"), plot("Collective thrust [N]", 0.0, 14.0, "thrust"),
        plot("Body rates [rad/s]", -11.0, 11.0, "rate_command", "rate"),
        plot("Motor speeds [rad/s]", 0.0, 4000.0, "motors"), plot("Battery [V]", 13.0, 17.0, "battery"), grid_columns=3,
    )  # fmt: skip
    top = rrb.Horizontal(scene, image, column_shares=[2.2, 1.0])
    return rrb.Blueprint(rrb.Vertical(top, plots, row_shares=[1.7, 1.0]), collapse_panels=True)

"""Draw a throw as a strip of side views, as the paper does, with the camera's images at the same
times.
"""

import dataclasses
from pathlib import Path

import numpy as np
import torch

from camera.keypoints import GOAL_KEYPOINTS, KeypointCamera, keypoints
from camera.overlay import draw_overlay
from camera.params import CameraParams
from visthrow.common.errors import LogError
from visthrow.common.rotations import Vector, matrix_of_quat
from visthrow.common.storage import atomic_write
from visthrow.logs.flightlog import FlightLog
from visthrow.view import style
from visthrow.view.figures import LOOKS
from visthrow.view.parts import png_of

MARGIN = 0.35  # margin around the visible objects [m]
GROUND = 0.13  # margin shown below z = 0 [m]
# widths of the picture, its left margin, a panel, and the gap between panels [inch]
WIDTH = 13.6
LEFT_MARGIN = 0.62
PANEL = 3.06
GAP = 0.22

ARM = 0.097  # half the motor-to-motor diagonal, for drawing only [m]
ROTOR = 0.0381  # propeller radius, for drawing only [m]
BLADE_HEIGHT = 0.018  # height of the rotor plane, for drawing only [m]
PIXELS = 480  # larger side of the drawn camera picture
GHOST_EVERY = 0.06  # time between the faint earlier poses [s]


def draw(path: str | Path, log: FlightLog, camera: CameraParams) -> None:
    """Draw the strip of a flight, with keypoints projected by this camera, as a PNG file.

    Raises LogError: the flight has no release or landing; StorageError: the file cannot be
    written."""
    meta = log.meta
    times = meta["times"]
    if "separation" not in times or "landing" not in times:
        raise LogError(
            "the flight has no release and landing to draw:"
            f" {meta['result'].get('failure') or 'it is incomplete'}"
        )
    start = times["policy_start"]
    separation = times["separation"]
    halfway = start + 0.55 * (separation - start)
    views = [
        ("Hover", start),
        ("Accelerate", halfway),
        ("Release", separation),
        ("Landing", times["landing"]),
    ]
    style.use()
    import matplotlib.pyplot as plt

    side = _bounds(log)
    upper = PANEL * (side[2] + GROUND) / (side[1] - side[0])  # heights in inches from here on
    height = 1.18 + upper + 0.98 + PANEL + 0.08
    figure = plt.figure(figsize=(WIDTH, height))
    lens = KeypointCamera(shrink_lens(camera))
    all_visible = True
    for column, (caption, time) in enumerate(views):
        x = LEFT_MARGIN + column * (PANEL + GAP)
        axis = figure.add_axes((x / WIDTH, (PANEL + 1.06) / height, PANEL / WIDTH, upper / height))
        _side_view(axis, log, time, side, column)
        axis.set_title(f"({'abcd'[column]})  {caption},  t = {time - start:.2f} s", loc="left")
        axis = figure.add_axes((x / WIDTH, 0.08 / height, PANEL / WIDTH, PANEL / height))
        all_visible &= _camera_view(axis, log, lens, time, first=column == 0)
    texts = {"x": LEFT_MARGIN / WIDTH, "ha": "left", "va": "top"}
    figure.suptitle(_headline(log), y=1.0 - 0.2 / height, fontsize=13.5, fontweight="bold", **texts)
    quiet = {"fontsize": 10.5, "color": style.QUIET, **texts}
    if meta["plant"] == "poses":
        where = f"Flown on {meta['plant_meaning']}"
    else:
        where = f"Simulated on {meta['plant_meaning']}"
    legend = (
        f"Faint: the vehicle every {GHOST_EVERY:g} s. Brown: the rope. Dashed: the ball in free"
        " flight."
    )
    figure.text(y=1.0 - 0.54 / height, s=f"{where}, seen from the side. {legend}", **quiet)
    unseen = "" if all_visible else "; a cross: outside the field of view"
    field = f"{camera.fisheye.fov_deg:g}°"
    note = (
        f"The same instants on the fisheye image ({field}): corners of the target square, box of"
        f" the ball{unseen}"
    )
    figure.text(y=(PANEL + 0.42) / height, s=note, **quiet)
    atomic_write(path, png_of(figure))


def _headline(log: FlightLog) -> str:
    result = log.meta["result"]
    goal = log.meta["goal_w"]
    return (
        f"Policy {log.meta['policy']}, target {np.hypot(goal[0], goal[1]):.1f} m: the ball lands "
        f"{100 * result['error']:.1f} cm from it, {result['duration']:.2f} s after the start"
    )


def shrink_lens(camera: CameraParams) -> CameraParams:
    """Return the camera with fewer pixels, so that the overlay's lines are relatively thicker."""
    lens = camera.fisheye
    scale = PIXELS / max(lens.width, lens.height)
    size = {"width": round(scale * lens.width), "height": round(scale * lens.height)}
    focus = {
        "fx": scale * lens.fx,
        "fy": scale * lens.fy,
        "cx": scale * (lens.cx + 0.5) - 0.5,
        "cy": scale * (lens.cy + 0.5) - 0.5,
    }
    return dataclasses.replace(camera, fisheye=dataclasses.replace(lens, **size, **focus))


def _bounds(log: FlightLog) -> Vector:
    """Return the left, right and upper bounds of the side views [m]."""
    times = log.meta["times"]
    paths = []
    for positions in (log["pos_w"], log["payload_pos_w"]):
        time = positions.time
        during = (time >= times["policy_start"]) & (time <= times["landing"] + 0.02)
        paths.append(positions.values[during])
    path = np.concatenate(paths)
    x = np.append(path[:, 0], log.meta["goal_w"][0])
    top = path[:, 2].max()
    if top <= 0.0:
        raise LogError(
            f"vehicle and payload were always {-top:.1f} m or more below the floor; expected a"
            " flight above it"
        )
    return float(x.min() - MARGIN), float(x.max() + MARGIN), float(top + 0.6 * MARGIN)


def _side_view(axis, log: FlightLog, time: float, side: Vector, column: int) -> None:
    from matplotlib.patches import Circle, Rectangle

    origin_x, right, top = side
    times = log.meta["times"]
    goal = log.meta["goal_w"]
    axis.set(xlim=(origin_x, right), ylim=(-GROUND, top), aspect="equal")
    axis.set_yticks(np.arange(0.0, top, 0.5))
    floor = Rectangle((origin_x, -GROUND), right - origin_x, GROUND, **LOOKS["floor"])
    axis.add_patch(floor)
    axis.axhline(0.0, **LOOKS["floor_line"])
    axis.plot([goal[0] - 0.125, goal[0] + 0.125], [0, 0], **LOOKS["goal"])
    if column:
        axis.tick_params(labelleft=False)
    else:
        axis.set_ylabel("height [m]")
        axis.set_xlabel("distance ahead [m]")
        axis.annotate("target", (goal[0], 0.0), **LOOKS["goal_label"])
    axis.tick_params(length=2.5)
    for past in np.arange(times["policy_start"], time - 0.03, GHOST_EVERY):
        _vehicle(axis, log, past, 0.16)
    payload = log["payload_pos_w"]
    visible = (payload.time >= times["policy_start"]) & (payload.time < time)
    path = np.vstack([payload.values[visible], log["payload_pos_w"].at(time)])
    when = np.append(payload.time[visible], time)
    carried = when <= times["separation"] + 1e-6
    flown = when >= times["separation"] - 0.02
    axis.plot(path[carried, 0], path[carried, 2], **LOOKS["carried"])
    if np.count_nonzero(flown) > 1:
        axis.plot(path[flown, 0], path[flown, 2], **LOOKS["flown"])
    if log["cable_points_w"].time[-1] > time - 0.05:  # poses do not show a rope after separation
        rope = log["cable_points_w"].at(time)
        axis.plot(rope[:, 0], rope[:, 2], **LOOKS["rope"])
    _vehicle(axis, log, time, 1.0)
    ball = log["payload_pos_w"].at(time)
    axis.add_patch(Circle((ball[0], ball[2]), 0.033, **LOOKS["ball"]))


def _vehicle(axis, log: FlightLog, time: float, alpha: float) -> None:
    """Draw arms and rotor discs as seen along y."""
    pos = log["pos_w"].at(time)
    rot = matrix_of_quat(log["quat_wb"].at(time)[None])[0]
    for foot in (ARM / np.sqrt(2.0), -ARM / np.sqrt(2.0)):
        strokes = [((0.0, 0.0), (foot, 0.0), 2.4)]
        if alpha == 1.0:
            strokes.append(((foot, 0.0), (foot, BLADE_HEIGHT), 1.2))
            strokes.append(((foot - ROTOR, BLADE_HEIGHT), (foot + ROTOR, BLADE_HEIGHT), 1.8))
        for first, last, width in strokes:
            ends = pos + np.array([first, last]) @ rot[:, ::2].T
            axis.plot(ends[:, 0], ends[:, 2], lw=width, alpha=alpha, **LOOKS["vehicle"])


def _camera_view(axis, log: FlightLog, camera: KeypointCamera, time: float, first: bool) -> bool:
    """Draw the keypoints of the true poses at a time, with labels in the first view; return whether
    all are visible.
    """

    def one(name: str) -> torch.Tensor:
        return torch.tensor(log[name].at(time)[None], dtype=torch.float32)

    rot = torch.tensor(matrix_of_quat(one("quat_wb").numpy().astype(float)), dtype=torch.float32)
    goal = torch.tensor([log.meta["goal_w"]], dtype=torch.float32)
    points, valid = keypoints(camera, one("pos_w"), rot, goal, one("payload_pos_w"))
    picture = draw_overlay(camera, points[0], valid[0])[:, :, ::-1]
    lens = camera.fisheye
    from matplotlib.patches import Ellipse

    size = (2.0 * lens.params.fx * lens.edge_radius, 2.0 * lens.params.fy * lens.edge_radius)
    circle = Ellipse((lens.params.cx, lens.params.cy), *size, transform=axis.transData)
    axis.imshow(picture, interpolation="antialiased").set_clip_path(circle)
    axis.set_axis_off()
    visible = bool(valid.all())
    if not first:
        return visible
    pixels = lens.denormalize(points[0].double()).numpy()
    for name, part in (("target", slice(0, GOAL_KEYPOINTS)), ("ball", slice(GOAL_KEYPOINTS, None))):
        right = pixels[part, 0].max()
        middle = pixels[part, 1].mean()
        axis.annotate(name, (right, middle), **LOOKS["keypoints_label"])
    quarter = float(lens.radius_from_angle(torch.tensor(np.pi / 2))) * lens.params.fy
    place = (lens.params.cx, lens.params.cy + quarter)
    axis.annotate("90° off the axis", place, **LOOKS["angle_label"])
    return visible

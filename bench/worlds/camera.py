"""The worlds' camera: a Kannala-Brandt fisheye under the vehicle, and a detector that marks goal
square and ball.

The camera looks down, the top of its image is the vehicle's front; pixel (0, 0) is the centre of
the first pixel. The detector marks four corners of a square on the ground and draws a box around
the ball; both are off by the noise of a pixel. Numbers are those of the shipped camera."""

import numpy as np

from bench.worlds.turns import matrix, resample, small_turn

SIZE = 640
FOCAL = 166.6786
CENTRE = np.array([319.5, 319.5])
HALF_VIEW = np.radians(110.0)
LENS = np.array([0.03, 0.0, -0.02])
"""Place of the lens in the body frame [m]."""
LOOKING_DOWN = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Body to camera: x to the image's right, y down, z along the axis."""
SQUARE = 0.125 * np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]])
"""Corners from the goal [m], world frame."""
BALL = 0.033
PIXEL = 1.0
"""Noise of a corner and of a side of a box [px]."""
RATE = 50.0
AROUND = np.linspace(0.0, 2 * np.pi, 360, endpoint=False)


def bend(angle: np.ndarray, k1: float) -> np.ndarray:
    """Distance from the centre over the focal length at an angle off the axis."""
    return angle * (1.0 + k1 * angle**2)


def project(rays: np.ndarray, w) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of rays in the camera's frame, shape (..., 3) to (..., 2), and whether the lens and
    the sensor see them.
    """
    level = np.hypot(rays[..., 0], rays[..., 1])
    angle = np.arctan2(level, rays[..., 2])
    reach = FOCAL * (1.0 + w.camera_focal) * bend(angle, w.camera_k1) / np.maximum(level, 1e-12)
    pixels = reach[..., None] * rays[..., :2] + CENTRE + w.camera_centre
    inside = (angle <= HALF_VIEW) & np.all((pixels > -0.5) & (pixels < SIZE - 0.5), axis=-1)
    return pixels, inside


def outline(ball: np.ndarray, radius: float) -> np.ndarray:
    """Rays that touch a ball, shape (T, 3) to (T, N, 3)."""
    far = np.linalg.norm(ball, axis=-1, keepdims=True)
    ahead = ball / far
    other = np.where(np.abs(ahead[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    side = np.cross(ahead, other)
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    up = np.cross(ahead, side)
    sine = np.minimum(radius / far, 0.99)[:, None]
    ring = np.cos(AROUND)[:, None] * side[:, None] + np.sin(AROUND)[:, None] * up[:, None]
    return np.sqrt(1.0 - sine**2) * ahead[:, None] + sine * ring


def marks(
    flight, lane: int, time: np.ndarray, goal: np.ndarray, w
) -> tuple[np.ndarray, np.ndarray]:
    """Marks of a perfect detector at given times: corners (T, 4, 2) and sides of the box (T, 4, 2)
    [px].

    Each side is given as a point, left, top, right, bottom, of which one coordinate is the box's.

    Returns:
        Points, shape (T, 8, 2), and which of them are visible, shape (T, 8).
    """
    q = resample(flight.time, flight.quat[lane], time)
    body = matrix(q / np.linalg.norm(q, axis=1, keepdims=True))
    pos, ball = (resample(flight.time, series[lane], time) for series in (flight.pos, flight.ball))
    lens = pos + body @ (LENS + w.camera_place)
    turned = LOOKING_DOWN @ small_turn(w.camera_turn).T
    to_camera = np.einsum("ij,tkj->tik", turned, body)
    corners = np.einsum("tij,tkj->tki", to_camera, goal * [1.0, 1.0, 0.0] + SQUARE - lens[:, None])
    points, visible = project(corners, w)
    ring = outline(np.einsum("tij,tj->ti", to_camera, ball - lens), BALL * (1.0 + w.camera_ball))
    around, whole = project(ring, w)
    left, top = around.min(1).T
    right, bottom = around.max(1).T
    u = 0.5 * (left + right)
    v = 0.5 * (top + bottom)
    box = np.stack([left, v, u, top, right, v, u, bottom], -1).reshape(-1, 4, 2)
    return np.concatenate([points, box], 1), np.concatenate(
        [visible, np.tile(whole.all(1)[:, None], 4)], 1
    )


def record_camera(
    flight,
    lane: int,
    goal: np.ndarray,
    landed: float,
    w,
    noise: float,
    dropouts: float,
    rng: np.random.Generator,
) -> dict:
    """Recordings of the camera's detector in a flight; of the ball until it has ``landed`` [s].

    Returns:
        ``look_time`` (N,); ``look``, points in units of the edge of the view of the camera as it is
        believed to be, (N, 8, 2); ``look_seen`` (N, 8); ``look_lost``, frames without a detection,
        (N,); ``goal``.
    """
    stamps = np.arange(0.1, flight.time[-1] - 1e-9, 1.0 / RATE)
    points, visible = marks(flight, lane, stamps - w.camera_late, goal, w)
    # each point's row has its time; the point's motion by about a row meanwhile is negligible
    if w.camera_row:
        for k in range(points.shape[1]):
            then = stamps - w.camera_late + w.camera_row * points[:, k, 1]
            points[:, k], visible[:, k] = (x[:, k] for x in marks(flight, lane, then, goal, w))
    visible[stamps > landed, 4:] = False
    off = noise * PIXEL * rng.normal(size=points.shape)
    left = off[:, 4, 0]
    top = off[:, 5, 1]
    right = off[:, 6, 0]
    bottom = off[:, 7, 1]
    u = 0.5 * (left + right)
    v = 0.5 * (top + bottom)
    off[:, 4:] = np.stack([left, v, u, top, right, v, u, bottom], -1).reshape(-1, 4, 2)
    look = (points + off - CENTRE) / (FOCAL * HALF_VIEW)
    return {
        "look_time": stamps,
        "look": np.where(visible[..., None], look, 0.0),
        "look_seen": visible,
        "look_lost": rng.random(len(stamps)) < dropouts,
        "goal": goal,
    }

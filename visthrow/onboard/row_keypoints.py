"""The keypoints that one vehicle's camera sees, on NumPy arrays: what the runner projects.

On a single row `camera.keypoints.keypoints` takes torch a multiple of the time; this gives the same
to 2e-6. Onboard-safe."""

import math

import numpy as np
from numpy import ndarray

from camera.fisheye import AXIS_EPSILON
from camera.keypoints import (
    DIRECTION_EPSILON,
    GOAL_KEYPOINTS,
    MAX_SINE,
    KeypointCamera,
    box_midpoints,
    by_rule,
)


def row_keypoints(
    camera: KeypointCamera, pos_w: ndarray, rot_wb: ndarray, goal_w: ndarray, payload_w: ndarray
) -> tuple[ndarray, ndarray]:
    """Return keypoints, float32, shape (1, 8, 2), and validity, shape (1, 8).

    Args:
        camera: of `KeypointCamera.on_arrays`. The others: as of `camera.keypoints.keypoints`, with
            a batch of one.
    """
    corners_w = np.append(goal_w[0, :2], 0.0) + camera.square_w
    points_w = np.concatenate([corners_w, payload_w])
    points_b = (points_w - pos_w) @ rot_wb[0] - camera.position_b
    points_c = points_b @ camera.rot_cb.T
    rays_c = _outline(camera, points_c[GOAL_KEYPOINTS])
    marks_c = np.concatenate([points_c[:GOAL_KEYPOINTS], rays_c])[None]
    points, valid = camera.fisheye.project_normalized(marks_c, clip=True)
    points[:, GOAL_KEYPOINTS:] = box_midpoints(points[:, GOAL_KEYPOINTS:])
    return by_rule(camera, points.astype(np.float32), valid)


def _outline(camera: KeypointCamera, ball_c: ndarray) -> ndarray:
    """Return the rays of `camera.keypoints.ball_extremes_c`, shape (4, 3), for a ball's centre."""
    lens = camera.fisheye
    distance = math.hypot(*ball_c.tolist(), math.sqrt(AXIS_EPSILON))
    centre = ball_c / distance
    x, y, z = centre.tolist()
    s = math.sqrt(x * x + y * y + DIRECTION_EPSILON)
    theta = np.float64(math.atan2(s, z))
    sine = min(float(camera.radius) / distance, MAX_SINE)
    g = lens.radius_from_angle(theta) / s
    slope = lens.slope_from_angle(theta)
    q = (slope * z - g) / (s * s)
    gradient = np.array(
        [[q * x * x + g, q * x * y, -slope * x], [q * x * y, q * y * y + g, -slope * y]]
    )
    step = sine * gradient / np.sqrt((gradient * gradient).sum(-1, keepdims=True))
    middle = math.sqrt(1.0 - sine * sine) * centre
    return np.concatenate([middle - step, middle + step])

"""Drawing of keypoints on frames in the colours of the paper's figure: goal green, payload red,
body axes white.
"""

import math

import numpy as np
import torch
from numpy import ndarray

from camera.fisheye import Fisheye
from camera.keypoints import GOAL_KEYPOINTS, KeypointCamera

# BGR, OpenCV's order.
GREEN = (80, 200, 60)
RED = (60, 60, 230)
WHITE = (255, 255, 255)
GREY = (150, 150, 150)
# fractional bits of OpenCV's drawing coordinates, for an accuracy of 1/16 px
SHIFT = 4


def draw_overlay(
    camera: KeypointCamera,
    keypoints: torch.Tensor,
    valid: torch.Tensor,
    image: ndarray | None = None,
) -> ndarray:
    """Draw keypoints, field of view and body axes.

    Goal corners are joined to a green square. The payload's edge midpoints define a red box. If a
    keypoint of a group is invalid, only the group's points are drawn. An invalid keypoint is drawn
    as a grey cross. Raises ValueError: the image's shape or type is not the camera's.

    Args:
        camera: The camera that made the keypoints.
        keypoints: Normalised [-], shape (8, 2).
        valid: Validity, shape (8,).
        image: Frame to draw on, BGR, uint8, shape (H, W, 3) of the camera's size; by default black.

    Returns:
        A new picture, BGR, uint8, shape (H, W, 3).
    """
    lens = camera.fisheye
    shape = (lens.params.height, lens.params.width, 3)
    if image is not None and (image.shape != shape or image.dtype != np.uint8):
        raise ValueError(
            f"image of shape {image.shape} and type {image.dtype} came; expected {shape} and uint8"
        )
    canvas = np.zeros(shape, np.uint8) if image is None else image.copy()
    thick = max(1, round(min(shape[:2]) / 320))
    _draw_field_of_view(canvas, lens, thick)
    _draw_body_axes(canvas, camera, thick)
    pixels = lens.denormalize(keypoints.detach().cpu().double()).numpy()
    visible = valid.detach().cpu().numpy().astype(bool)
    goal = pixels[:GOAL_KEYPOINTS]
    box = pixels[GOAL_KEYPOINTS:]
    _draw_group(canvas, goal, visible[:GOAL_KEYPOINTS], goal, GREEN, thick)
    low = box[0, 0]
    top = box[1, 1]
    right = box[2, 0]
    bottom = box[3, 1]
    rectangle = np.array([[low, top], [right, top], [right, bottom], [low, bottom]])
    _draw_group(canvas, box, visible[GOAL_KEYPOINTS:], rectangle, RED, thick)
    return canvas


def _to_fixed_point(points: ndarray) -> ndarray:
    """Convert pixels to OpenCV's fixed-point integers; values far outside the image are clipped
    before they overflow.
    """
    return np.round(np.clip(points, -1e4, 1e4) * 2**SHIFT).astype(np.int32)


def _draw_group(canvas, points, valid, outline, colour, thick) -> None:
    import cv2

    if valid.all():
        cv2.polylines(
            canvas, [_to_fixed_point(outline)[:, None]], True, colour, 1, cv2.LINE_AA, SHIFT
        )
    for point, ok in zip(points, valid, strict=True):
        if ok:
            centre = tuple(map(int, _to_fixed_point(point)))
            cv2.circle(canvas, centre, (thick + 1) << SHIFT, colour, -1, cv2.LINE_AA, SHIFT)
        else:
            height, width = canvas.shape[:2]
            centre = tuple(map(round, np.clip(point, 0, [width - 1, height - 1])))
            cross = (cv2.MARKER_TILTED_CROSS, 8 * thick)
            cv2.drawMarker(canvas, centre, GREY, *cross, thick, cv2.LINE_AA)
            cv2.circle(canvas, centre, 6 * thick, colour, thick, cv2.LINE_AA)


def _draw_field_of_view(canvas, lens: Fisheye, thick: int) -> None:
    """Draw the circle of the field of view, and a thin one at 90 deg off the axis if inside it."""
    import cv2

    p = lens.params
    quarter = float(lens.radius_from_angle(torch.tensor(math.pi / 2, dtype=torch.float64)))
    for radius, colour in ((quarter, (70, 70, 70)), (lens.edge_radius, GREY)):
        if radius <= lens.edge_radius:
            axes = (round(p.fx * radius * 2**SHIFT), round(p.fy * radius * 2**SHIFT))
            centre = tuple(map(int, _to_fixed_point(np.array([p.cx, p.cy]))))
            width = thick if colour == GREY else 1
            whole = (0, 0, 360)  # rotation, from, to [deg]
            cv2.ellipse(canvas, centre, axes, *whole, colour, width, cv2.LINE_AA, SHIFT)


def _draw_body_axes(canvas, camera: KeypointCamera, thick: int) -> None:
    """Draw the body's x (forward) and y (left) axes as arrows from the principal point."""
    import cv2

    p = camera.fisheye.params
    centre = np.array([p.cx, p.cy])
    length = 0.16 * min(canvas.shape[:2])
    axes_c = camera.rot_cb.detach().cpu().double().numpy().T  # rows: body axes in the camera frame
    for name, axis in zip("xy", axes_c[:2], strict=True):
        tip = centre + length * axis[:2]
        if np.linalg.norm(axis[:2]) < 0.05:
            continue
        start, end = (tuple(round(c) for c in q) for q in (centre, tip))
        cv2.arrowedLine(canvas, start, end, WHITE, thick, cv2.LINE_AA, 0, 0.14)
        corner = tuple(round(c) for c in tip + 0.02 * min(canvas.shape[:2]))
        font = (cv2.FONT_HERSHEY_SIMPLEX, min(canvas.shape[:2]) / 1100)
        cv2.putText(canvas, name, corner, *font, WHITE, thick, cv2.LINE_AA)

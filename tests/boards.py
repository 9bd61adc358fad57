"""Pictures of calibration boards, drawn through a fisheye."""

from functools import lru_cache

import cv2
import numpy as np
import torch

from camera.calibrate.boards import BoardParams
from camera.fisheye import Fisheye
from camera.mount import rotation_from_vector
from camera.params import FisheyeParams

LENS = FisheyeParams(320, 320, 96.0, 97.0, 161.0, 157.0, 0.01, -0.004, fov_deg=190.0)
LARGE = FisheyeParams(640, 640, 192.0, 194.0, 322.5, 314.5, 0.01, -0.004, fov_deg=190.0)
"""The same lens over twice the pixels: a ChArUco marker needs some."""
BOARDS = {
    "chessboard": BoardParams(7, 5, 0.04),
    "circles": BoardParams(7, 5, 0.04, "circles"),
    "charuco": BoardParams(7, 5, 0.04, "charuco", 0.03),
}


def lens_of(name: str) -> FisheyeParams:
    """Return the lens of a board's pictures."""
    return LARGE if name == "charuco" else LENS


def texture(board: BoardParams, scale: int) -> np.ndarray:
    """Print a board, grey, ``scale`` pixels a square; its first point lies one square inwards."""
    size = scale * (board.columns + 1), scale * (board.rows + 1)
    if board.pattern == "charuco":
        return board.charuco().generateImage(size)
    page = np.full(size[::-1], 255, np.uint8)
    for j in range(board.rows + 1):
        for i in range(board.columns + 1):
            if board.pattern == "circles" and i < board.columns and j < board.rows:
                cv2.circle(page, ((i + 1) * scale, (j + 1) * scale), scale // 4, 0, -1, cv2.LINE_AA)
            elif board.pattern == "chessboard" and (i + j) % 2:
                page[j * scale : (j + 1) * scale, i * scale : (i + 1) * scale] = 0
    return page


POSES = (
    (0.1, 0.2, 0.0, 0.0, 0.0),
    (-0.5, 0.3, 0.2, 0.13, 0.1),
    (0.4, -0.5, -0.3, -0.14, 0.1),
    (0.4, 0.3, 0.1, -0.16, -0.1),
    (0.6, 0.1, 0.4, 0.12, -0.13),
    (-0.3, -0.6, 0.5, 0.0, 0.14),
    (0.0, 0.0, 0.7, 0.0, -0.14),
    (0.5, 0.5, 0.2, 0.05, 0.0),
)
"""Rotation vector of a board [rad] and the place of its middle across the axis [m]."""


@lru_cache(maxsize=2)
def pixel_rays(params: FisheyeParams, samples: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Rays through all pixels of a lens, ``samples`` a pixel along each axis.

    Returns unit rays, float64, shape (H s, W s, 3), camera frame, and whether each is inside the
    field of view, shape (H s, W s).
    """
    u = (torch.arange(params.width * samples, dtype=torch.float64) + 0.5) / samples - 0.5
    v = (torch.arange(params.height * samples, dtype=torch.float64) + 0.5) / samples - 0.5
    return Fisheye(params).unproject(torch.stack(torch.meshgrid(u, v, indexing="xy"), -1))


def pictures(name: str) -> list[np.ndarray]:
    """Draw a board in each of the poses, shape (H, W) of its lens."""
    board, lens = BOARDS[name], Fisheye(lens_of(name))
    middle = torch.from_numpy(board.corners_m().mean(0)).float()
    samples, scale = (2 if name == "charuco" else 3), 60
    page = texture(board, scale)
    page = cv2.copyMakeBorder(page, scale, scale, scale, scale, cv2.BORDER_CONSTANT, value=255)
    rays, visible = pixel_rays(lens.params, samples)
    rays = rays.float()
    images = []
    for *tilt, x, y in POSES:
        rot_cm = rotation_from_vector(torch.tensor(tilt))
        origin = torch.tensor([x, y, 0.18]) - rot_cm @ middle
        normal = rot_cm[:, 2]
        depth = (normal @ origin) / (rays @ normal)
        on_board = (rays * depth[..., None] - origin) @ rot_cm / board.square_size
        u, v = ((on_board[..., i] + 2.0) * scale - 0.5 for i in (0, 1))
        inside = (visible & (depth > 0.0)).numpy()
        drawn = cv2.remap(
            page,
            u.numpy(),
            v.numpy(),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=110,
        )
        drawn = np.where(inside, drawn, 0).astype(np.float32)
        mean = drawn.reshape(lens.params.height, samples, lens.params.width, samples).mean((1, 3))
        images.append(np.round(mean).astype(np.uint8))
    return images

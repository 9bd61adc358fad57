"""Rectified (pinhole) views of fisheye frames, by kornia.

Frames are in kornia's format: float in [0, 1], shape (B, C, H, W).
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from camera.fisheye import Fisheye
from camera.mount import rotation_from_vector


@dataclass(frozen=True)
class ViewParams:
    """A pinhole view cut out of a fisheye frame.

    Its axis is the fisheye's, rotated by ``yaw_deg`` about the image's down axis (positive: to the
    right), then by ``pitch_deg`` about the view's right axis (positive: up)."""

    width: int  # [px]
    height: int  # [px]
    fov_deg: float  # full horizontal field of view, below 180 [deg]
    yaw_deg: float = 0.0  # [deg]
    pitch_deg: float = 0.0  # [deg]


def view_rotation(view: ViewParams) -> Tensor:
    """Return the rotation from the view to the fisheye's camera frame, float64, shape (3, 3)."""
    yaw = math.radians(view.yaw_deg)
    pitch = math.radians(view.pitch_deg)
    turns = torch.tensor([[0.0, yaw, 0.0], [pitch, 0.0, 0.0]], dtype=torch.float64)
    about_y, about_x = rotation_from_vector(turns)
    return about_y @ about_x


def view_focal(view: ViewParams) -> float:
    """Return the focal length of a view [px].

    Raises ValueError: a field of view that no pinhole has."""
    if not 0.0 < view.fov_deg < 180.0:
        raise ValueError(
            f"view fov_deg is {view.fov_deg}; expected an angle above 0 and below 180 deg, as a"
            " pinhole has"
        )
    return view.width / 2.0 / math.tan(math.radians(view.fov_deg) / 2.0)


def view_map(lens: Fisheye, view: ViewParams) -> tuple[Tensor, Tensor]:
    """Map each pixel of a view to the fisheye frame.

    Returns pixels of the fisheye frame [px], float64, shape (H, W, 2), and whether they are in the
    field of view and on the sensor, shape (H, W)."""
    focal = view_focal(view)
    u = torch.arange(view.width, dtype=torch.float64) - (view.width - 1) / 2.0
    v = torch.arange(view.height, dtype=torch.float64) - (view.height - 1) / 2.0
    plane = torch.stack(torch.meshgrid(u, v, indexing="xy"), -1) / focal
    depth = torch.ones_like(plane[..., :1])
    rays = torch.cat([plane, depth], -1) @ view_rotation(view).T
    pixels, valid = lens.project(rays)
    return pixels, valid & lens.is_on_sensor(pixels)


def rectify(frames: Tensor, lens: Fisheye, view: ViewParams) -> Tensor:
    """Cut a rectified (pinhole) view out of fisheye frames.

    Raises ValueError: the frames do not have the lens's size, or the view is no pinhole.

    Args:
        frames: Shape (B, C, H, W) of the lens's size.

    Returns:
        Shape (B, C, view.height, view.width), black outside the fisheye's field of view.
    """
    from kornia.geometry.transform import remap

    size = (lens.params.height, lens.params.width)
    if frames.dim() != 4 or tuple(frames.shape[-2:]) != size:
        raise ValueError(
            f"frames of shape {tuple(frames.shape)} came; expected (B, C, {size[0]}, {size[1]})"
        )
    pixels, valid = view_map(lens, view)
    pixels = pixels.to(frames)
    batch = frames.shape[0]
    map_x, map_y = (pixels[..., i].expand(batch, -1, -1) for i in (0, 1))
    return remap(frames, map_x, map_y, mode="bilinear", align_corners=True) * valid.to(frames)

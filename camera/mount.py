"""Extrinsics of the camera on the vehicle, and the transformation from world to camera frame.

Products are written elementwise. A batched matrix product would round differently for each batch
size (and in TF32 if the trainer enables it), but a vehicle's keypoints must be bitwise equal alone
and in a batch."""

import math

import torch
from torch import Tensor

from camera.arrays import Array
from camera.params import MountParams

DOWNWARD_ROT_CB = ((0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0))
"""rot_cb of the downward camera: x_c (image right) = -y_b, y_c (image down) = -x_b, z_c (optical
axis) = -z_b.
"""


def rotation_from_vector(vector: Tensor) -> Tensor:
    """Convert a rotation vector to a matrix (Rodrigues); finite and differentiable at zero.

    Args:
        vector: Axis times angle [rad], shape (..., 3).

    Returns:
        Rotation matrices, shape (..., 3, 3).
    """
    x, y, z = vector.unbind(-1)
    angle = (x * x + y * y + z * z + 1e-20).sqrt()
    a = angle.sin() / angle
    half = (angle * 0.5).sin() / angle
    b = half * half * 2.0
    rows = [
        1.0 - b * (y * y + z * z),
        b * x * y - a * z,
        b * x * z + a * y,
        b * x * y + a * z,
        1.0 - b * (x * x + z * z),
        b * y * z - a * x,
        b * x * z - a * y,
        b * y * z + a * x,
        1.0 - b * (x * x + y * y),
    ]
    rot: Tensor = torch.stack(rows, -1).unflatten(-1, (3, 3))
    return rot


def nominal_rot_cb(mount: MountParams) -> Tensor:
    """Return rot_cb of the mount without error, float64, shape (3, 3)."""
    roll, pitch, yaw = (math.radians(a) for a in mount.rpy_deg)
    axes = torch.diag(torch.tensor([roll, pitch, yaw], dtype=torch.float64))
    about_x, about_y, about_z = rotation_from_vector(axes)
    down = torch.tensor(DOWNWARD_ROT_CB, dtype=torch.float64)
    rot_cb: Tensor = down @ (about_z @ about_y @ about_x).T
    return rot_cb


def rotate(rot: Array, vectors: Array) -> Array:
    """Return ``rot @ v`` for each row v of vectors, as the matrix product ``vectors @ rot^T``.

    Args:
        rot: Rotations, shape (..., 3, 3).
        vectors: Row vectors, shape (..., K, 3).

    Returns:
        Rotated row vectors, shape (..., K, 3).
    """
    rot = rot[..., None, :, :]
    x = vectors[..., 0:1]
    y = vectors[..., 1:2]
    z = vectors[..., 2:3]
    return x * rot[..., 0] + y * rot[..., 1] + z * rot[..., 2]


def points_c_from_w(
    points_w: Array,
    pos_w: Array,
    rot_wb: Array,
    rot_cb: Array,
    position_b: Array,
) -> Array:
    """Transform points from the world to the camera frame.

    Args:
        points_w: Points [m], shape (E, K, 3), world frame.
        pos_w: Centre of mass of the vehicle [m], shape (E, 3), world frame.
        rot_wb: Attitude, body to world, shape (E, 3, 3).
        rot_cb: Extrinsic rotation, body to camera, shape (3, 3) or (E, 3, 3).
        position_b: Lens position [m], shape (3,) or (E, 3), body frame.

    Returns:
        Points [m], shape (E, K, 3), camera frame.
    """
    points_b = rotate(rot_wb.mT, points_w - pos_w[..., None, :])
    return rotate(rot_cb, points_b - position_b[..., None, :])

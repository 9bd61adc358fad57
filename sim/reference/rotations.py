"""Rotations in float64 NumPy: small functions over any leading axes."""

import numpy as np

_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross product over the last axis; ``np.cross`` takes many times as long on a few vectors."""
    return a.take(_NEXT, -1) * b.take(_LAST, -1) - a.take(_LAST, -1) * b.take(_NEXT, -1)


def turned(rotations: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return ``R v`` over the leading axes."""
    return (rotations @ vectors[..., None])[..., 0]


def turned_back(rotations: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return ``R^T v`` over the leading axes."""
    return (np.swapaxes(rotations, -1, -2) @ vectors[..., None])[..., 0]


def rotation_from_quat(quat: np.ndarray) -> np.ndarray:
    """Return rotation matrices of quaternions xyzw of any length, shape (..., 3, 3)."""
    unit = quat / np.sqrt(np.sum(quat * quat, -1, keepdims=True))
    x, y, z, w = unit[..., 0], unit[..., 1], unit[..., 2], unit[..., 3]
    entries = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.stack(entries, -1).reshape(*x.shape, 3, 3)


def quat_dot(quat: np.ndarray, rate_b: np.ndarray) -> np.ndarray:
    """Return the time derivative of quaternions xyzw under a body rate [rad/s], ``1/2 q (rate, 0)``."""
    x, y, z, w = quat[..., 0], quat[..., 1], quat[..., 2], quat[..., 3]
    a, b, c = rate_b[..., 0], rate_b[..., 1], rate_b[..., 2]
    return 0.5 * np.stack((w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a, -x * a - y * b - z * c), -1)


def rotation_from_direction(direction_w: np.ndarray) -> np.ndarray:
    """Return rotations whose -z axis is ``direction_w``, shape (..., 3, 3), turned as little as possible from hanging.

    Args:
        direction_w: unit vectors, shape (..., 3).

    Source: Frisvad, Building an orthonormal basis from a 3D unit vector without normalization, 2012, with the branch of
    Duff et al. 2017 on the sign of z, so that no direction is singular.
    """
    z = -np.asarray(direction_w, dtype=np.float64)
    sign = np.where(z[..., 2] >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + z[..., 2])
    b = z[..., 0] * z[..., 1] * a
    x_axis = np.stack((1.0 + sign * z[..., 0] ** 2 * a, sign * b, -sign * z[..., 0]), -1)
    y_axis = np.stack((b, sign + z[..., 1] ** 2 * a, -z[..., 1]), -1)
    return np.stack((x_axis, y_axis, z), -1)


def quat_wxyz_from_matrix(matrix: np.ndarray) -> np.ndarray:
    """Return unit quaternions wxyz of rotation matrices, shape (..., 4), by the largest of the four squares."""
    m = matrix
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    rows = ((1 + xx + yy + zz, wx, wy, wz), (wx, 1 + xx - yy - zz, xy, xz), (wy, xy, 1 - xx + yy - zz, yz), (wz, xz, yz, 1 - xx - yy + zz))
    products = np.empty((*m.shape[:-2], 4, 4))
    for i, row in enumerate(rows):
        for j, product in enumerate(row):
            products[..., i, j] = product
    largest = np.argmax(np.diagonal(products, axis1=-2, axis2=-1), -1)
    quat = np.take_along_axis(products, largest[..., None, None], -2)[..., 0, :]
    return quat / np.linalg.norm(quat, axis=-1, keepdims=True)

"""Rotations and series of the worlds: quaternions wxyz."""

import numpy as np


def small_turn(v: np.ndarray) -> np.ndarray:
    """Rotation matrices of rotation vectors, shape (..., 3) to (..., 3, 3)."""
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    k = np.zeros((*v.shape[:-1], 3, 3))
    k[..., 0, 1] = -v[..., 2]
    k[..., 0, 2] = v[..., 1]
    k[..., 1, 2] = -v[..., 0]
    k -= np.swapaxes(k, -1, -2)
    safe = np.where(angle > 1e-12, angle, 1.0)
    return np.eye(3) + np.sin(angle) / safe * k + (1 - np.cos(angle)) / safe**2 * (k @ k)


def matrix(q: np.ndarray) -> np.ndarray:
    """Rotation matrices of quaternions wxyz, shape (T, 4) to (T, 3, 3)."""
    w = q[..., :1, None]
    v = q[..., 1:]
    k = np.zeros((*v.shape[:-1], 3, 3))
    k[..., 0, 1] = -v[..., 2]
    k[..., 0, 2] = v[..., 1]
    k[..., 1, 2] = -v[..., 0]
    k -= np.swapaxes(k, -1, -2)
    return np.eye(3) + 2 * w * k + 2 * (k @ k)


def quaternion(r: np.ndarray) -> np.ndarray:
    """Quaternions wxyz of rotation matrices far from half turns about x or y, shape (T, 3, 3) to
    (T, 4).
    """
    w = 0.5 * np.sqrt(np.maximum(1 + r[:, 0, 0] + r[:, 1, 1] + r[:, 2, 2], 1e-12))
    return np.stack(
        [
            w,
            (r[:, 2, 1] - r[:, 1, 2]) / (4 * w),
            (r[:, 0, 2] - r[:, 2, 0]) / (4 * w),
            (r[:, 1, 0] - r[:, 0, 1]) / (4 * w),
        ],
        -1,
    )


def resample(time: np.ndarray, series: np.ndarray, at: np.ndarray) -> np.ndarray:
    """A series of shape (T, n) at other times, linear between milliseconds."""
    return np.stack([np.interp(at, time, column) for column in series.T], -1)

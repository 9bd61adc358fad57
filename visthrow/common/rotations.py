"""Rotations on the host: quaternions are xyzw, from body to world unless stated otherwise.

Onboard-safe.

The first functions work on arrays with any leading axes. The last ones work on single quaternions
and vectors of floats, ten times faster than NumPy, with reproducible bits."""

import math

import numpy as np
from numpy import ndarray

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

_SUCCESSOR = np.array([1, 2, 0])
_LAST = np.array([2, 0, 1])


def cross(a: ndarray, b: ndarray) -> ndarray:
    """Return the cross product over the last axis, many times faster than ``np.cross`` for a few
    vectors.
    """
    return a.take(_SUCCESSOR, -1) * b.take(_LAST, -1) - a.take(_LAST, -1) * b.take(_SUCCESSOR, -1)


def normal_part(vector: ndarray, axis: ndarray) -> ndarray:
    """Return the components of vectors normal to unit axes, both of shape (..., 3)."""
    parallel = np.einsum("...i,...i->...", vector, axis)
    return vector - parallel[..., None] * axis


def matrix_of_quat(quat: ndarray) -> ndarray:
    """Return rotation matrices ``rot_wb``, shape (..., 3, 3), of quaternions of any norm, shape
    (..., 4).
    """
    unit = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
    x, y, z, w = (unit[..., i] for i in range(4))
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    # np.stack takes twice as long on a single quaternion
    out = np.empty((*unit.shape[:-1], 3, 3), unit.dtype)
    for i, row in enumerate(rows):
        for j, entry in enumerate(row):
            out[..., i, j] = entry
    return out


def quat_of_matrix(rot: ndarray) -> ndarray:
    """Return unit quaternions, shape (..., 4), w not negative, of rotation matrices, shape
    (..., 3, 3): the eigenvectors of the largest eigenvalues of symmetric matrices.

    Source: Bar-Itzhack, "New method for extracting the quaternion from a rotation matrix",
    J. Guid. Control Dyn. 23(6), 2000."""
    trace = np.trace(rot, axis1=-2, axis2=-1)[..., None, None]
    skew = rot - rot.mT
    form = np.empty((*rot.shape[:-2], 4, 4))
    form[..., :3, :3] = rot + rot.mT - trace * np.eye(3)
    form[..., 3, :3] = np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1)
    form[..., 3, 3:] = trace[..., 0]
    quat = np.linalg.eigh(form).eigenvectors[..., -1]  # of the lower triangle
    return np.where(quat[..., 3:] < 0.0, -quat, quat)


def quat_of_vector(vector: ndarray) -> ndarray:
    """Return the unit quaternions, shape (..., 4), of rotation vectors [rad], shape (..., 3)."""
    half = 0.5 * np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.concatenate([0.5 * vector * np.sinc(half / np.pi), np.cos(half)], axis=-1)


def vectors_between(first: ndarray, last: ndarray) -> ndarray:
    """Return the rotation vectors, with angles below pi [rad], shape (T, 3), from first to last
    attitudes, quaternions of any norm, shape (T, 4).
    """
    turn = np.stack(multiply(conjugate(first.T), last.T), -1)
    turn *= np.where(turn[:, 3:] < 0.0, -1.0, 1.0)
    sine = np.linalg.norm(turn[:, :3], axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, turn[:, 3:])
    return turn[:, :3] * angle / np.maximum(sine, 1e-300)


def tilt_deg(vector: ndarray) -> ndarray:
    """Return the angles between vectors, shape (..., 3), and the upward vertical [deg], shape
    (...).
    """
    level = np.linalg.norm(vector[..., :2], axis=-1)
    return np.degrees(np.arctan2(level, vector[..., 2]))


def rotate(quat: ndarray, vector: ndarray) -> ndarray:
    """Rotate vectors, shape (..., 3), by unit quaternions, shape (..., 4):
    ``v + 2 w q x v + q x (2 q x v)``.
    """
    axis = quat[..., :3]
    w = quat[..., 3:]
    twice = 2.0 * cross(axis, vector)
    return vector + w * twice + cross(axis, twice)


def rotate_back(quat: ndarray, vector: ndarray) -> ndarray:
    """Rotate vectors, shape (..., 3), by the inverses of unit quaternions, shape (..., 4)."""
    return rotate(quat * [-1.0, -1.0, -1.0, 1.0], vector)


def continuous(quat: ndarray) -> ndarray:
    """Return a series of quaternions, shape (T, 4), with signs for which neighbours differ
    least.
    """
    signs = np.where(np.sum(quat[1:] * quat[:-1], axis=1) < 0.0, -1.0, 1.0)
    return quat * np.cumprod(np.append(1.0, signs))[:, None]


def rotate_by_small_angles(quat: ndarray, angle: ndarray) -> ndarray:
    """Return unit quaternions, shape (N, 4), rotated about body axes by small angles [rad], shape
    (N, 3).
    """
    x = quat[:, :3]
    w = quat[:, 3:]
    half = 0.5 * angle
    product = np.hstack(
        (x + w * half + np.cross(x, half), w - np.sum(x * half, axis=1, keepdims=True))
    )
    return product / np.linalg.norm(product, axis=1, keepdims=True)


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the Hamilton product of two quaternions, the rotation by b and then by a."""
    ax, ay, az, aw = a
    bx, b_y, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * b_y,
        aw * b_y - ax * bz + ay * bw + az * bx,
        aw * bz + ax * b_y - ay * bx + az * bw,
        aw * bw - ax * bx - ay * b_y - az * bz,
    )


def turn_one(quat: Quaternion, rate_b: Vector, time: float) -> Quaternion:
    """Return an attitude after a short time [s] at body rates [rad/s]."""
    half = 0.5 * time
    turn = multiply(quat, (*(half * r for r in rate_b), 1.0))
    norm = sum(x * x for x in turn) ** 0.5
    return tuple(x / norm for x in turn)


def conjugate(quat: Quaternion) -> Quaternion:
    """Return the inverse of a unit quaternion."""
    x, y, z, w = quat
    return (-x, -y, -z, w)


def plus(a: Vector, b: Vector, factor: float = 1.0) -> Vector:
    """Return ``a + factor b`` for two vectors."""
    return (a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2])


def rotate_one(quat: Quaternion, vector: Vector) -> Vector:
    """Rotate a vector by a unit quaternion: ``v + 2 q x (q x v + w v)``."""
    x, y, z, w = quat
    vx, vy, vz = vector
    tx = y * vz - z * vy + w * vx
    ty = z * vx - x * vz + w * vy
    tz = x * vy - y * vx + w * vz
    return (
        vx + 2.0 * (y * tz - z * ty),
        vy + 2.0 * (z * tx - x * tz),
        vz + 2.0 * (x * ty - y * tx),
    )


def cross_one(a: Vector, b: Vector) -> Vector:
    """Return the cross product of two vectors."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def rotation_vector(quat: Quaternion) -> Vector:
    """Return the rotation vector of a unit quaternion, with an angle below pi [rad]."""
    x, y, z, w = quat
    if w < 0.0:
        x = -x
        y = -y
        z = -z
        w = -w
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 * math.atan2(sine, w) / sine if sine > 1e-12 else 2.0
    return (scale * x, scale * y, scale * z)


def tilt_and_heading(quat: Quaternion) -> tuple[float, float]:
    """Return the angle of body z from the vertical, and that of body x's heading from world x
    [rad]; NaN for NaN.
    """
    x, y, z, w = quat
    # in this order min and max propagate a NaN
    tilt = math.acos(max(min(1.0 - 2.0 * (x * x + y * y), 1.0), -1.0))
    return tilt, math.atan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))


def quat_of_euler(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the quaternion of Euler angles [rad]: yaw first, then pitch, then roll."""
    cr = math.cos(roll / 2)
    sr = math.sin(roll / 2)
    cp = math.cos(pitch / 2)
    sp = math.sin(pitch / 2)
    cy = math.cos(yaw / 2)
    sy = math.sin(yaw / 2)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )

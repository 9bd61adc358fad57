"""What motion capture adds to the truth: noise of positions and attitudes."""

from collections.abc import Mapping

import numpy as np


def measured(truth: Mapping[str, np.ndarray], noise: Mapping[str, float], rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Add noise to poses.

    Args:
        truth: ``pos_w`` and ``payload_pos_w`` [m], shape (N, 3), then ``quat_wb``, xyzw, shape (N, 4); each may have an N of
            its own.
        noise: standard deviation of each, [m], and [rad] about each axis of the body.
        rng: drawn from for one after the other.
    """
    found = {}
    for name, values in truth.items():
        error = noise[name] * rng.standard_normal((len(values), 3))
        found[name] = turned(values, error) if name == "quat_wb" else values + error
    return found


def turned(quat: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Quaternions xyzw, shape (N, 4), turned about body axes by small angles [rad], shape (N, 3)."""
    x, w, half = quat[:, :3], quat[:, 3:], 0.5 * angle
    found = np.hstack((x + w * half + np.cross(x, half), w - np.sum(x * half, axis=1, keepdims=True)))
    return found / np.linalg.norm(found, axis=1, keepdims=True)

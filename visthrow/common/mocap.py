"""What motion capture adds to the truth: noise of positions and attitudes."""

from collections.abc import Mapping

import numpy as np

from visthrow.common.rotations import rotate_by_small_angles


def add_mocap_noise(
    truth: Mapping[str, np.ndarray], noise: Mapping[str, float], rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Add noise to poses, ``pos_w`` and ``payload_pos_w`` [m], shape (N, 3), then ``quat_wb``,
    xyzw, shape (N, 4), an N each.

    The noise is the standard deviation of each, [m], and [rad] about each axis of the body; it is
    drawn for one after the other."""
    samples = {}
    for name, values in truth.items():
        error = noise[name] * rng.standard_normal((len(values), 3))
        samples[name] = (
            rotate_by_small_angles(values, error) if name == "quat_wb" else values + error
        )
    return samples

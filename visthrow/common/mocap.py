"""Noise of motion capture on positions and attitudes."""

from collections.abc import Mapping

import numpy as np

from visthrow.common.rotations import rotate_by_small_angles


def add_mocap_noise(
    truth: Mapping[str, np.ndarray], noise: Mapping[str, float], rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Return poses with noise: ``pos_w`` and ``payload_pos_w`` [m], shape (N, 3), and ``quat_wb``,
    xyzw, shape (N, 4); N may differ between these.

    ``noise``: standard deviation of each [m], and about each body axis [rad]. The draws follow the
    order of ``truth``."""
    samples = {}
    for name, values in truth.items():
        error = noise[name] * rng.standard_normal((len(values), 3))
        samples[name] = (
            rotate_by_small_angles(values, error) if name == "quat_wb" else values + error
        )
    return samples

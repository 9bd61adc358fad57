"""Conversions of single rotations against scipy."""

import numpy as np
from pytest import approx
from scipy.spatial.transform import Rotation

from visthrow.common.rotations import quat_of_euler, rotation_vector, tilt_and_heading


def test_vectors_angles_and_headings_are_scipys():
    for angles in np.random.default_rng(0).uniform(-1.4, 1.4, (20, 3)):
        turn = Rotation.from_euler("ZYX", angles)
        quat = turn.as_quat()
        assert abs(quat @ quat_of_euler(*angles[::-1])) == approx(1.0)
        assert rotation_vector(tuple(quat)) == approx(turn.as_rotvec())
        ahead, up = turn.apply([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        expected = np.arccos(up[2]), np.arctan2(ahead[1], ahead[0])
        assert tilt_and_heading(tuple(quat)) == approx(expected)

"""Conversions of rotations against scipy."""

import numpy as np
from pytest import approx
from scipy.spatial.transform import Rotation

from visthrow.common.rotations import (
    quat_of_euler,
    quat_of_matrix,
    quat_of_vector,
    rotation_vector,
    tilt_and_heading,
    vectors_between,
)

ROUNDING = 1e-12  # of conversions in double precision, relative to 1


def test_vectors_angles_and_headings_are_scipys():
    for angles in np.random.default_rng(0).uniform(-1.4, 1.4, (20, 3)):
        turn = Rotation.from_euler("ZYX", angles)
        quat = turn.as_quat()
        assert abs(quat @ quat_of_euler(*angles[::-1])) == approx(1.0)
        assert rotation_vector(tuple(quat)) == approx(turn.as_rotvec())
        ahead, up = turn.apply([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        expected = np.arccos(up[2]), np.arctan2(ahead[1], ahead[0])
        assert tilt_and_heading(tuple(quat)) == approx(expected)


def test_conversions_agree_with_scipy():
    theirs = Rotation.random(200, rng=np.random.default_rng(1))
    quat = theirs.as_quat(canonical=True)
    assert np.allclose(quat_of_matrix(theirs.as_matrix()), quat, rtol=0, atol=ROUNDING)
    vector = theirs.as_rotvec()
    assert np.allclose(quat_of_vector(vector), quat, rtol=0, atol=ROUNDING)
    assert np.array_equal(quat_of_vector(np.zeros(3)), [0.0, 0.0, 0.0, 1.0])
    between = (theirs[:-1].inv() * theirs[1:]).as_rotvec()
    got = vectors_between(3.0 * quat[:-1], -quat[1:])
    assert np.allclose(got, between, rtol=0, atol=ROUNDING)
    assert np.array_equal(vectors_between(quat[:1], quat[:1]).round(12), np.zeros((1, 3)))

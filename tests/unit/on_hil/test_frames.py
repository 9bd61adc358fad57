"""Frames of pose sources: all 24 axis cases both ways, against SciPy's rotations."""

from itertools import permutations, product

import numpy as np
from numpy.random import default_rng
from numpy.testing import assert_allclose
from pytest import mark, raises
from scipy.spatial.transform import Rotation

from hil.errors import FrameError
from hil.poses.frames import FrameParams, Frames
from hil.poses.pose import Pose
from visthrow.logs.axes import TURNS, turn_of

AXES = TURNS
EXACT = 1e-14
"""Rounding of a few float64 products of numbers near 1."""


def frames(
    axes="x,y,z", body_axes="x,y,z", quaternion="xyzw", yaw=0.0, offset=(0.0, 0.0, 0.0)
) -> Frames:
    return Frames(FrameParams(axes, body_axes, quaternion, yaw, offset))


def random_pose(rng) -> Pose:
    quat = rng.normal(size=4)
    vectors = (tuple(map(float, rng.normal(size=3))) for _ in range(3))
    pos, vel, rate = vectors
    return Pose(0.0, 0.0, "vehicle", pos, tuple(map(float, quat / np.linalg.norm(quat))), vel, rate)


def same_turn(a, b) -> bool:
    return min(np.abs(np.subtract(a, b)).max(), np.abs(np.add(a, b)).max()) < EXACT


def test_24_turns_exist_and_24_mirrors_are_refused():
    assert len(set(AXES)) == 24
    every = {
        ",".join(s + a for s, a in zip(signs, order))
        for order in permutations("xyz")
        for signs in product(("", "-"), repeat=3)
    }
    for axes in every - set(AXES):
        with raises(FrameError, match="mirror the world") as caught:
            frames(axes)
        assert set(str(caught.value).split(": ")[-1].split()) < set(AXES), (
            "what it proposes are turns"
        )


@mark.parametrize("axes", ["x,y", "x,x,z", "a,b,c", "", "x,y,z,x", "xy,z,x", "--x,y,z", "x,,z"])
def test_what_is_no_set_of_axes_is_refused(axes):
    with raises(FrameError, match="expected x, y and z once each"):
        frames(axes)


@mark.parametrize("axes", AXES)
@mark.parametrize("order", ["xyzw", "wxyz"])
def test_every_case_both_ways_against_matrices(axes, order):
    """``R_ours = Yaw A R_source B^T`` and the like, in SciPy."""
    rng = default_rng(AXES.index(axes))
    body_axes, yaw = AXES[(7 * AXES.index(axes) + 3) % 24], float(rng.uniform(-180, 180))
    convert = frames(axes, body_axes, order, yaw)
    world = Rotation.from_euler("z", yaw, degrees=True).as_matrix() @ turn_of(axes)
    body = turn_of(body_axes)
    for _ in range(10):
        pose = random_pose(rng)
        quat = pose.quat if order == "xyzw" else (*pose.quat[1:], pose.quat[0])
        rot = Rotation.from_quat(quat).as_matrix()
        ours = convert.pose_from_source(pose)
        assert_allclose(
            Rotation.from_quat(ours.quat).as_matrix(), world @ rot @ body.T, atol=10 * EXACT
        )
        assert_allclose(ours.pos, world @ pose.pos, atol=10 * EXACT)
        assert_allclose(ours.vel, world @ pose.vel, atol=10 * EXACT)
        assert_allclose(ours.rate, body @ pose.rate, atol=10 * EXACT)
        back = convert.source_from_pose(ours)
        for name in ("pos", "vel", "rate"):
            assert_allclose(getattr(back, name), getattr(pose, name), atol=20 * EXACT)
        assert same_turn(back.quat, pose.quat)


def test_our_frame_changes_no_bit():
    rng = default_rng(2)
    for _ in range(50):
        pose = random_pose(rng)
        assert frames().pose_from_source(pose) == pose


def test_marker_offset_follows_the_attitude():
    """Marker 0.1 m above the centre of mass; rolled by 90 deg to the right it lies 0.1 m to the
    right of it.
    """
    right = tuple(map(float, Rotation.from_euler("x", 90, degrees=True).as_quat()))
    convert = frames(offset=(0.0, 0.0, 0.1))
    pose = convert.pose_from_source(
        Pose(0.0, 0.0, "vehicle", (0.0, -0.1, 1.0), right, (0.0, 0.0, 0.2), (2.0, 0.0, 0.0))
    )
    assert_allclose(pose.pos, (0.0, 0.0, 1.0), atol=EXACT)
    # Turning with 2 rad/s on an arm of 0.1 m to the right the marker sinks at 0.2 m/s against the
    # centre of mass.
    assert_allclose(pose.vel, (0.0, 0.0, 0.4), atol=EXACT)
    marker = convert.source_from_pose(pose)
    assert_allclose((marker.pos, marker.vel), ((0.0, -0.1, 1.0), (0.0, 0.0, 0.2)), atol=EXACT)

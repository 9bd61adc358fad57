"""Conversion between a pose source's frames and ours; axes are exchanged only here.

Ours: world z up, body x forward, y left, z up, quaternions xyzw. A source's axes are described by
three signed letters: ``axes = "y,x,-z"`` says that our world x is the source's y, our y its x, our
z its -z. Of the 48 such sets 24 are rotations; the others are reflections and are refused. Common
sets:

- ``"x,y,z"``: z up already (Vicon, Qualisys, ROS).
- ``"y,x,-z"``: north, east, down to east, north, up; ``"x,-y,-z"``: forward, right, down to
  forward, left, up. The two differ by a yaw of 90 deg.
- ``"z,x,y"``: y up (OptiTrack), its z forward; ``"x,-z,y"``: y up, its x forward.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hil.errors import FrameError
from hil.poses.pose import Pose, Quaternion, Vector
from visthrow.common.rotations import (
    conjugate,
    cross_one,
    multiply,
    plus,
    quat_of_matrix,
    rotate_one,
)
from visthrow.config.bounds import Bounded
from visthrow.logs.axes import turn_of


@dataclass(frozen=True)
class FrameParams(Bounded):
    """The conventions of a source's poses.

    No entry has a default. Raises `FrameError`: the axes are not a rotation.
    """

    axes: str  # our world axes in the source's, for instance "y,x,-z"
    # our body axes in those of the source's body, for instance "x,-y,-z" for forward, right, down
    body_axes: str
    quaternion: Literal["xyzw", "wxyz"]  # order of the source's quaternions
    yaw_offset_deg: float  # rotation about our world z after the exchange of axes
    # of the tracked point from the centre of mass [m], our body frame
    marker_offset_b: Vector

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            turn_of(self.axes), turn_of(self.body_axes)
        except ValueError as error:
            raise FrameError(str(error)) from error


class Frames:
    """Converts poses, vectors and rates of one body between a source's frames and ours, both ways.

    It uses plain floats: NumPy is ten times slower for a single pose, and equal inputs give equal
    bits."""

    def __init__(self, params: FrameParams):
        """Compute the rotations; see `FrameParams` for the errors."""
        self.params = params
        half = math.radians(params.yaw_offset_deg) / 2.0
        yaw = (0.0, 0.0, math.sin(half), math.cos(half))
        # from the source's world to ours
        self._world = multiply(yaw, _quaternion(turn_of(params.axes)))
        self._body = _quaternion(turn_of(params.body_axes))  # from the source's body to ours
        self._offset = tuple(float(x) for x in params.marker_offset_b)

    def world_from_source(self, vector: Vector) -> Vector:
        """Return a vector of the source's world in our world."""
        return rotate_one(self._world, vector)

    def source_from_world(self, vector: Vector) -> Vector:
        """Return a vector of our world in the source's."""
        return rotate_one(conjugate(self._world), vector)

    def quat_from_source(self, quat: Quaternion) -> Quaternion:
        """Return a source's attitude in our convention (xyzw, body to world)."""
        if self.params.quaternion == "wxyz":
            quat = (*quat[1:], quat[0])
        return multiply(multiply(self._world, quat), conjugate(self._body))

    def pose_from_source(self, pose: Pose) -> Pose:
        """Return a source's pose in our frames, moved from the tracked point to the
        centre of mass.
        """
        pos = self.world_from_source(pose.pos)
        quat = None if pose.quat is None else self.quat_from_source(pose.quat)
        vel = None if pose.vel is None else self.world_from_source(pose.vel)
        rate = None if pose.rate is None else rotate_one(self._body, pose.rate)
        if quat is not None and any(self._offset):
            pos = plus(pos, rotate_one(quat, self._offset), -1.0)
            if vel is not None and rate is not None:
                vel = plus(vel, rotate_one(quat, cross_one(rate, self._offset)), -1.0)
        return replace(pose, pos=pos, quat=quat, vel=vel, rate=rate)

    def source_from_pose(self, pose: Pose) -> Pose:
        """Return the source's pose for a pose in our frames; the inverse of
        :meth:`pose_from_source`.
        """
        pos = pose.pos
        vel = pose.vel
        if pose.quat is not None and any(self._offset):
            pos = plus(pos, rotate_one(pose.quat, self._offset))
            if vel is not None and pose.rate is not None:
                vel = plus(vel, rotate_one(pose.quat, cross_one(pose.rate, self._offset)))
        quat = (
            None
            if pose.quat is None
            else multiply(multiply(conjugate(self._world), pose.quat), self._body)
        )
        if quat is not None and self.params.quaternion == "wxyz":
            quat = (quat[3], *quat[:3])
        rate = None if pose.rate is None else rotate_one(conjugate(self._body), pose.rate)
        vel = None if vel is None else self.source_from_world(vel)
        return replace(pose, pos=self.source_from_world(pos), quat=quat, vel=vel, rate=rate)


def _quaternion(matrix: np.ndarray) -> Quaternion:
    """Return the quaternion xyzw of one of the 24 rotations. Its magnitudes are exactly 0, 1/2,
    sqrt(1/2) or 1, so that "x,y,z" changes no bit.
    """
    exact = np.array([0.0, 0.5, math.sqrt(0.5), 1.0])
    exact = np.concatenate([-exact, exact])
    x, y, z, w = (
        float(exact[np.argmin(np.abs(exact - v))]) for v in quat_of_matrix(matrix).tolist()
    )
    sign = math.copysign(1.0, next(v for v in (w, x, y, z) if v))
    return (sign * x + 0.0, sign * y + 0.0, sign * z + 0.0, sign * w + 0.0)

"""Conversion between a pose source's frames and ours: the only place where axes are exchanged.

Ours: world z up, body x forward, y left, z up, quaternions xyzw. A source's axes are described by three signed letters:
``axes = "y,x,-z"`` says that our world x is the source's y, our y its x, our z its -z. Of the 48 such sets 24 are turns;
the others mirror the world and are refused. Common sets:

- ``"x,y,z"``: z up already (Vicon, Qualisys, ROS).
- ``"y,x,-z"``: north, east, down to east, north, up; ``"x,-y,-z"``: forward, right, down to forward, left, up. The two
  differ by a yaw of 90 deg.
- ``"z,x,y"``: y up (OptiTrack), its z forward; ``"x,-z,y"``: y up, its x forward.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hil.errors import FrameError
from hil.poses.pose import Pose, Quaternion, Vector
from visthrow.common.rotations import conjugate, cross_one, multiply, rotate_one
from visthrow.logs.axes import turn_of


@dataclass(frozen=True)
class FrameParams:
    """How a source describes poses. Every entry is stated; none has a default.

    Raises:
        FrameError: axes that are no turn, or an unknown quaternion order.
    """

    axes: str  # our world axes in the source's, for instance "y,x,-z"
    body_axes: str  # our body axes in those of the source's body, for instance "x,-y,-z" for forward, right, down
    quaternion: Literal["xyzw", "wxyz"]  # order of the source's quaternions
    yaw_offset_deg: float  # turn about our world z after the exchange of axes
    marker_offset_b: tuple[float, float, float]  # of the tracked point from the centre of mass [m], our body frame

    def __post_init__(self) -> None:
        rotation_of(self.axes)
        rotation_of(self.body_axes)
        if self.quaternion not in ("xyzw", "wxyz"):
            raise FrameError(f"quaternion order '{self.quaternion}'; expected 'xyzw' or 'wxyz'")
        if not np.all(np.isfinite([self.yaw_offset_deg, *self.marker_offset_b])):
            raise FrameError(
                f"yaw offset {self.yaw_offset_deg}, marker offset {self.marker_offset_b}: expected finite numbers"
            )


def rotation_of(axes: str) -> np.ndarray:
    """Return the matrix of a set of axes: ``v_ours = matrix @ v_source``, shape (3, 3).

    Raises:
        FrameError: not three signed letters, one of them twice, or a mirrored set.
    """
    try:
        return turn_of(axes)
    except ValueError as error:
        raise FrameError(str(error)) from error


class Frames:
    """Converts poses, vectors and rates of one body between a source's frames and ours, both ways.

    Plain floats all along: a batch of one in NumPy costs ten times as much, and the same input gives the same bits.
    """

    def __init__(self, params: FrameParams) -> None:
        """Work out the turns; see `FrameParams` for what is refused."""
        self.params = params
        half = math.radians(params.yaw_offset_deg) / 2.0
        yaw = (0.0, 0.0, math.sin(half), math.cos(half))
        self._world = multiply(yaw, _quaternion(rotation_of(params.axes)))  # from the source's world to ours
        self._body = _quaternion(rotation_of(params.body_axes))  # from the source's body to ours
        self._offset = tuple(float(x) for x in params.marker_offset_b)

    def world_from_source(self, vector: Vector) -> Vector:
        """A vector of the source's world in ours."""
        return rotate_one(self._world, vector)

    def source_from_world(self, vector: Vector) -> Vector:
        """A vector of our world in the source's."""
        return rotate_one(conjugate(self._world), vector)

    def body_from_source(self, vector: Vector) -> Vector:
        """A vector or rate of the source's body frame in ours."""
        return rotate_one(self._body, vector)

    def source_from_body(self, vector: Vector) -> Vector:
        """A vector or rate of our body frame in the source's."""
        return rotate_one(conjugate(self._body), vector)

    def quat_from_source(self, quat: Quaternion) -> Quaternion:
        """An attitude as the source writes it, as ours (xyzw, body to world)."""
        if self.params.quaternion == "wxyz":
            quat = (*quat[1:], quat[0])
        return multiply(multiply(self._world, quat), conjugate(self._body))

    def source_from_quat(self, quat: Quaternion) -> Quaternion:
        """Our attitude as the source would write it."""
        x, y, z, w = multiply(multiply(conjugate(self._world), quat), self._body)
        return (w, x, y, z) if self.params.quaternion == "wxyz" else (x, y, z, w)

    def pose_from_source(self, pose: Pose) -> Pose:
        """A source's pose in our frames, moved from the tracked point to the centre of mass."""
        pos = self.world_from_source(pose.pos)
        quat = None if pose.quat is None else self.quat_from_source(pose.quat)
        vel = None if pose.vel is None else self.world_from_source(pose.vel)
        rate = None if pose.rate is None else self.body_from_source(pose.rate)
        if quat is not None and any(self._offset):
            pos = _minus(pos, rotate_one(quat, self._offset))
            if vel is not None and rate is not None:
                vel = _minus(vel, rotate_one(quat, cross_one(rate, self._offset)))
        return replace(pose, pos=pos, quat=quat, vel=vel, rate=rate)

    def source_from_pose(self, pose: Pose) -> Pose:
        """The inverse of :meth:`pose_from_source`: what the source would have said."""
        pos, vel = pose.pos, pose.vel
        if pose.quat is not None and any(self._offset):
            pos = _plus(pos, rotate_one(pose.quat, self._offset))
            if vel is not None and pose.rate is not None:
                vel = _plus(vel, rotate_one(pose.quat, cross_one(pose.rate, self._offset)))
        quat = None if pose.quat is None else self.source_from_quat(pose.quat)
        rate = None if pose.rate is None else self.source_from_body(pose.rate)
        vel = None if vel is None else self.source_from_world(vel)
        return replace(pose, pos=self.source_from_world(pos), quat=quat, vel=vel, rate=rate)


def _quaternion(matrix: np.ndarray) -> Quaternion:
    """Quaternion xyzw of one of the 24 turns: the eigenvector of largest eigenvalue of Bar-Itzhack's matrix."""
    m = matrix
    k = np.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[2, 0] + m[0, 2], m[2, 1] - m[1, 2]],
            [m[1, 0] + m[0, 1], m[1, 1] - m[0, 0] - m[2, 2], m[2, 1] + m[1, 2], m[0, 2] - m[2, 0]],
            [m[2, 0] + m[0, 2], m[2, 1] + m[1, 2], m[2, 2] - m[0, 0] - m[1, 1], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m[0, 0] + m[1, 1] + m[2, 2]],
        ]
    )
    vector = np.linalg.eigh(k)[1][:, -1]
    # The entries of these turns are 0, 1/2, 1/sqrt(2) or 1; written exactly, so that "x,y,z" changes no bit.
    exact = np.array([0.0, 0.5, math.sqrt(0.5), 1.0])
    rounded = [math.copysign(float(exact[np.argmin(np.abs(exact - abs(v)))]), v) for v in vector]
    lead = rounded[3] if rounded[3] else next(v for v in rounded if v)
    return tuple((v + 0.0 if lead > 0 else -v + 0.0) for v in rounded)


def _plus(a: Vector, b: Vector) -> Vector:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def _minus(a: Vector, b: Vector) -> Vector:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])

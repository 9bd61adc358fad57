"""What a camera saw, as the policy is to be shown it: rays of one frame, and what they read while nothing is seen.

What is not seen reads where it was for a while, then as dropped out. To a policy that was trained with the exact direction at the edge
in place of what is out of view, what was last seen near the edge reads as its direction there.
"""

from dataclasses import dataclass

import numpy as np
import torch

from camera.detectors.contours import BallSeen, GoalSeen, Seen, detected_keypoints
from camera.keypoints import GOAL_KEYPOINTS, KEYPOINTS, KeypointCamera
from hil.poses.pose import Quaternion
from visthrow.onboard.observations import rotation_from_quat

NEAR_EDGE = 0.85
"""Radius in the image beyond which what is not seen any more has left the field of view, of 1."""

Corners = tuple[tuple[float, float, float], ...]


@dataclass(frozen=True)
class Sight:
    """One frame, plain floats as they are recorded; rays in the camera frame of training."""

    stamp: float  # of the exposure, on the runner's clock [s]
    corners: Corners | None  # unit rays to the corners of the goal square, in turn
    ball: tuple[float, float, float, float] | None  # unit ray to the ball's centre, and half-angle [rad]

    def values(self) -> list:
        """As JSON has it."""
        return [self.stamp, self.corners, self.ball]

    @classmethod
    def of(cls, values: list) -> "Sight":
        """The inverse of :meth:`values`."""
        stamp, corners, ball = values
        return cls(stamp, None if corners is None else tuple(map(tuple, corners)), None if ball is None else tuple(ball))

    def seen(self) -> Seen:
        """As `camera.detectors.contours` has it."""
        goal = None if self.corners is None else GoalSeen(np.array(self.corners), 1.0)
        ball = None if self.ball is None else BallSeen(np.array(self.ball[:3]), self.ball[3], 1.0)
        return Seen(ball, goal)


class Sights:
    """Keypoints by the sights so far."""

    def __init__(self, camera: KeypointCamera, hold: float) -> None:
        """Start with nothing seen.

        Args:
            camera: of training.
            hold: for which a thing that is not seen any more reads where it was [s].
        """
        self._camera, self._hold = camera, hold
        self._points = torch.zeros(KEYPOINTS, 2)
        self._valid = torch.zeros(KEYPOINTS, dtype=torch.bool)
        self._times = {"goal": -np.inf, "ball": -np.inf}

    def take(self, sight: Sight, quat: Quaternion) -> None:
        """Take a frame in; the vehicle's attitude, body to world, xyzw, says which corner is which."""
        seen = sight.seen()
        rot_wb = rotation_from_quat(torch.tensor([quat], dtype=torch.float64))[0].numpy()
        points, valid = detected_keypoints(self._camera, seen, rot_wb)
        for name, part in (("goal", slice(0, GOAL_KEYPOINTS)), ("ball", slice(GOAL_KEYPOINTS, None))):
            if getattr(seen, name) is not None and sight.stamp > self._times[name]:
                self._points[part], self._valid[part], self._times[name] = points[part], valid[part], sight.stamp

    def keypoints(self, now: float) -> tuple[np.ndarray, np.ndarray]:
        """Keypoints at a time [s]: normalised, float32, shape (1, 8, 2), and validity, shape (1, 8)."""
        points, valid = self._points.clone(), self._valid.clone()
        for name, part in (("goal", slice(0, GOAL_KEYPOINTS)), ("ball", slice(GOAL_KEYPOINTS, None))):
            if now - self._times[name] > self._hold:
                radius = points[part].norm(dim=-1, keepdim=True)
                left = self._camera.edge_reads and bool((radius > NEAR_EDGE).any())
                points[part] = points[part] / radius.clamp(min=1e-6) if left else torch.zeros_like(points[part])
                valid[part] = False
        return points[None].numpy(), valid[None].numpy()

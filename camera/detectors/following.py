"""The ball from frame to frame: where it is looked for, and what it reads while it is missed."""

import math
from dataclasses import replace

import numpy as np

from camera.detectors.contours import BallSeen, Known, Seen

WITHIN = math.radians(12.0)
"""Of where the ball was a frame ago it is looked for, and so much further with each frame in which it was not seen [rad]."""


class Following:
    """The ball as it was last seen: a turn of the vehicle leaves its direction in the world, and a cable its distance."""

    def __init__(self, hold: float, ray_w: np.ndarray | None = None, half_angle: float = 0.0, stamp: float = 0.0) -> None:
        """Begin with a ball seen at a stamp, or with none.

        Args:
            hold: for which a ball that is not seen reads as if it went on hanging as it did, in the unit of stamps.
            ray_w: to the ball, unit, world frame, shape (3,). half_angle: that it fills [rad].
            stamp: of a time, or the number of a frame.
        """
        self._hold, self._ray_w, self._half_angle, self._stamp, self.missed = hold, ray_w, half_angle, stamp, 0

    def known(self, rot_wc: np.ndarray, height: float, distance: tuple[float, float] | None) -> Known:
        """What a detector is told: camera to world, shape (3, 3), height of the lens and distance of the ball [m], and where it was."""
        ray_c = None if self._ray_w is None else rot_wc.T @ self._ray_w
        return Known(rot_wc[2], height, distance, ray_c, WITHIN * (1 + self.missed), north_c=rot_wc[0])

    def take(self, seen: Seen, rot_wc: np.ndarray | None, stamp: float) -> Seen:
        """What was seen in a frame, with a ball that was missed where it would hang; without an attitude nothing is followed."""
        if rot_wc is None:
            self._ray_w, self.missed = None, 0
        elif seen.ball is not None:
            self._ray_w, self._half_angle, self._stamp, self.missed = rot_wc @ seen.ball.ray_c, seen.ball.half_angle, stamp, 0
        else:
            self.missed += 1
            if self._ray_w is not None and stamp - self._stamp <= self._hold:
                return replace(seen, ball=BallSeen(rot_wc.T @ self._ray_w, self._half_angle, 0.0))
        return seen

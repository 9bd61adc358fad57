"""Ball and goal from frame to frame: where they are looked for, and what the ball reads while it is missed.

Each is a direction in the world that turns. A hanging ball is a pendulum: the vehicle's thrust drives its direction about the lens, the
same gravity pulls both. What is not known of it is noise of a Kalman filter, whose spread says how far off a prediction can be.
"""

import math
from dataclasses import replace

import numpy as np

from camera.detectors.contours import GATE, BallSeen, Known, Seen

READ = 0.01
"""Of a direction in the world, about each axis: of the attitude, with which a detection is turned there, and of the detection [rad]."""

TURNS = {"ball": 4.0, "goal": 1.0}  # rate of what was seen once, about each axis [rad/s]

DRIVEN = 8.0
"""Of a direction's acceleration in each frame, about each axis, beyond a pendulum's [rad/s^2]. Set on 20 throws of the training simulator;
on 10 of the realistic reference plant five blind frames are 2.7 deg off (rms), where the filter's spread about both axes says 2.8."""

THRUST = 14.0
"""Specific thrust of the vehicle [m/s^2]: median of throws of `vision`, which have 10 to 25; a hover has 12.5. The rest is in `DRIVEN`."""

STILL = 0.05, 0.2  # of a ball that is said to hang still: direction [rad] and its rate [rad/s]

LOST = 0.04
"""Standard deviation about each axis beyond which a prediction tells nothing [rad]: a ball turns by as much in a frame of a throw, and of
the frames of training one in twenty is repeated."""


class Track:
    """A direction in the world, its rate and how well both are known; the same about each axis across it."""

    def __init__(self, ray_w: np.ndarray, stamp: float, spread: float, rate: float) -> None:
        """Begin with a unit ray, shape (3,), at a time [s], and standard deviations about each axis of it [rad] and its rate [rad/s]."""
        self.ray_w, self.rate_w, self.stamp = ray_w, np.zeros(3), stamp
        self._covariance = np.diag([spread**2, rate**2])

    @property
    def spread(self) -> float:
        """Standard deviation of the direction about each axis [rad]."""
        return math.sqrt(self._covariance[0, 0])

    def predict(self, stamp: float, driven_w: np.ndarray) -> None:
        """Turn on to a time [s]; ``driven_w``: acceleration of the direction [rad/s^2], shape (3,)."""
        dt, self.stamp = stamp - self.stamp, stamp
        moved, push = np.array([[1.0, dt], [0.0, 1.0]]), np.array([0.5 * dt * dt, dt])
        self.ray_w = _unit(self.ray_w + dt * self.rate_w + push[0] * driven_w)
        self.rate_w = _across(self.rate_w + dt * driven_w, self.ray_w)
        self._covariance = moved @ self._covariance @ moved.T + DRIVEN**2 * np.outer(push, push)

    def see(self, ray_w: np.ndarray) -> None:
        """Take in where it was seen, shape (3,), at the time that was predicted."""
        gain = self._covariance[:, 0] / (self._covariance[0, 0] + READ**2)
        off = _across(ray_w - self.ray_w, self.ray_w)
        self.ray_w = _unit(self.ray_w + gain[0] * off)
        self.rate_w = _across(self.rate_w + gain[1] * off, self.ray_w)
        self._covariance = self._covariance - np.outer(gain, self._covariance[0])


class Following:
    """What one camera has seen of ball and goal."""

    def __init__(self, radius: float, ball_w: np.ndarray | None = None) -> None:
        """Begin with a ball of a radius [m] that hangs still at a place from the lens [m], shape (3,), world frame, or with none."""
        self._radius, self._half_angle, self._begin = radius, 0.0, ball_w
        self._tracks: dict[str, Track] = {}

    def known(self, rot_wc: np.ndarray, up_w: np.ndarray, height: float, distance: tuple[float, float] | None, stamp: float) -> Known:
        """What a detector is told of a frame.

        Args:
            rot_wc: camera to world, shape (3, 3). up_w: the vehicle's z, along which it thrusts, shape (3,).
            height: of the lens [m]. distance: of a ball that hangs [m]; None: it does not.
            stamp: of the frame [s].
        """
        if self._begin is not None:
            far = float(np.linalg.norm(self._begin))
            self._tracks["ball"], self._half_angle = Track(self._begin / far, stamp, *STILL), math.asin(self._radius / far)
            self._begin = None
        for name, track in self._tracks.items():
            hangs = name == "ball" and distance is not None
            pull = THRUST * math.sin(self._half_angle) / self._radius if hangs else 0.0
            track.predict(stamp, -pull * _across(up_w, track.ray_w))
        where = {f"{name}_{of}": value for name, track in self._tracks.items()
                 for of, value in (("ray_c", rot_wc.T @ track.ray_w), ("within", min(GATE * track.spread, math.pi)))}  # fmt: skip
        return Known(rot_wc[2], height, distance, north_c=rot_wc[0], **where)

    def take(self, seen: Seen, rot_wc: np.ndarray | None, stamp: float) -> Seen:
        """What was seen in a frame, with a ball that was missed where it is predicted; without an attitude nothing is followed."""
        if rot_wc is None:
            self._tracks = {}
            return seen
        rays = {} if seen.ball is None else {"ball": seen.ball.ray_c}
        rays |= {} if seen.goal is None else {"goal": _unit(seen.goal.rays_c.mean(0))}
        for name, ray_c in rays.items():
            ray_w, track = rot_wc @ ray_c, self._tracks.get(name)
            if track is not None and ray_w @ track.ray_w > math.cos(min(GATE * math.hypot(track.spread, READ), math.pi)):
                track.see(ray_w)
            else:
                self._tracks[name] = Track(ray_w, stamp, READ, TURNS[name])
        if seen.ball is not None:
            self._half_angle = seen.ball.half_angle
        elif "ball" in self._tracks and self._tracks["ball"].spread < LOST:
            return replace(seen, ball=BallSeen(rot_wc.T @ self._tracks["ball"].ray_w, self._half_angle, 0.0))
        return seen


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def _across(vector: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """The part of a vector across a unit ray."""
    return vector - ray * (ray @ vector)

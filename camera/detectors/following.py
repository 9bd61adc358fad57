"""Ball and goal from frame to frame: where they are looked for, what the ball reads while it is
missed, and which square is the goal.

A ball is a direction in the world that turns. One that hangs is a pendulum: the vehicle's thrust
drives its direction about the lens, the same gravity pulls both. What is not known of it is noise
of a Kalman filter, whose spread says how far off a prediction can be. A square lies at a place on
the ground, where what each frame says of it adds up; the likeliest of all is the goal."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy import ndarray
from numpy.linalg import norm

from camera.detectors.contours import GATE, BallSeen, FrameDetections, GoalSeen, Prior

READ = 0.01
"""Of a direction in the world, about each axis: of the attitude, with which a detection is turned
there, and of the detection [rad].
"""

TURNS = 4.0  # rate of a ball that was detected once, about each axis [rad/s]

DRIVEN = 8.0
"""Of a direction's acceleration in each frame, about each axis, beyond a pendulum's [rad/s^2].

Set on 20 throws of the training simulator; on 10 of the realistic reference plant five blind frames
are 2.7 deg off (rms), where the filter's spread about both axes says 2.8.
"""

THRUST = 14.0
"""Specific thrust of the vehicle [m/s^2]: median of throws of `vision`, which have 10 to 25; a
hover has 12.5. The rest is in `DRIVEN`.
"""

INITIAL_SPREADS = (0.05, 0.2)
"""Of a ball that is said to hang still: direction [rad] and its rate [rad/s]."""

LOST = 0.04
"""Standard deviation about each axis beyond which a prediction tells nothing [rad]: a ball turns by
as much in a frame of a throw, and of the frames of training one in twenty is repeated.
"""

MEMORY = 2.0
"""Time in which a frame's evidence of a square fades to 1/e, and after which an undetected one is
forgotten [s]: a hover. A frame counts by the time since the one before, as frames err alike the
closer they are.
"""

SUREST = 0.99  # probability of a square in one frame at most


class BallTrack:
    """A direction in the world, its rate and how well both are known; the same about each axis
    across it.
    """

    def __init__(self, ray_w: ndarray, stamp: float, spread: float, rate: float):
        """Begin with a unit ray, shape (3,), at a time [s], and standard deviations about each axis
        of it [rad] and its rate [rad/s].
        """
        self.ray_w = ray_w
        self.rate_w = np.zeros(3)
        self.stamp = stamp
        self._covariance = np.diag([spread**2, rate**2])

    @property
    def spread(self) -> float:
        """Standard deviation of the direction about each axis [rad]."""
        return math.sqrt(self._covariance[0, 0])

    def predict(self, stamp: float, driven_w: ndarray) -> None:
        """Turn on to a time [s]; ``driven_w``: acceleration of the direction [rad/s^2],
        shape (3,).
        """
        dt = stamp - self.stamp
        self.stamp = stamp
        moved = np.array([[1.0, dt], [0.0, 1.0]])
        push = np.array([0.5 * dt * dt, dt])
        self.ray_w = _unit(self.ray_w + dt * self.rate_w + push[0] * driven_w)
        self.rate_w = _perpendicular(self.rate_w + dt * driven_w, self.ray_w)
        self._covariance = moved @ self._covariance @ moved.T + DRIVEN**2 * np.outer(push, push)

    def correct(self, ray_w: ndarray) -> None:
        """Take in where it was seen, shape (3,), at the time that was predicted."""
        gain = self._covariance[:, 0] / (self._covariance[0, 0] + READ**2)
        off = _perpendicular(ray_w - self.ray_w, self.ray_w)
        self.ray_w = _unit(self.ray_w + gain[0] * off)
        self.rate_w = _perpendicular(self.rate_w + gain[1] * off, self.ray_w)
        self._covariance = self._covariance - np.outer(gain, self._covariance[0])


@dataclass(eq=False)
class Square:
    """A possible goal: its last place on the ground [m], shape (2,), when [s], and its
    log-odds by the frames so far.
    """

    place_w: ndarray
    stamp: float
    log_odds: float = 0.0


class BallGoalTracker:
    """Tracks of ball and goal in one camera."""

    def __init__(self, radius: float, side: float, ball_w: ndarray | None = None):
        """Begin with sizes of ball and goal [m], and a ball that hangs still at a place from the
        lens [m], shape (3,), or with none.
        """
        self._radius = radius
        self._side = side
        self._half_angle = 0.0
        self._begin = ball_w
        self._ball: BallTrack | None = None
        self._squares: list[Square] = []
        self._eye_w = np.zeros(3)
        self._stamp = math.inf
        self._weight = 0.0

    def prior(
        self,
        rot_wc: ndarray,
        up_w: ndarray,
        eye_w: ndarray,
        distance: tuple[float, float] | None,
        stamp: float,
    ) -> Prior:
        """Return the prior knowledge for a frame.

        Args:
            rot_wc: camera to world, shape (3, 3). up_w: the vehicle's z, along which it thrusts,
                shape (3,).
            eye_w: the lens [m], shape (3,). distance: of a ball that hangs [m]; None: it does not.
            stamp: of the frame [s].
        """
        if self._begin is not None:
            length = float(norm(self._begin))
            self._ball = BallTrack(self._begin / length, stamp, *INITIAL_SPREADS)
            self._half_angle = math.asin(self._radius / length)
            self._begin = None
        where = {}
        if self._ball is not None:
            if distance is not None:
                pull = THRUST * math.sin(self._half_angle) / self._radius
            else:
                pull = 0.0
            self._ball.predict(stamp, -pull * _perpendicular(up_w, self._ball.ray_w))
            where["ball_ray_c"] = rot_wc.T @ self._ball.ray_w
            where["ball_within"] = min(GATE * self._ball.spread, math.pi)
        self._squares = [square for square in self._squares if stamp - square.stamp < MEMORY]
        self._weight = -math.expm1(-max(stamp - self._stamp, 0.0) / MEMORY)
        for square in self._squares:
            square.log_odds *= 1.0 - self._weight
        self._eye_w = eye_w
        self._stamp = stamp
        if self._squares:
            offset = np.append(self._likeliest().place_w, 0.0) - eye_w
            where["goal_ray_c"] = rot_wc.T @ _unit(offset)
            where["goal_within"] = self._side / float(norm(offset))
        return Prior(rot_wc[2], float(eye_w[2]), distance, north_c=rot_wc[0], **where)

    def take(
        self, detections: FrameDetections, rot_wc: ndarray | None, stamp: float
    ) -> FrameDetections:
        """Return the detections of a frame, with a ball that was missed where it is predicted, and
        of the squares the one that is the goal.

        Without an attitude nothing is followed.
        """
        if rot_wc is None:
            self._ball = None
            self._squares = []
            return detections
        detections = replace(detections, goal=self._goal(detections, rot_wc))
        if detections.ball is not None:
            ray_w = rot_wc @ detections.ball.ray_c
            if self._ball is not None and ray_w @ self._ball.ray_w > math.cos(
                min(GATE * math.hypot(self._ball.spread, READ), math.pi)
            ):
                self._ball.correct(ray_w)
            else:
                self._ball = BallTrack(ray_w, stamp, READ, TURNS)
            self._half_angle = detections.ball.half_angle
        elif self._ball is not None and self._ball.spread < LOST:
            ball = BallSeen(rot_wc.T @ self._ball.ray_w, self._half_angle, 0.0)
            return replace(detections, ball=ball)
        return detections

    def _goal(self, detections: FrameDetections, rot_wc: ndarray) -> GoalSeen | None:
        """Add up what a frame says of squares, of which two are no nearer than a side; returns the
        goal, unless it was missed.
        """
        squares: dict[int, GoalSeen] = {}
        for one in detections.squares:  # the likeliest first
            ray_w = rot_wc @ one.rays_c.mean(0)
            distance = self._eye_w[2] / -ray_w[2]
            place_w = self._eye_w[:2] + ray_w[:2] * distance
            offsets = [square.place_w - place_w for square in self._squares]
            distances = [float(norm(offset)) for offset in offsets]
            i = int(np.argmin([*distances, self._side]))  # the last: a new one
            if i in squares:
                continue
            if i == len(self._squares):
                self._squares.append(Square(place_w, self._stamp))
            square = self._squares[i]
            sure = min(max(one.score, 1.0 - SUREST), SUREST)
            squares[i] = one
            square.place_w = place_w
            square.stamp = self._stamp
            square.log_odds += self._weight * math.log(sure / (1.0 - sure))
        if self._squares:
            return squares.get(self._squares.index(self._likeliest()))
        return None

    def _likeliest(self) -> Square:
        return max(self._squares, key=lambda square: square.log_odds)


def _unit(vector: ndarray) -> ndarray:
    return vector / norm(vector)


def _perpendicular(vector: ndarray, ray: ndarray) -> ndarray:
    """The part of a vector across a unit ray."""
    return vector - ray * (ray @ vector)

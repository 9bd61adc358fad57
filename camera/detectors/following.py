"""Tracking of ball and goal over frames: predictions for the detector, a predicted ball where none
is detected, and the choice of the square that is the goal.

The track of a ball is a direction in the world and its rate. A hanging ball is a pendulum: the
vehicle's thrust accelerates its direction as seen from the lens, while gravity acts on both alike.
A Kalman filter models unknown accelerations as noise; its standard deviation is the uncertainty of
a prediction. A square has a fixed position on the ground, at which the evidence of all frames is
accumulated. The likeliest square is the goal."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy import ndarray
from numpy.linalg import norm

from camera.detectors.contours import GATE, BallSeen, FrameDetections, GoalSeen, Prior

READ = 0.01
"""Standard deviation of a measured direction in the world about each axis, from errors of attitude
and detection [rad].
"""

TURNS = 4.0  # standard deviation of the rate after the first detection, about each axis [rad/s]

DRIVEN = 8.0
"""Standard deviation of a direction's acceleration in each frame about each axis, in addition to
that of a pendulum [rad/s^2].

Tuned on 20 throws of the training simulator. On 10 throws of the realistic reference plant, the
error after five frames without a detection is 2.7 deg (rms); the filter's standard deviation over
both axes is 2.8 deg.
"""

THRUST = 14.0
"""Specific thrust of the vehicle [m/s^2]: median of throws of `vision`, which have 10 to 25; a
hover has 12.5. `DRIVEN` includes the difference.
"""

INITIAL_SPREADS = (0.05, 0.2)
"""Standard deviations of a ball that is stated to hang at rest: direction [rad] and rate
[rad/s].
"""

LOST = 0.04
"""Standard deviation about each axis beyond which a prediction is not used [rad]. A ball moves as
far in one frame of a throw, and one in twenty frames of training is repeated.
"""

MEMORY = 2.0
"""Time constant with which the evidence of a square decays, and time after which an undetected
square is forgotten [s]: the duration of a hover. A frame is weighted by the time since the previous
one, because the errors of close frames are correlated.
"""

SUREST = 0.99  # largest probability of a square in one frame


class BallTrack:
    """Kalman filter of a direction in the world and its rate, with equal covariance about both
    axes perpendicular to it.
    """

    def __init__(self, ray_w: ndarray, stamp: float, spread: float, rate: float):
        """Start at a unit ray, shape (3,), and a time [s], with the standard deviations about each
        axis of the direction [rad] and its rate [rad/s].
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
        """Predict the direction at a time [s]; ``driven_w``: its acceleration [rad/s^2], shape
        (3,).
        """
        dt = stamp - self.stamp
        self.stamp = stamp
        moved = np.array([[1.0, dt], [0.0, 1.0]])
        push = np.array([0.5 * dt * dt, dt])
        self.ray_w = _unit(self.ray_w + dt * self.rate_w + push[0] * driven_w)
        self.rate_w = _perpendicular(self.rate_w + dt * driven_w, self.ray_w)
        self._covariance = moved @ self._covariance @ moved.T + DRIVEN**2 * np.outer(push, push)

    def correct(self, ray_w: ndarray) -> None:
        """Update with a measured unit ray, shape (3,), at the time of the last prediction."""
        gain = self._covariance[:, 0] / (self._covariance[0, 0] + READ**2)
        off = _perpendicular(ray_w - self.ray_w, self.ray_w)
        self.ray_w = _unit(self.ray_w + gain[0] * off)
        self.rate_w = _perpendicular(self.rate_w + gain[1] * off, self.ray_w)
        self._covariance = self._covariance - np.outer(gain, self._covariance[0])


@dataclass(eq=False)
class Square:
    """A candidate for the goal: last detected position on the ground [m], shape (2,), its time [s],
    and the log-odds of all frames.
    """

    place_w: ndarray
    stamp: float
    log_odds: float = 0.0


class BallGoalTracker:
    """Tracker of ball and goal for one camera."""

    def __init__(self, radius: float, side: float, ball_w: ndarray | None = None):
        """Start with the ball's radius and the goal's side [m], and optionally the position of a
        ball at rest relative to the lens [m], shape (3,).
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
            rot_wc: camera to world, shape (3, 3). up_w: the vehicle's z axis, the direction of
                thrust, shape (3,).
            eye_w: position of the lens [m], shape (3,). distance: range of distances of a hanging
                ball [m]; None: the ball does not hang.
            stamp: time of the frame [s].
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
        """Update the tracks with a frame's detections. Return these with the square that is the
        goal, and with the predicted ball if none was detected.

        Without an attitude, all tracks are deleted.
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
        """Add a frame's evidence to the squares, which are at least a side apart. Return the goal
        if it was detected in this frame.
        """
        squares: dict[int, GoalSeen] = {}
        for one in detections.squares:  # the likeliest first
            ray_w = rot_wc @ one.rays_c.mean(0)
            distance = self._eye_w[2] / -ray_w[2]
            place_w = self._eye_w[:2] + ray_w[:2] * distance
            offsets = [square.place_w - place_w for square in self._squares]
            distances = [float(norm(offset)) for offset in offsets]
            i = int(np.argmin([*distances, self._side]))  # the last index: a new square
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
    """Return the component of a vector perpendicular to a unit ray."""
    return vector - ray * (ray @ vector)

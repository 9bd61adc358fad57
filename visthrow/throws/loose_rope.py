"""Simulate the rope after the release, for drawing: it flies with the ball and sinks to the ground
after the landing.

The training simulator computes the landing of a ball without a rope in closed form. Therefore the
rope's 4 g do not act on the ball here: the joints are equal point masses on rigid links, and the
last link ends in the ball. Positions are relative to the ball, in whose free-falling frame there is
no gravity. The reference plant simulates its own rope in flight; for it only the sinking is used.

Source: Verlet steps with a joint solution for all links (SHAKE; Ryckaert, Ciccotti, Berendsen, J.
Comput. Phys. 23, 1977)."""

import numpy as np
from numpy import ndarray
from numpy.linalg import norm

from sim.params import GRAVITY

STEP = 1e-3  # [s]
# Newton iterations for the links; their lengths change by less than 1 % in a step of 1 ms, so that
# few suffice
ITERATIONS = 4

SINKING_STEP = 4e-3  # [s]
SINKING_DAMPING = 6.0  # damping of the sinking rope [1/s]; chosen for its looks, not measured


class LooseRope:
    """A rope that is attached only to the ball.

    Attributes:
        offset_w: joints relative to the ball's centre, mount end first [m], shape (L, 3).
        velocity_w: their velocities relative to the ball [m/s], shape (L, 3).
    """

    def __init__(
        self,
        points_w: ndarray,
        velocity_w: ndarray,
        ball_w: ndarray,
        ball_vel_w: ndarray,
    ):
        """Start from positions [m] and velocities [m/s] of the joints, upper end first, shape
        (L + 1, 3), and of the ball's centre, shape (3,).
        """
        self.offset_w = np.array(points_w[:-1], dtype=float) - ball_w
        self.velocity_w = np.array(velocity_w[:-1], dtype=float) - ball_vel_w
        ends = np.vstack((self.offset_w, np.zeros(3)))
        self._lengths = norm(np.diff(ends, axis=0), axis=1)
        last = norm(np.asarray(points_w[-1]) - points_w[-2])
        # share of the last link between the ball's centre and the rope's lower end
        self._knot = 1.0 - last / self._lengths[-1]

    def fly(self, duration: float) -> None:
        """Advance the flight with the ball by a time [s]."""
        count = max(1, round(duration / STEP))
        h = duration / count
        for _ in range(count):
            moved = self._restore_links(self.offset_w + h * self.velocity_w)
            self.velocity_w = (moved - self.offset_w) / h
            self.offset_w = moved

    def sink(self, duration: float, ground: float) -> None:
        """Let the rope fall and come to rest for a time [s], while the ball does not move; the
        ground is at a height [m] relative to the ball's centre.

        Starting at the ball, each joint is moved to its link's length from the previous one
        (Mueller, Kim, Chentanez, Fast simulation of inextensible hair and fur, 2012). This is not
        accurate, but the rope comes to rest on the ground from any state."""
        count = max(1, round(duration / SINKING_STEP))
        h = duration / count
        for _ in range(count):
            self.velocity_w[:, 2] -= GRAVITY * h
            moved = self.offset_w + h * np.exp(-SINKING_DAMPING * h) * self.velocity_w
            end = np.zeros(3)
            for i in range(len(moved) - 1, -1, -1):
                end = moved[i] = _place_on_link(moved[i], end, self._lengths[i], ground)
            self.velocity_w = (moved - self.offset_w) / h
            self.offset_w = moved

    def _restore_links(self, moved: ndarray) -> ndarray:
        """Restore the links' lengths by moving joints along the links' directions before the
        step.
        """
        before = np.diff(np.vstack((self.offset_w, np.zeros(3))), axis=0)
        weight = np.append(np.full(len(before) - 1, 2.0), 1.0)  # the ball does not move
        for _ in range(ITERATIONS):
            links = np.diff(np.vstack((moved, np.zeros(3))), axis=0)
            excess = np.sum(links * links, axis=1) - self._lengths**2
            jacobian = np.diag(2.0 * weight * np.sum(links * before, axis=1))
            jacobian += np.diag(-2.0 * np.sum(links[1:] * before[:-1], axis=1), -1)
            jacobian += np.diag(-2.0 * np.sum(links[:-1] * before[1:], axis=1), 1)
            push = np.linalg.solve(jacobian, excess)[:, None] * before
            moved = moved + push
            moved[1:] -= push[:-1]
        return moved

    def points_w(self, ball_w: ndarray) -> ndarray:
        """Return joints and lower end of the rope [m], shape (L + 1, 3), for a ball at ``ball_w``,
        shape (3,).
        """
        knot = self._knot * self.offset_w[-1:]
        return np.vstack((self.offset_w, knot)) + ball_w


def _place_on_link(joint: ndarray, end: ndarray, length: float, ground: float) -> ndarray:
    """Return a joint moved to the distance ``length`` from the link's other end and above the
    ground; all positions relative to the ball's centre [m].
    """
    offset = joint - end
    offset *= length / max(float(norm(offset)), 1e-9)
    lowest = max(ground - end[2], -length)
    if offset[2] >= lowest:
        return end + offset
    flat = max(float(np.hypot(offset[0], offset[1])), 1e-9)
    offset[:2] *= np.sqrt(max(length**2 - lowest**2, 0.0)) / flat
    offset[2] = lowest
    return end + offset

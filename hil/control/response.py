"""What a vehicle does in its first hover against what it was commanded.

A vehicle of another weight, another thrust line, or with the sign of a rate turned is told from the
policy's by its poses, before it has sunk. A doublet of all three body rates makes it turn, so that
signs are seen where it hovers calmly."""

import math
from collections import deque

import numpy as np

from hil.poses.track import BodyState
from visthrow.common.rotations import rotate_one
from visthrow.onboard.hover import GRAVITY

AXES = ("roll", "pitch", "yaw")
STROKE = 0.16  # of the doublet, one way, then the other [s]
ROUNDS = 3  # doublets at most
LAG = 0.05  # time constant of an answer to a command [s]
DEADS = 6
"""Dead times before an answer that are tried, in ticks: real autopilots are half way after 25 to
100 ms. Of an axis the one counts that explains most.
"""
FALL, FALL_DEAD = 0.4, 2  # time over which the thrust is judged [s], its dead time in ticks
ANGLE_NOISE, HEIGHT_NOISE = 0.006, 0.002  # of an attitude, a height between poses [rad], [m]
CERTAIN, CERTAIN_SIGN = 4.0, 5.0  # deviations of the noise beyond which something is known
FEWEST_HEIGHTS = 5  # heights that a vertical acceleration is taken from


class Response:
    """Judges the first hover that is ours.

    Attributes:
        problem: what does not agree, in words; None so far.
    """

    def __init__(self, period: float, mass: float, tolerance: float, probe: float) -> None:
        """Wait for the first tick.

        Args:
            period: between two ticks [s]. mass: of vehicle, rope and payload [kg].
            tolerance: of the thrust, relative. probe: rate of the doublets [rad/s]; 0: none, and
                signs are judged by what the hover happens to command.
        """
        self._period, self._probe = period, probe
        self._mass, self._allowed = mass, tolerance * GRAVITY
        self.problem: str | None = None
        self._ticks = 0
        hover = np.array([mass * GRAVITY, 0.0, 0.0, 0.0])
        self._commands = deque([hover] * DEADS, maxlen=DEADS)  # the newest first
        self._answers = np.tile(hover, (DEADS, 1))  # expected now, by dead time [N, rad/s]
        self._last: BodyState | None = None
        self._speed = self._height = 0.0  # expected from the commands, upwards [m/s], [m]
        self._heights: list[float] = []  # above the expected ones [m]
        self._agreement, self._noise = np.zeros((DEADS, 3)), np.full((DEADS, 3), 1e-9)
        self._known = np.zeros(3, dtype=bool)  # axes that turned as they were told

    @property
    def running(self) -> bool:
        """Whether the first hover is still being judged."""
        return self._probe > 0.0 and self.problem is None and not self._known.all()

    @property
    def _scores(self) -> np.ndarray:
        """Return how surely each axis turns as it is told, in deviations, shape (3,)."""
        scores = self._agreement / np.sqrt(self._noise)
        best = np.abs(scores).argmax(axis=0)
        return scores[best, np.arange(3)]

    def rates(self) -> tuple[float, float, float]:
        """Return the doublet's body rates of this tick [rad/s]."""
        strokes = math.floor(self._ticks * self._period / STROKE)
        if not self.running or strokes >= 2 * ROUNDS:
            return (0.0, 0.0, 0.0)
        return (self._probe * (1 - 2 * (strokes % 2)),) * 3

    def note(self, command: tuple[float, ...], vehicle: BodyState) -> None:
        """Note the command of a tick, thrust [N] and body rates [rad/s], and where the vehicle is
        at that tick.
        """
        if self._known.all() and self._ticks * self._period > FALL:
            return
        if self._last is not None:
            self._judge_thrust(vehicle)
            self._judge_signs(vehicle)
        self._last = vehicle
        self._ticks += 1
        self._commands.appendleft(np.array(command))
        share = 1.0 - math.exp(-self._period / LAG)
        change = share * (np.array(self._commands) - self._answers)
        self._answers = self._answers + change
        # sums of turns telescope: the noise of an attitude counts as often as the rate changes
        self._noise += (ANGLE_NOISE * change[:, 1:]) ** 2

    def pause(self) -> None:
        """Note a tick in which nothing of ours was followed."""
        self._last = None

    def _judge_thrust(self, vehicle: BodyState) -> None:
        if self._ticks * self._period > FALL:
            return
        up = rotate_one(vehicle.quat, (0.0, 0.0, 1.0))[2]
        self._speed += (self._answers[FALL_DEAD, 0] / self._mass * up - GRAVITY) * self._period
        self._height += self._speed * self._period
        self._heights.append(vehicle.pos[2] - self._height)
        if len(self._heights) < FEWEST_HEIGHTS:
            return
        # place and speed at the beginning are as unknown as the acceleration that is looked for
        terms = np.vander(self._period * np.arange(len(self._heights)), 3)
        inverse = np.linalg.inv(terms.T @ terms)
        wrong = 2.0 * float((inverse @ terms.T @ np.array(self._heights))[0])
        noise = 2.0 * HEIGHT_NOISE * math.sqrt(inverse[0, 0])
        if abs(wrong) > self._allowed + CERTAIN * noise:
            way = "sinks" if wrong < 0.0 else "rises"
            self.problem = (
                f"thrust: it {way} by {abs(wrong):.1f} m/s2 against its commands; weight, hover"
                " share or slope is wrong"
            )

    def _judge_signs(self, vehicle: BodyState) -> None:
        self._agreement += self._answers[:, 1:] * turn_between(self._last.quat, vehicle.quat)
        doublet = round(2.0 * STROKE / self._period)
        if self._ticks < doublet + DEADS or (self._ticks - DEADS) % doublet:
            return  # judged when all of a doublet was answered
        self._known |= self._scores > CERTAIN_SIGN
        wrong = (self._scores < -CERTAIN_SIGN) & ~self._known
        if self.problem is None and wrong.any():
            self.problem = f"{_named(wrong)}: it turns against its commands; a sign is wrong"
        elif self.running and self._ticks > ROUNDS * doublet:
            self.problem = f"{_named(~self._known)}: it does not turn as it is told"


def _named(which: np.ndarray) -> str:
    return ", ".join(axis for axis, one in zip(AXES, which) if one)


def turn_between(first: tuple[float, ...], second: tuple[float, ...]) -> np.ndarray:
    """Return the small turn from one attitude to another [rad], body axes, shape (3,)."""
    x0, y0, z0, w0 = first
    x, y, z, w = second
    turn = np.array(
        [
            w0 * x - x0 * w - y0 * z + z0 * y,
            w0 * y + x0 * z - y0 * w - z0 * x,
            w0 * z - x0 * y + y0 * x - z0 * w,
        ]
    )
    return 2.0 * turn * math.copysign(1.0, w0 * w + x0 * x + y0 * y + z0 * z)

"""Compares a vehicle's response in its first hover with the commands.

Poses show another weight, another thrust line or a reversed rate before the vehicle has sunk. A
doublet of all three body rates makes it turn, so that signs show in a calm hover."""

import math
from collections import deque

import numpy as np

from hil.poses.track import BodyState
from visthrow.common.rotations import rotate_one
from visthrow.onboard.hover import GRAVITY

AXES = ("roll", "pitch", "yaw")
STROKE = 0.16  # of the doublet, one way, then the other [s]
ROUNDS = 3  # doublets at most
LAG = 0.05  # time constant of the response to a command [s]
DEADS = 6
"""Number of dead times that are tried [ticks]: real autopilots are half way after 25 to 100 ms. For
each axis the one that explains most counts.
"""
FALL, FALL_DEAD = 0.4, 2  # time over which the thrust is judged [s], its dead time in ticks
ANGLE_NOISE, HEIGHT_NOISE = 0.006, 0.002  # of an attitude, a height between poses [rad], [m]
CERTAIN, CERTAIN_SIGN = 4.0, 5.0  # significant deviations, in standard deviations of the noise
FEWEST_HEIGHTS = 5  # for a vertical acceleration


class Response:
    """Judges the first hover by our commands; ``problem`` says what disagrees, or is None."""

    def __init__(self, period: float, mass: float, tolerance: float, probe: float) -> None:
        """Wait for the first tick.

        Args:
            period: between two ticks [s].
            mass: of vehicle, rope and payload [kg].
            tolerance: of the thrust, relative.
            probe: rate of the doublets [rad/s]; with 0 the hover's own commands show the signs.
        """
        self._period, self._probe = period, probe
        self._mass, self._allowed = mass, tolerance * GRAVITY
        self.problem: str | None = None
        self._ticks = 0
        hover = np.array([mass * GRAVITY, 0.0, 0.0, 0.0])
        self._commands = deque([hover] * DEADS, maxlen=DEADS)  # the newest first
        self._responses = np.tile(hover, (DEADS, 1))  # expected, by dead time [N, rad/s]
        self._last: BodyState | None = None
        self._speed = self._height = 0.0  # expected from the commands, upwards [m/s], [m]
        self._heights: list[float] = []  # above the expected ones [m]
        self._agreement, self._noise = np.zeros((DEADS, 3)), np.full((DEADS, 3), 1e-9)
        self._confirmed = np.zeros(3, dtype=bool)  # axes that turned as commanded

    @property
    def running(self) -> bool:
        """Whether the first hover is still being judged."""
        return self._probe > 0.0 and self.problem is None and not self._confirmed.all()

    @property
    def _scores(self) -> np.ndarray:
        """Return the evidence that each axis turns as commanded, in deviations, shape (3,)."""
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
        """Note a tick's command, thrust [N] and body rates [rad/s], and the vehicle's state."""
        if self._confirmed.all() and self._ticks * self._period > FALL:
            return
        if self._last is not None:
            self._judge_thrust(vehicle)
            self._judge_signs(vehicle)
        self._last = vehicle
        self._ticks += 1
        self._commands.appendleft(np.array(command))
        share = 1.0 - math.exp(-self._period / LAG)
        change = share * (np.array(self._commands) - self._responses)
        self._responses = self._responses + change
        # sums of turns telescope: an attitude's noise counts once for each change of the rate
        self._noise += (ANGLE_NOISE * change[:, 1:]) ** 2

    def pause(self) -> None:
        """Note a tick in which the vehicle did not follow our commands."""
        self._last = None

    def _judge_thrust(self, vehicle: BodyState) -> None:
        if self._ticks * self._period > FALL:
            return
        up = rotate_one(vehicle.quat, (0.0, 0.0, 1.0))[2]
        self._speed += (self._responses[FALL_DEAD, 0] / self._mass * up - GRAVITY) * self._period
        self._height += self._speed * self._period
        self._heights.append(vehicle.pos[2] - self._height)
        if len(self._heights) < FEWEST_HEIGHTS:
            return
        # initial position and velocity are as unknown as the acceleration
        terms = np.vander(self._period * np.arange(len(self._heights)), 3)
        inverse = np.linalg.inv(terms.T @ terms)
        wrong = 2.0 * float((inverse @ terms.T @ np.array(self._heights))[0])
        noise = 2.0 * HEIGHT_NOISE * math.sqrt(inverse[0, 0])
        if abs(wrong) > self._allowed + CERTAIN * noise:
            motion = "sinks" if wrong < 0.0 else "rises"
            self.problem = (
                f"thrust: the vehicle {motion} by {abs(wrong):.1f} m/s2 against its commands;"
                " weight, hover share or slope is wrong"
            )

    def _judge_signs(self, vehicle: BodyState) -> None:
        self._agreement += self._responses[:, 1:] * turn_between(self._last.quat, vehicle.quat)
        doublet = round(2.0 * STROKE / self._period)
        if self._ticks < doublet + DEADS or (self._ticks - DEADS) % doublet:
            return  # judged after the response to a whole doublet
        self._confirmed |= self._scores > CERTAIN_SIGN
        wrong = (self._scores < -CERTAIN_SIGN) & ~self._confirmed
        if self.problem is None and wrong.any():
            self.problem = (
                f"{_names(wrong)}: the vehicle turns against its commands; a sign is wrong"
            )
        elif self.running and self._ticks > ROUNDS * doublet:
            self.problem = f"{_names(~self._confirmed)}: the vehicle does not turn as commanded"


def _names(mask: np.ndarray) -> str:
    return ", ".join(np.array(AXES)[mask])


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

"""Comparison of the vehicle's response in the first hover with its commands.

It detects a wrong weight, a wrong thrust calibration or a reversed rate before the vehicle has
sunk. Doublets of all three body rates turn the vehicle, so that the signs show in a calm hover. If
the autopilot reports its body rates, they are judged within a tenth of a second, relative to their
noise in the autopilot's own hover. Poses cannot do that: in this time the vehicle turns by less
than their noise. From poses a doublet is judged after its response, by the angle turned.

An axis may be slower than in training: it is judged with the time constant that explains its
response best, and the doublets become longer until its sign is known."""

import math
from collections import deque

import numpy as np
from numpy import ndarray

from hil.links.backends.base import Command
from hil.poses.body_track import BodyState
from visthrow.common.rotations import Vector, conjugate, multiply, rotate_one, rotation_vector
from visthrow.onboard.hover import GRAVITY

AXES = ("roll", "pitch", "yaw")
STROKES = (
    0.16,
    0.32,
    0.64,
)  # duration of either half of each doublet [s]
LAGS = (0.05, 0.15, 0.45)  # time constants of the response that are tried [s]
DEADS = 6
"""Number of dead times that are tried, one tick apart: real autopilots reach half of the response
after 25 to 100 ms. For each sign of an axis, the pair of time constant and dead time counts that
explains the response best.
"""
# smallest noise assumed for the change of a reported rate between ticks [rad/s]
RATE_NOISE = 0.02
GAINS = np.array([0.3, 1.5])  # range for an axis that turns as commanded
HOVERED = 50  # ticks of the autopilot's own hover from which that noise is measured
FEWEST_RATES = 4  # reported changes that a sign needs
FALL = 0.4  # duration over which the thrust is judged [s]
FALL_DEAD = 2  # dead time of the thrust, in ticks
ANGLE_NOISE = 0.006  # of an attitude between poses [rad]
HEIGHT_NOISE = 0.002  # of a height between poses [m]
CERTAIN = 4.0  # standard deviations of the noise beyond which an error is certain
CERTAIN_SIGN = 5.0  # likewise for a sign
FEWEST_HEIGHTS = 5  # heights that a vertical acceleration needs


class Response:
    """Judges the first hover under the runner's commands.

    Attributes:
        problem: text on the disagreement found; None so far.
        reported: number of changes of the reported rates.
        time: for which the vehicle has followed the runner's commands and been judged [s].
    """

    def __init__(self, period: float, mass: float, tolerance: float, probe: float):
        """Start before the first tick.

        Args:
            period: between two ticks [s]. mass: of vehicle, rope and payload [kg].
            tolerance: of the thrust, relative. probe: rate of the doublets [rad/s]; 0: no doublets,
                and signs are judged by the commands of the hover alone.
        """
        self._period = period
        self._probe = probe
        self._mass = mass
        self._allowed = tolerance * GRAVITY
        self.problem: str | None = None
        self._ticks = 0
        strokes = [round(stroke / period) for stroke in STROKES]
        self._signs = [sign for count in strokes for sign in [1] * count + [-1] * count]
        self._ends = 2 * np.cumsum(strokes) + DEADS  # ticks at which a response is complete
        hover = np.array([mass * GRAVITY, 0.0, 0.0, 0.0])
        self._commands = deque([hover] * DEADS, maxlen=DEADS)  # newest first
        # expected now, by time constant and dead time [N, rad/s]
        self._responses = np.tile(hover, (len(LAGS), DEADS, 1))
        self._shares = 1.0 - np.exp(-period / np.array(LAGS))[:, None, None]
        self._last: BodyState | None = None
        self._speed = self._height = 0.0  # expected from the commands, upwards [m/s], [m]
        self._heights: list[float] = []  # above the expected ones [m]
        tried = (len(LAGS), DEADS, 3)
        # sums over reported and commanded changes of rates: their product, the squares of either;
        # likewise over angles turned
        self._sums = np.full((3, *tried), 1e-9)
        self._angle_sums = np.zeros((3, *tried))
        self._drift_sums = np.zeros((2, *tried))  # sums of tick times angle: commanded, turned
        self._angle = np.zeros(3)  # turned since the first tick, by poses [rad]
        self._commanded_angles = np.zeros(tried)  # [rad]
        self._before = deque(maxlen=HOVERED)  # reported rates of the autopilot's own hover
        self._reported: ndarray | None = None
        self.reported = 0
        self._confirmed = np.zeros(3, dtype=bool)  # axes that turned as commanded

    @property
    def time(self) -> float:
        return (self._ticks - 1) * self._period

    @property
    def running(self) -> bool:
        """Whether the first hover is still being judged."""
        return self._probe > 0.0 and self.problem is None and not self._confirmed.all()

    def rates(self) -> Vector:
        """Return the doublet's body rates in this tick [rad/s]; 0 for axes whose sign is known."""
        if not self.running or self._ticks >= len(self._signs):
            return (0.0, 0.0, 0.0)
        stroke = self._probe * self._signs[self._ticks]
        return tuple(0.0 if confirmed else stroke for confirmed in self._confirmed)

    def note(
        self,
        command: Command,
        vehicle: BodyState,
        rates: tuple[float, ...] | None = None,
    ) -> None:
        """Record the command of a tick, thrust [N] and body rates [rad/s], the vehicle's state at
        that tick, and the body rates that the autopilot last reported [rad/s].
        """
        if self._confirmed.all() and self._ticks * self._period > FALL:
            return
        if self._last is not None:
            self._judge_thrust(vehicle)
            self._judge_rates(rates)
            self._judge_turns(vehicle)
        self._last = vehicle
        self._ticks += 1
        self._commands.appendleft(np.array(command))
        change = self._shares * (np.array(self._commands) - self._responses)
        self._responses = self._responses + change

    def pause(self, rates: tuple[float, ...] | None) -> None:
        """Record a tick in which the vehicle did not follow the runner, with its reported rates."""
        self._last = None
        if rates is not None and not self._ticks:
            self._before.append(rates)

    def _judge_thrust(self, vehicle: BodyState) -> None:
        if self._ticks * self._period > FALL:
            return
        up = rotate_one(vehicle.quat, (0.0, 0.0, 1.0))[2]
        self._speed += (self._responses[0, FALL_DEAD, 0] / self._mass * up - GRAVITY) * self._period
        self._height += self._speed * self._period
        self._heights.append(vehicle.pos[2] - self._height)
        if len(self._heights) < FEWEST_HEIGHTS:
            return
        # initial height and speed are unknown too, so a parabola is fitted
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

    def _judge_rates(self, rates: tuple[float, ...] | None) -> None:
        """Judge the change of the reported rates from tick to tick, so that motion from before the
        take-over does not count.
        """
        last = self._reported
        self._reported = None if rates is None else np.array(rates)
        if last is None or self._reported is None or (last == self._reported).all():
            return
        change = self._reported - last + self._shares * last
        commanded = self._shares * np.array(self._commands)[:, 1:]
        self._sums += [change * commanded, commanded**2, change**2 + 0.0 * commanded]
        self.reported += 1
        if self.reported < FEWEST_RATES:
            return
        self._judge(_scores(self._sums, self._measure_wandering(), self.reported))

    def _measure_wandering(self) -> ndarray:
        """Return the variance of the reported rates' change from tick to tick in the autopilot's
        own hover [rad^2/s^2], shape (3,).
        """
        changes = np.diff(np.array(self._before), axis=0) if len(self._before) > 1 else np.zeros(3)
        return np.maximum((changes**2).mean(axis=0), RATE_NOISE**2)

    def _judge_turns(self, vehicle: BodyState) -> None:
        """Judge the angle turned since the first tick, by poses, whenever the response to a doublet
        is complete. A doublet turns the vehicle to one side and back, whatever the delay.
        """
        turn = multiply(conjugate(self._last.quat), vehicle.quat)
        self._angle = self._angle + rotation_vector(turn)
        self._commanded_angles = self._commanded_angles + self._period * self._responses[..., 1:]
        commanded = self._commanded_angles
        angle = self._angle + 0.0 * commanded
        self._angle_sums += [angle * commanded, commanded**2, angle**2]
        tick = float(self._ticks)
        self._drift_sums += [tick * commanded, tick * angle]
        if self._ticks not in self._ends:
            return
        # remove a linear drift of either angle from the sums
        commanded_drift, turned_drift = self._drift_sums
        products = [commanded_drift * turned_drift, commanded_drift**2, turned_drift**2]
        drift = np.array(products) / sum(k * k for k in range(1, self._ticks + 1))
        variance = np.full(3, ANGLE_NOISE**2)
        self._judge(_scores(self._angle_sums - drift, variance, self._ticks))
        if self.running and self._ticks == self._ends[-1]:
            self.problem = f"{_names(~self._confirmed)}: the vehicle does not turn as commanded"

    def _judge(self, scores: ndarray) -> None:
        """Confirm or reject axes by their scores, in deviations, shape (3,)."""
        self._confirmed |= scores > CERTAIN_SIGN
        wrong = (scores < -CERTAIN_SIGN) & ~self._confirmed
        if self.problem is None and wrong.any():
            self.problem = (
                f"{_names(wrong)}: the vehicle turns against its commands; a sign is wrong"
            )


def _scores(sums: ndarray, variance: ndarray, count: int) -> ndarray:
    """Return by how many standard deviations the commanded sign explains each axis better than the
    reversed sign or no rotation, shape (3,); negative if the reversed sign explains it best.

    Args:
        sums: of measured times commanded values, of commanded squares and of measured squares, for
            each time constant, dead time and axis, shape (3, lags, dead times, 3).
        variance: of the noise, shape (3,). count: number of measurements.
    """
    right = _misfit(sums, GAINS)
    reverse = _misfit(sums, -GAINS)
    at_rest = sums[2].reshape(-1, 3).min(axis=0)  # residual without any rotation
    best = np.minimum(right, reverse)
    second = np.minimum(np.maximum(right, reverse), at_rest)
    noise = np.maximum(variance, best / count)
    better = np.sign(reverse - right) * np.maximum(second - best, 0.0) / noise
    return np.sign(better) * np.sqrt(np.abs(better))


def _misfit(sums: ndarray, gains: ndarray) -> ndarray:
    """Return the smallest sum of squared residuals over time constants, dead times and gains within
    the given range, shape (3,).
    """
    product, commanded, measured = sums
    gain = np.clip(product / np.maximum(commanded, 1e-12), gains.min(), gains.max())
    misfit = measured - 2.0 * gain * product + gain**2 * commanded
    return misfit.reshape(-1, 3).min(axis=0)


def _names(which: ndarray) -> str:
    return ", ".join(axis for axis, one in zip(AXES, which) if one)

"""A release once it is commanded: latched once, separated a known lag later; its landing is found
in the payload's poses. `hil.control.tick.commander` judges and commands it.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy import ndarray

from hil.errors import RunError
from hil.poses.pose import Vector
from visthrow.common.free_fall import GRAVITY, fall_time, free_flight

LAG_TOLERANCE = 5e-3  # of the mechanism beyond the trained lag [s]
# a payload that hangs this long after its separation is stuck, whatever the autopilot answered [s]
STUCK_AFTER = 0.6
ROUNDING = 1e-9  # tolerance of differences of times [s]
GRAVITY_UP = np.array([0.0, 0.0, GRAVITY])

FALL_START = 0.02
FEWEST_FALL_POSES = 5
FALL_TIME = 0.12
"""Free fall by which a separation is detected: from this long after the expected one [s], with so
many poses at least, and for this long [s], in which drag takes a few millimetres.
"""

BEND = 5e-3
BEND_TIME = 0.1
"""Distance from the free fall, extended backwards, at which the rope still pulls [m], above the
noise; poses up to this long before the expected separation are used [s].
"""

BLUR = 0.03
"""A rope that pulls so little that `BEND` takes longer than this hides the separation [s].

The vision policy lets go at 2 to 6 m/s2; there the line ended up to 96 ms late.
"""

# last poses that a landing is extrapolated from: over 0.1 s free fall needs no drag
LANDING_POSES = 8

POSE_TIMEOUT = 0.1
MOST_EXTRAPOLATION = 0.15
"""A ball whose poses ended this long ago [s], and no longer than that before the ground [s], has
landed where its fall leads: a gate that has missed those poses takes the impact for a jump.
"""


@dataclass(frozen=True)
class Landing:
    """A throw as measured by the payload's poses; times on the runner's clock."""

    goal_w: Vector  # [m]
    start: float  # of the throw [s]
    latch: float  # of the release [s]
    time: float  # of the landing [s]
    landing_w: Vector  # payload's centre [m]
    error: float  # horizontal distance from the goal [m]
    duration: float  # from the throw's start to the landing [s]
    lag: float  # trained, from latch to separation [s]
    separation: float | None  # by the poses [s]; None where they do not show it
    separation_w: Vector | None  # payload's centre at that time [m]


@dataclass
class PayloadFlight:
    """Collects a payload's poses from the latch to the landing."""

    goal_w: Vector  # [m]
    start: float  # of the throw [s]
    latch: float  # of the release [s]
    height: float  # of the payload's centre as it lands [m]
    lag: float  # from latch to separation [s]
    _times: list[float] = field(default_factory=list)
    _points: list[Vector] = field(default_factory=list)

    def add(self, time: float, pos: Vector) -> Landing | None:
        """Take a pose of the payload, measured at a time [s], in our frames [m]; return the landing
        once it is down.
        """
        self._times.append(time)
        self._points.append(pos)
        # The last pose may be some centimetres above the ground, or after a bounce.
        if (
            len(self._times) < LANDING_POSES
            or pos[2] > self.height + 0.05
            or pos[2] > self._points[-2][2]
        ):
            return None
        return self._find_landing()

    def overdue(self, time: float) -> Landing | None:
        """Return the landing of a payload whose poses ended shortly before the ground, by a time
        [s].
        """
        times = self._times
        if len(times) < LANDING_POSES or times[-LANDING_POSES] <= self.latch + self.lag:
            return None
        if time - times[-1] < POSE_TIMEOUT:
            return None
        landing = self._find_landing()
        extrapolated = landing.time - times[-1]
        landed = extrapolated < MOST_EXTRAPOLATION and landing.time < time - POSE_TIMEOUT
        return landing if landed else None

    def _find_landing(self) -> Landing:
        times = np.array(self._times)
        points = np.array(self._points)
        last = times[-1]
        pos, vel = _parabola(times[-LANDING_POSES:] - last, points[-LANDING_POSES:])
        fall = fall_time(pos[2] - self.height, vel[2])
        point = pos + fall * vel
        point[2] = self.height
        time = float(last + fall)
        landed = tuple(point.tolist())
        error = float(np.hypot(landed[0] - self.goal_w[0], landed[1] - self.goal_w[1]))
        released = separation(times, points, self.latch + self.lag)
        return Landing(
            self.goal_w,
            self.start,
            self.latch,
            time,
            landed,
            error,
            time - self.start,
            self.lag,
            *(released or (None, None)),
        )


def separation(times: ndarray, points: ndarray, expected: float) -> tuple[float, Vector] | None:
    """Return the time [s] and place [m] of the separation: where the poses leave the free fall that
    follows it, extended backwards.

    While the rope pulls, the path departs from the free fall by ``a (t_s - t)^2 / 2``; the root of
    the distance is a line in time that ends at the separation. None with too few poses on either
    side of the expected time [s], or too small a pull."""
    begin = expected + FALL_START
    free = (times > begin) & (times < begin + FALL_TIME)
    if np.count_nonzero(free) < FEWEST_FALL_POSES:
        return None
    x, v = _parabola(times[free] - expected, points[free])
    lead = times - expected
    distance = np.linalg.norm(points - free_flight(x, v, lead[:, None]), axis=1)
    bent = (lead > -BEND_TIME) & (lead < FALL_START) & (distance > BEND)
    if np.count_nonzero(bent) < 3:
        return None
    slope, offset = np.polyfit(lead[bent], np.sqrt(distance[bent]), 1)
    if -slope * BLUR < math.sqrt(BEND) or not -BEND_TIME < -offset / slope < BEND_TIME:
        return None
    root = -offset / slope
    point = free_flight(x, v, root)
    return float(expected + root), tuple(point.tolist())


def _parabola(times: ndarray, points: ndarray) -> tuple[ndarray, ndarray]:
    """Fit a free fall to poses; return its position and velocity at time 0, shape (3,) each."""
    lifted = points + 0.5 * GRAVITY_UP * times[:, None] ** 2
    fit = np.linalg.lstsq(np.column_stack((np.ones_like(times), times)), lifted, rcond=None)[0]
    return fit[0], fit[1]


class Latch:
    """The release of the payload, and whether it hangs by its own poses.

    Attributes:
        at: time of the release [s]; None before there is one in this throw.
        command_time: of the mechanism's command [s].
        lag: trained, from latch to separation [s].
        count: releases so far.
        stuck: payloads that stayed on.
        landings: of the throws so far.
    """

    def __init__(
        self,
        lag: float,
        mechanism_lag: float,
        hang: float,
        tolerance: float,
        height: float,
        command_delay: float = 0.0,
    ):
        """Start with the payload hanging; raises `RunError` where the mechanism is slower than the
        policy was trained for.

        Args:
            lag: trained, from latch to separation [s].
            mechanism_lag: of the mechanism, from its command to separation [s].
            hang: of the payload's centre below the vehicle's at rest [m].
            tolerance: within which the payload counts as hanging [m].
            height: of the payload's centre as it lands [m].
            command_delay: by which commands act later than in training [s].
        """
        if mechanism_lag > lag + command_delay + LAG_TOLERANCE:
            raise RunError(
                f"the mechanism takes {mechanism_lag:g} s from command to separation, the policy"
                f" was trained with {lag:g} s; train one for the slower mechanism"
            )
        self.lag, self._wait = lag, max(0.0, lag + command_delay - mechanism_lag)
        self._hang = hang
        self._tolerance = tolerance
        self._height = height
        self.at: float | None = None
        self.command_time = -math.inf
        self.count = self.stuck = 0
        self.landings: list[Landing] = []
        self._start = 0.0
        self._flight: PayloadFlight | None = None

    def rearm(self) -> None:
        """Forget the last release: the payload hangs again, and the next throw is armed."""
        self.at = None

    def begin(self, time: float) -> None:
        """Note the start of a throw [s]."""
        self._start = time

    def trip(self, time: float, goal_w: Vector) -> float:
        """Latch at a time [s]; return the time of the mechanism's command [s], from which it
        separates after the trained lag.
        """
        self.at, self.command_time = time, time + self._wait
        self.count += 1
        self._flight = PayloadFlight(goal_w, self._start, time, self._height, self.lag)
        return self.command_time

    def has_separated(self, time: float) -> bool:
        """Return whether the payload has separated by a time [s], by latch and lag."""
        return self.at is not None and time - self.at >= self.lag - ROUNDING

    def payload_hangs(self, time: float, vehicle_w: Vector, payload_w: Vector | None) -> bool:
        """Return whether the payload hangs on the vehicle at a time [s], by the latch and by the
        positions [m]; None for a payload without a fresh pose.
        """
        if payload_w is None:
            return self.at is None
        excess = math.dist(vehicle_w, payload_w) - self._hang
        if self.at is None:  # it may have come off by itself
            return excess < self._tolerance
        if time - self.at < self.lag + STUCK_AFTER:
            return False
        hangs = abs(excess) < self._tolerance
        if hangs and self._flight is not None:
            self.stuck += 1
            self._flight = None
        return hangs

    def follow(self, time: float, payload_w: Vector) -> None:
        """Take a pose of the payload, measured at a time [s], in our frames [m]."""
        if self._flight is not None:
            self._note_landing(self._flight.add(time, payload_w))

    def overdue(self, time: float) -> None:
        """Note the landing of a payload whose poses ended shortly before the ground."""
        if self._flight is not None:
            self._note_landing(self._flight.overdue(time))

    def _note_landing(self, landing: Landing | None) -> None:
        if landing is not None:
            self.landings.append(landing)
            self._flight = None

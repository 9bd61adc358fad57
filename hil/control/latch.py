"""The release of the payload: latched once, followed by the separation after a known lag and by the
landing, which is found in the payload's poses. The policy's action decides on the release
(`visthrow.onboard.actions.wants_release`); `hil.control.tick.commander` checks and commands it.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy import ndarray

from hil.errors import RunError
from hil.poses.pose import Vector
from visthrow.common.free_fall import GRAVITY, fall_time, free_flight

LAG_TOLERANCE = 5e-3  # by which the mechanism's lag may exceed the trained one [s]
# a payload that still hangs this long after its separation is stuck, even if the autopilot
# acknowledged the release [s]
STUCK_AFTER = 0.6
ROUNDING = 1e-9  # tolerance of differences of times [s]
GRAVITY_UP = np.array([0.0, 0.0, GRAVITY])

FALL_START = 0.02
FEWEST_FALL_POSES = 5
FALL_TIME = 0.12
"""Free fall from which the separation is detected: its start after the expected separation [s], its
least number of poses, and its duration [s], in which drag amounts to a few millimetres.
"""

BEND = 5e-3
BEND_TIME = 0.1
"""Distance from the free fall, extended backwards, that shows that the rope still pulls [m], above
the noise of the poses; and the time before the expected separation from which poses are used [s].
"""

BLUR = 0.03
"""If the rope pulls so little that the distance needs longer than this to reach `BEND`, the time of
separation is not determined [s].

The vision policy releases at 2 to 6 m/s2; there the estimate was up to 96 ms late.
"""

# number of last poses from which a landing is extrapolated: over 0.1 s drag is negligible
LANDING_POSES = 8

POSE_TIMEOUT = 0.1
MOST_EXTRAPOLATION = 0.15
"""A payload without poses for ``POSE_TIMEOUT`` [s] counts as landed where its free fall ends, if
the fall ends at most ``MOST_EXTRAPOLATION`` [s] after the last pose. After a gap, the gate would
reject the poses after the impact as a jump.
"""


@dataclass(frozen=True)
class Landing:
    """The landing of a throw, measured from the payload's poses; times on the runner's clock."""

    goal_w: Vector  # [m]
    start: float  # of the throw [s]
    latch: float  # of the release [s]
    time: float  # of the landing [s]
    landing_w: Vector  # payload's centre [m]
    error: float  # horizontal distance from the goal [m]
    duration: float  # from the throw's start to the landing [s]
    lag: float  # trained, from latch to separation [s]
    separation: float | None  # from the poses [s]; None if they do not show it
    separation_w: Vector | None  # payload's centre at that time [m]


@dataclass
class PayloadFlight:
    """Collects a payload's poses from the latch to the landing."""

    goal_w: Vector  # [m]
    start: float  # of the throw [s]
    latch: float  # of the release [s]
    height: float  # of the payload's centre at landing [m]
    lag: float  # from latch to separation [s]
    _times: list[float] = field(default_factory=list)
    _points: list[Vector] = field(default_factory=list)

    def add(self, time: float, pos: Vector) -> Landing | None:
        """Add a position of the payload in the world frame [m], measured at a time [s]; return the
        landing once it has landed.
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
        """Return the landing of a payload whose poses ended shortly before the ground; None if it
        has not landed by a time [s].
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
    """Return time [s] and position [m] of the separation: where the poses depart from the free fall
    after it, extended backwards.

    While the rope pulls, the path departs from the free fall by ``a (t_s - t)^2 / 2``, so the
    square root of the distance is linear in time and reaches 0 at the separation. Returns None with
    too few poses before or after the expected time [s], or if the rope pulls too little."""
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
    """The release of the payload, with a check by its poses of whether it still hangs.

    Attributes:
        at: time of the release [s]; None before the release of this throw.
        command_time: when the mechanism is commanded [s].
        lag: trained, from latch to separation [s].
        count: releases so far.
        stuck: released payloads that stayed attached.
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
        """Start with the payload attached. Raises `RunError`: the mechanism is slower than the
        policy was trained for.

        Args:
            lag: trained, from latch to separation [s].
            mechanism_lag: of the mechanism, from its command to separation [s].
            hang: of the payload's centre below the vehicle's at rest [m].
            tolerance: within which the payload counts as hanging [m].
            height: of the payload's centre at landing [m].
            command_delay: additional delay of commands compared with training [s].
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
        """Forget the last release: the next throw is armed, with the payload attached again."""
        self.at = None

    def begin(self, time: float) -> None:
        """Note the start of a throw [s]."""
        self._start = time

    def trip(self, time: float, goal_w: Vector) -> float:
        """Latch the release at a time [s]; return when the mechanism must be commanded so that it
        separates after the trained lag [s].
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
        positions [m]; ``payload_w`` is None without a fresh pose of the payload.
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
        """Process a position of the payload in the world frame [m], measured at a time [s]."""
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

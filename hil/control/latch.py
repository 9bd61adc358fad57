"""The release of a throw on the runner's side: latched once, separated a known lag later, followed
by its own poses until it is down.
"""

import math
from dataclasses import dataclass

import numpy as np

from hil.errors import RunError
from hil.poses.pose import Vector
from visthrow.onboard.hover import GRAVITY

LAG_TOLERANCE = 5e-3  # what the mechanism may take longer than the trained lag [s]
# a payload that still hangs this long after it should have separated was not released, whatever was
# answered [s]
STUCK_AFTER = 0.6
ROUNDING = 1e-9  # tolerance of differences of times [s]

FREE_AFTER, FREE_LEAST, FREE_LONG = 0.02, 5, 0.12
"""The free fall that a separation is looked for before: poses from this long after the expected one
[s], so many at least, and over so long [s], in which the air takes a few millimetres.
"""

BENT, BENT_MOST = 5e-3, 0.1
"""Distance from the free fall carried backwards, from which on poses say when the rope held [m];
noise stays below. Poses up to so long before the expected separation are looked at [s].
"""

# poses before the ground that the landing is carried forward from: free fall needs no model of drag
# over 0.1 s
NEAR = 8

UNSEEN, MOST_BLIND = 0.1, 0.15
"""A ball whose poses ended this long ago [s], and no longer than that before the ground [s], has
landed where its fall leads: the impact itself looks like a jump to a gate that has missed the poses
before it.
"""


@dataclass(frozen=True)
class Landing:
    """One throw as the payload's poses tell it; times on the runner's clock."""

    goal_w: Vector  # [m]
    start: float  # of the throw [s]
    latch: float  # of the release [s]
    time: float  # of the landing [s]
    landing_w: Vector  # payload's centre [m]
    error: float  # horizontal distance from the goal [m]
    duration: float  # from the throw's start to the landing [s]
    lag: float = 0.0  # trained, from latch to separation [s]
    separation: float | None = None  # by the poses [s]; None where they do not tell
    separation_w: Vector | None = None  # payload's centre at that time [m]


class Flight:
    """Collects a payload's poses from the latch on until it is down."""

    def __init__(
        self, goal_w: Vector, start: float, latch: float, height: float, lag: float = 0.0
    ) -> None:
        """Begin at the latch [s] of a throw; the payload's centre lands at a height [m], and
        separates a lag after the latch [s].
        """
        self.goal_w, self.start, self.latch, self.height, self.lag = (
            goal_w,
            start,
            latch,
            height,
            lag,
        )
        self._times: list[float] = []
        self._points: list[Vector] = []

    def add(self, time: float, pos: Vector) -> Landing | None:
        """Take a pose of the payload, measured at a time [s], in our frames [m]; the landing, once
        it has come down.
        """
        self._times.append(time)
        self._points.append(pos)
        # The ball may be measured for the last time some centimetres above the ground, or bounce in
        # between.
        if len(self._times) < NEAR or pos[2] > self.height + 0.05 or pos[2] > self._points[-2][2]:
            return None
        return self._landing()

    def overdue(self, now: float) -> Landing | None:
        """Return the landing of a ball that by a time [s] was lost from sight shortly before the
        ground.
        """
        times = self._times
        free = len(times) >= NEAR and times[-NEAR] > self.latch + self.lag
        if not free or now - times[-1] < UNSEEN:
            return None
        landing = self._landing()
        return (
            landing
            if landing.time - times[-1] < MOST_BLIND and landing.time < now - UNSEEN
            else None
        )

    def _landing(self) -> Landing:
        times, points = np.array(self._times), np.array(self._points)
        last = times[-1]
        window = slice(max(0, len(times) - NEAR), len(times))
        x, vx = _parabola(times[window] - last, points[window])
        drop = x[2] - self.height
        fall = (vx[2] + np.sqrt(max(vx[2] ** 2 + 2.0 * GRAVITY * drop, 0.0))) / GRAVITY
        point = x + fall * vx
        point[2] = self.height
        when = float(last + fall)
        landed = tuple(point.tolist())
        error = float(np.hypot(landed[0] - self.goal_w[0], landed[1] - self.goal_w[1]))
        released = separation(times, points, self.latch + self.lag)
        return Landing(
            self.goal_w,
            self.start,
            self.latch,
            when,
            landed,
            error,
            when - self.start,
            self.lag,
            *(released or (None, None)),
        )


def separation(
    times: np.ndarray, points: np.ndarray, expected: float
) -> tuple[float, Vector] | None:
    """Return when [s] and where [m] the rope let go: where the poses leave the free fall after it,
    carried backwards.

    While the rope holds, its pull bends the path away from the free fall by ``a (t_s - t)^2 / 2``;
    the root of the distance is a line in time that ends at the separation. None where too few poses
    were seen on either side of the expected time [s]."""
    free = (times > expected + FREE_AFTER) & (times < expected + FREE_AFTER + FREE_LONG)
    if np.count_nonzero(free) < FREE_LEAST:
        return None
    x, v = _parabola(times[free] - expected, points[free])
    when = times - expected
    off = np.linalg.norm(
        points + [0.0, 0.0, 0.5 * GRAVITY] * when[:, None] ** 2 - x - when[:, None] * v, axis=1
    )
    bent = (when > -BENT_MOST) & (when < FREE_AFTER) & (off > BENT)
    if np.count_nonzero(bent) < 3:
        return None
    slope, offset = np.polyfit(when[bent], np.sqrt(off[bent]), 1)
    if not slope < 0.0 or not -BENT_MOST < -offset / slope < BENT_MOST:
        return None
    root = -offset / slope
    point = x + root * v - [0.0, 0.0, 0.5 * GRAVITY * root * root]
    return float(expected + root), tuple(point.tolist())


def _parabola(times: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the position and velocity at time 0 of the free fall that fits poses best, shape (3,)
    each.
    """
    lifted = points + [0.0, 0.0, 0.5 * GRAVITY] * times[:, None] ** 2
    fit = np.linalg.lstsq(np.column_stack((np.ones_like(times), times)), lifted, rcond=None)[0]
    return fit[0], fit[1]


class Latch:
    """Whether the payload hangs, by what was asked for and by its own poses.

    Attributes:
        at: of the release [s]; None until there is one in this throw. commanded: when the mechanism
            is told of it [s].
        lag: trained, from latch to separation [s]. count: releases so far. stuck: payloads that
            stayed on.
        landings: of the throws so far.
    """

    def __init__(
        self,
        lag: float,
        mechanism_lag: float,
        hang: float,
        tolerance: float,
        height: float,
        later: float = 0.0,
    ) -> None:
        """Start with the payload hanging; raises `RunError` where the mechanism is slower than the
        policy was trained for.

        Args:
            lag: trained, from latch to separation [s]. mechanism_lag: of the mechanism, from its
                command to separation [s].
            hang: of the payload's centre below the vehicle's at rest [m]. tolerance: within which
                the payload counts as hanging [m].
            height: of the payload's centre as it lands [m]. later: by which all that the policy
                decides comes later than in training [s].
        """
        if mechanism_lag > lag + later + LAG_TOLERANCE:
            raise RunError(
                f"the mechanism takes {mechanism_lag:g} s from command to separation, the policy"
                f" was trained with {lag:g} s; train one for the slower mechanism"
            )
        self.lag, self._wait = lag, max(0.0, lag + later - mechanism_lag)
        self._hang, self._tolerance, self._height = hang, tolerance, height
        self.at: float | None = None
        self.commanded = -math.inf
        self.count = self.stuck = 0
        self.landings: list[Landing] = []
        self._begun = 0.0
        self._flight: Flight | None = None

    def rearm(self) -> None:
        """Take the payload for hung on again: the operator has armed the next throw."""
        self.at = None

    def begin(self, now: float) -> None:
        """Note the start of a throw [s]."""
        self._begun = now

    def trip(self, now: float, goal_w: Vector) -> float:
        """Latch at a time [s]; returns when the mechanism is to be told, so that it separates after
        the trained lag [s].
        """
        self.at, self.commanded, self.count = now, now + self._wait, self.count + 1
        self._flight = Flight(goal_w, self._begun, now, self._height, self.lag)
        return self.commanded

    def separated(self, now: float) -> bool:
        """Return whether the payload is off by now [s], as far as latch and lag tell."""
        return self.at is not None and now - self.at >= self.lag - ROUNDING

    def hangs_still(self, now: float, vehicle_w: Vector, payload_w: Vector | None) -> bool:
        """Return whether the payload hangs on the vehicle at a time [s], by the latch and then by
        both places [m], if known.
        """
        if self.at is None:  # it may have come off by itself
            return (
                payload_w is None or math.dist(vehicle_w, payload_w) < self._hang + self._tolerance
            )
        if payload_w is None or now - self.at < self.lag + STUCK_AFTER:
            return False
        hangs = abs(math.dist(vehicle_w, payload_w) - self._hang) < self._tolerance
        if hangs and self._flight is not None:
            self.stuck, self._flight = self.stuck + 1, None
        return hangs

    def follow(self, time: float, payload_w: Vector) -> None:
        """Take a pose of the payload in: measured at a time [s], in our frames [m]."""
        if self._flight is not None:
            self._down(self._flight.add(time, payload_w))

    def overdue(self, now: float) -> None:
        """Look for a payload that was lost from sight shortly before the ground."""
        if self._flight is not None:
            self._down(self._flight.overdue(now))

    def _down(self, landing: Landing | None) -> None:
        if landing is not None:
            self.landings.append(landing)
            self._flight = None

"""The release of a throw on the runner's side: latched once, separated a known lag later, followed until it is down."""

import math

from hil.control.landing import Flight, Landing
from hil.errors import RunError
from hil.poses.pose import Vector

LAG_TOLERANCE = 5e-3  # what the mechanism may take longer than the trained lag [s]
STUCK_AFTER = 0.6  # a payload that still hangs this long after it should have separated was not released, whatever was answered [s]
ROUNDING = 1e-9  # tolerance of differences of times [s]


class Latch:
    """Whether the payload hangs, by what was asked for and by its own poses.

    Attributes:
        at: of the release [s]; None until there is one in this throw. commanded: when the mechanism is told of it [s].
        lag: trained, from latch to separation [s]. count: releases so far. stuck: payloads that stayed on.
        landings: of the throws so far.
    """

    def __init__(self, lag: float, mechanism_lag: float, hang: float, tolerance: float, height: float, later: float = 0.0) -> None:
        """Start with the payload hanging.

        Args:
            lag: trained, from latch to separation [s]. mechanism_lag: of the mechanism, from its command to separation [s].
            hang: of the payload's centre below the vehicle's at rest [m]. tolerance: within which the payload counts as hanging [m].
            height: of the payload's centre as it lands [m].
            later: by which all that the policy decides comes about later than in its training [s], the separation as well.

        Raises:
            RunError: the mechanism is slower than the policy was trained for.
        """
        if mechanism_lag > lag + later + LAG_TOLERANCE:
            raise RunError(
                f"the mechanism takes {mechanism_lag:g} s from command to separation, the policy was trained with "
                f"{lag:g} s; train one for the slower mechanism"
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
        """Latch at a time [s]; returns when the mechanism is to be told, so that it separates after the trained lag [s]."""
        self.at, self.commanded, self.count = now, now + self._wait, self.count + 1
        self._flight = Flight(goal_w, self._begun, now, self._height, self.lag)
        return self.commanded

    def separated(self, now: float) -> bool:
        """Return whether the payload is off by now [s], as far as latch and lag tell."""
        return self.at is not None and now - self.at >= self.lag - ROUNDING

    def hangs_still(self, now: float, vehicle_w: Vector, payload_w: Vector | None) -> bool:
        """Return whether the payload hangs on the vehicle at a time [s], by the latch and then by both places [m], if known."""
        if self.at is None:  # it may have come off by itself
            return payload_w is None or math.dist(vehicle_w, payload_w) < self._hang + self._tolerance
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

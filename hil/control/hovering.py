"""Position hover before and after a throw, with the mean thrust that it needs."""

from collections import deque

import numpy as np

from hil.links.backends.base import Command
from hil.poses.body_track import BodyState
from hil.poses.pose import Vector
from visthrow.onboard.hover import HoverController, HoverParams

HOVER_TICKS = 50  # over which the thrust is averaged: a second
DESCENT = 0.4  # speed of the hover point while landing [m/s]


class Hovering:
    """A hover controller that holds the position ``place_w`` [m]."""

    def __init__(self, place_w: Vector, heading: float, max_thrust: float, period: float):
        """Hold a position [m] and heading [rad]; the period is between two commands [s]."""
        self.place_w = place_w
        self._heading = heading
        self._period = period
        self._controller = HoverController(HoverParams(max_thrust=max_thrust), period)
        self._shares: deque[float] = deque(maxlen=HOVER_TICKS)  # thrust over weight

    def reset(self) -> None:
        """Reset the integrated errors, after the vehicle did not follow the commands."""
        self._controller.reset()

    def hold(self, place_w: Vector) -> None:
        """Hold another position [m]."""
        self.reset()
        self.place_w = place_w

    def descend(self) -> None:
        """Lower the held position by one period of the descent, at most to the ground."""
        x, y, z = self.place_w
        self.place_w = (x, y, max(z - DESCENT * self._period, 0.0))

    def command(self, vehicle: BodyState, mass: float) -> Command:
        """Return thrust [N] and body rates [rad/s]; ``mass``: of the vehicle with its load [kg]."""
        output = self._controller.step(
            np.array([vehicle.pos]),
            np.array([vehicle.quat]),
            np.array([vehicle.vel]),
            np.array(self.place_w),
            mass,
            self._heading,
        )
        return tuple(output[0].tolist())

    def note(self, share: float | None) -> None:
        """Record a tick's thrust over the weight; None if the vehicle did not hover by the runner's
        commands.
        """
        if share is None:
            self._shares.clear()
        else:
            self._shares.append(share)

    def share(self) -> float | None:
        """Return the mean thrust over the weight; None before one second of hover."""
        complete = len(self._shares) == HOVER_TICKS
        return sum(self._shares) / HOVER_TICKS if complete else None

"""Hover on poses before and after a throw, with the thrust that it takes."""

from collections import deque

import numpy as np

from hil.links.backends.base import Command
from hil.poses.body_track import BodyState
from hil.poses.pose import Vector
from visthrow.onboard.hover import HoverController, HoverParams

HOVER_TICKS = 50  # over which the hover's thrust is averaged: a second
DESCENT = 0.4  # speed of the hover point while landing [m/s]


class Hovering:
    """A hover controller with the place ``place_w`` that it holds [m]."""

    def __init__(self, place_w: Vector, heading: float, max_thrust: float, period: float):
        """Start at a place [m] and heading [rad]; the period is between two commands [s]."""
        self.place_w = place_w
        self._heading = heading
        self._period = period
        self._controller = HoverController(HoverParams(max_thrust=max_thrust), period)
        self._shares: deque[float] = deque(maxlen=HOVER_TICKS)  # thrust over weight

    def reset(self) -> None:
        """Forget the integrated errors: the vehicle did not follow the commands."""
        self._controller.reset()

    def hold(self, place_w: Vector) -> None:
        """Hold another place."""
        self.reset()
        self.place_w = place_w

    def descend(self) -> None:
        """Lower the place by one period of the descent, at most to the ground."""
        x, y, z = self.place_w
        self.place_w = (x, y, max(z - DESCENT * self._period, 0.0))

    def command(self, vehicle: BodyState, mass: float) -> Command:
        """Return thrust [N] and body rates [rad/s] for a vehicle and its load of a mass [kg]."""
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
        """Note a tick's thrust over the weight; None where the vehicle did not hover by it."""
        if share is None:
            self._shares.clear()
        else:
            self._shares.append(share)

    def share(self) -> float | None:
        """Return the mean thrust over the weight; None before a second of hover."""
        complete = len(self._shares) == HOVER_TICKS
        return sum(self._shares) / HOVER_TICKS if complete else None

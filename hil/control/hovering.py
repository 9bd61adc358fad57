"""Hovering on poses, before a throw and after it: where, with what command, and what thrust it
takes.
"""

from collections import deque

import numpy as np

from hil.poses.pose import Vector
from hil.poses.track import BodyState
from visthrow.onboard.hover import HoverController, HoverParams

HOVERED = 50  # ticks over which the thrust of the hover before a throw is taken: a second
DESCENT = 0.4  # speed of the hover point while landing [m/s]


class Hovering:
    """A hover controller with the place ``place_w`` that it holds [m]."""

    def __init__(self, place_w: Vector, heading: float, max_thrust: float, period: float) -> None:
        """Start at a place [m] and heading [rad]; the period is between two commands [s]."""
        self.place_w, self._heading, self._period = place_w, heading, period
        self._controller = HoverController(HoverParams(max_thrust=max_thrust), period)
        self._shares: deque[float] = deque(maxlen=HOVERED)  # thrust over weight

    def reset(self) -> None:
        """Forget what was learnt about the vehicle: nothing of what was commanded came about."""
        self._controller.reset()

    def hold(self, place_w: Vector) -> None:
        """Hold another place from now on."""
        self.reset()
        self.place_w = place_w

    def descend(self) -> None:
        """Lower the place by what one period takes, to the ground and no further."""
        x, y, z = self.place_w
        self.place_w = (x, y, max(z - DESCENT * self._period, 0.0))

    def command(self, vehicle: BodyState, mass: float) -> tuple[float, ...]:
        """Return the thrust [N] and body rates [rad/s] for a vehicle of a mass [kg] with all that
        hangs on it.
        """
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
        """Note the thrust over the weight of a tick that was flown; None for one that was not."""
        if share is None:
            self._shares.clear()
        else:
            self._shares.append(share)

    def share(self) -> float | None:
        """Return the mean thrust over the weight; None before there is a second of it."""
        return sum(self._shares) / HOVERED if len(self._shares) == HOVERED else None

"""Dead reckoning of a vehicle without poses, until it is level."""

import math
from dataclasses import dataclass

from hil.control.tick.body_estimate import Estimate
from hil.links.backends.base import Command
from hil.poses.body_track import BodyState
from visthrow.common.rotations import plus, rotate_one, turn_one
from visthrow.onboard.hover import GRAVITY

RESPONSE = 0.05  # time constant of the body rates' response to a command [s]
ROUNDING = 1e-6  # tolerance of differences of times [s]


@dataclass
class DeadReckoning:
    """A state estimate that is propagated from the last pose by thrust and body rates."""

    state: BodyState | None = None  # at the last tick; None before the first pose with an attitude
    duration: float = 0.0  # since the last pose [s]
    _arrival: float = 0.0  # of the last pose [s]
    _time: float = 0.0  # of the state [s]
    _reported: tuple[float, ...] | None = None

    def update(
        self, estimate: Estimate, rates: tuple[float, ...] | None, command: Command, mass: float
    ) -> None:
        """Advance to a tick, with the body rates that the autopilot last reported [rad/s], the last
        command [N, rad/s] and the flying mass [kg].
        """
        time = estimate.time
        vehicle = estimate.vehicle
        reported = self._reported
        self._reported = rates
        if vehicle is None or vehicle.quat is None:
            self.state = None
        elif self.state is None or time - vehicle.age > self._arrival + ROUNDING:
            self.state = vehicle
            self.duration = 0.0
            self._arrival = time - vehicle.age
            self._time = time - estimate.shown_age
        else:
            step = time - self._time
            self._time = time
            self.duration += step
            new_rates = rates if rates != reported else None
            self.state = _advance(self.state, step, new_rates, command, mass)


def _advance(
    state: BodyState, step: float, rates: tuple[float, ...] | None, command: Command, mass: float
) -> BodyState:
    """Return the state after a step [s]; without reported rates, body rates follow the command."""
    thrust, *commanded = command
    if rates is None:
        share = 1.0 - math.exp(-step / RESPONSE)
        rates = tuple(rate + share * (new - rate) for rate, new in zip(state.rate, commanded))
    quat = turn_one(state.quat, rates, step)
    force_w = rotate_one(quat, (0.0, 0.0, thrust / mass))
    acceleration_w = (force_w[0], force_w[1], force_w[2] - GRAVITY)
    vel = plus(state.vel, acceleration_w, step)
    pos = plus(state.pos, vel, step)
    return BodyState(pos, quat, vel, rates, state.age + step)

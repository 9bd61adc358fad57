"""Where a payload would land if the latch tripped now, by its own poses: a release that leads
astray is held back.

What comes between now and the landing is not known better than this: until it separates the payload
keeps the velocity that it has, then it flies freely. For right throws of the shipped policies at 2
m that is off by 0.05 to 0.20 m: it tells a throw from none, and from a wild one, but not a good one
from a better one."""

import math
from dataclasses import dataclass
from typing import Any

from hil.poses.pose import Vector
from hil.poses.track import BodyState
from visthrow.config.bounds import Bounded, Positive
from visthrow.onboard.hover import GRAVITY

STEP = 0.01  # step of the free flight's midpoint rule [s]: exact without drag
LONGEST = 3.0  # after which a payload that has not come down is not followed further [s]


@dataclass(frozen=True)
class AimParams(Bounded):
    """Parameters of the check of predicted landings before a release."""

    # a release whose predicted landing is further from the goal than this is held back [m]
    bound: Positive
    # so long after the first one that was held back the throw ends without a release [s]
    patience: Positive


class Aim:
    """Judges the releases that a policy asks for; ``held`` counts those held back so far in this
    run.
    """

    def __init__(
        self, params: AimParams | None, ahead: float, height: float, rope: dict[str, Any]
    ) -> None:
        """Take what the policy was trained with.

        Args:
            params: None holds nothing back. height: of the payload's centre as it lands [m].
            ahead: from the time that a state stands for to separation, if the latch trips now [s].
            rope: of the policy's contract: mass and drag of the payload.
        """
        self._params, self._ahead, self._height = params, ahead, height
        self._drag = rope.get("payload_drag", 0.0) / rope["payload_mass"]
        self.held = 0
        self._first: float | None = None  # that was held back in this throw [s]

    def begin(self) -> None:
        """Begin a throw."""
        self._first = None

    def landing(self, payload: BodyState) -> tuple[float, float]:
        """Return where a payload in this state would land [m], world frame, if the latch tripped
        now.
        """
        vel = payload.vel
        pos = tuple(x + self._ahead * v for x, v in zip(payload.pos, vel))
        time = 0.0
        while time < LONGEST:
            middle = tuple(v + 0.5 * STEP * a for v, a in zip(vel, self._acceleration(vel)))
            after = tuple(x + STEP * v for x, v in zip(pos, middle))
            if after[2] < self._height:
                share = min(max((pos[2] - self._height) / (pos[2] - after[2]), 0.0), 1.0)
                return pos[0] + share * (after[0] - pos[0]), pos[1] + share * (after[1] - pos[1])
            vel = tuple(v + STEP * a for v, a in zip(vel, self._acceleration(middle)))
            pos, time = after, time + STEP
        return pos[0], pos[1]

    def _acceleration(self, vel: Vector) -> Vector:
        drag = -self._drag * math.hypot(*vel)
        return (drag * vel[0], drag * vel[1], drag * vel[2] - GRAVITY)

    def astray(self, now: float, payload: BodyState, goal_w: Vector) -> str | None:
        """Return why a release that was asked for at a time [s] is held back, or None."""
        if self._params is None:
            return None
        x, y = self.landing(payload)
        off = math.hypot(x - goal_w[0], y - goal_w[1])
        if off <= self._params.bound:
            return None
        self.held += 1
        self._first = now if self._first is None else self._first
        return (
            f"it would land at ({x:.2f}, {y:.2f}) m, {off:.2f} m from the goal, within"
            f" {self._params.bound:g} m expected"
        )

    def given_up(self, now: float) -> bool:
        """Return whether this throw is over at a time [s]: nothing better came within the patience
        after what was held back.
        """
        return self._first is not None and now - self._first >= self._params.patience

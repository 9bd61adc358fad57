"""The bodies' states at a tick, passed from step to step."""

from dataclasses import dataclass

from hil.poses.body_track import BodyState
from hil.poses.gate import HOLD
from hil.poses.pose import Vector


@dataclass(frozen=True)
class Estimate:
    """States of the bodies at a tick, world frame; None before the first good pose. Levels are
    those of `hil.poses.gate`.
    """

    time: float  # of the tick [s]
    vehicle: BodyState | None
    payload: BodyState | None
    goal_w: Vector | None  # [m]
    vehicle_level: int
    payload_level: int
    goal_level: int
    shown_age: float  # age of the vehicle's state that the policy gets [s]

    @property
    def is_complete(self) -> bool:
        """Whether all bodies have a state."""
        return None not in (self.vehicle, self.payload, self.goal_w)

    @property
    def has_attitude(self) -> bool:
        """Whether the vehicle's attitude is known."""
        return self.vehicle is not None and self.vehicle.quat is not None

    @property
    def is_flyable(self) -> bool:
        """Whether the vehicle's pose is fresh and has an attitude."""
        return self.has_attitude and self.vehicle_level < HOLD

    @property
    def fresh_payload(self) -> BodyState | None:
        """State of the payload; None if its pose is stale."""
        return self.payload if self.payload_level < HOLD else None

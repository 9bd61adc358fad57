"""One measured pose: what every source hands on and the runner reads.

Plain floats, so that it is recorded exactly.
"""

import math
from dataclasses import dataclass
from typing import Literal

from visthrow.common.rotations import Quaternion as Quaternion
from visthrow.common.rotations import Vector as Vector

Body = Literal["vehicle", "payload", "goal"]
VEHICLE = "vehicle"
PAYLOAD = "payload"
GOAL = "goal"
BODIES = (VEHICLE, PAYLOAD, GOAL)


ZEROS = ([0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
"""Attitudes that captures write for a body that they do not see, sorted: zeros, or no turn."""


def has_attitude(quat: Quaternion | None) -> bool:
    """Return whether an attitude is known: single markers have NaN or zeros there."""
    return quat is not None and not any(map(math.isnan, quat)) and any(quat)


@dataclass(frozen=True)
class Pose:
    """A pose of one body: as its source says it until `hil.poses.frames` has converted it, then in
    our world.
    """

    stamp: float  # on the source's clock [s]
    arrival: float  # on the runner's monotonic clock [s]
    body: str  # of :data:`BODIES`
    pos: Vector  # [m]
    # attitude, body to world, in the order of the source (ours is xyzw); None for a bare marker
    quat: Quaternion | None = None
    vel: Vector | None = None  # [m/s], world frame; None where the source gives none
    rate: Vector | None = None  # [rad/s], body frame; None where the source gives none
    reset: int = 0  # counter of the source's estimator; a change says that it jumped
    measured: float | None = None  # on the runner's clock [s], where the source's clock is known
    valid: bool = True  # False where the source itself says that it does not see the body

    def is_lost(self) -> bool:
        """Return whether a raw pose is that of a body which its source does not see: called so, or
        written as zeros, which no measurement is.
        """
        return not self.valid or (
            not any(self.pos)
            and (self.quat is None or sorted(self.quat) in ZEROS or not has_attitude(self.quat))
        )

    def transit(self, usual: float) -> float:
        """Return the time from measurement to arrival [s]: known, or what is usual."""
        return usual if self.measured is None else self.arrival - self.measured

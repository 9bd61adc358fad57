"""The pose of one body, as sources deliver it to the runner.

It holds plain floats, so that it is recorded exactly.
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
"""Sorted quaternions that motion-capture systems write for a body that they do not see: zeros,
or the identity.
"""


def has_attitude(quat: Quaternion | None) -> bool:
    """Return whether an attitude is known: for single markers it is NaN or zero."""
    return quat is not None and not any(map(math.isnan, quat)) and any(quat)


@dataclass(frozen=True)
class Pose:
    """A pose of one body, in its source's frames until `hil.poses.frames` converts it to ours."""

    stamp: float  # on the source's clock [s]
    arrival: float  # on the runner's monotonic clock [s]
    body: str  # of :data:`BODIES`
    pos: Vector  # [m]
    # attitude, body to world, in the order of the source (ours is xyzw); None for a bare marker
    quat: Quaternion | None = None
    vel: Vector | None = None  # [m/s], world frame; None if the source gives none
    rate: Vector | None = None  # [rad/s], body frame; None if the source gives none
    reset: int = 0  # counter of the source's estimator; it changes when the estimate jumps
    measured: float | None = (
        None  # on the runner's clock [s]; None if the source's clock is unknown
    )
    valid: bool = True  # False if the source reports that it does not see the body

    def is_lost(self) -> bool:
        """Return whether the source does not see the body of a raw pose: it reports so, or
        writes zeros, which no measurement gives.
        """
        return not self.valid or (
            not any(self.pos)
            and (self.quat is None or sorted(self.quat) in ZEROS or not has_attitude(self.quat))
        )

    def transit(self, usual: float) -> float:
        """Return the time from measurement to arrival [s]; ``usual`` if it is unknown."""
        return usual if self.measured is None else self.arrival - self.measured

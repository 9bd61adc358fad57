"""One measured pose: what every source hands on and the runner reads. Plain floats, so that it is recorded exactly."""

from dataclasses import dataclass

from visthrow.common.rotations import Quaternion as Quaternion
from visthrow.common.rotations import Vector as Vector

VEHICLE, PAYLOAD, GOAL = "vehicle", "payload", "goal"
BODIES = (VEHICLE, PAYLOAD, GOAL)


@dataclass(frozen=True)
class Pose:
    """A pose of one body: as its source says it until `hil.poses.frames` has converted it, then in our world.

    Attributes:
        stamp: on the source's clock [s].
        arrival: on the runner's monotonic clock [s].
        body: of :data:`BODIES`.
        pos: [m].
        quat: attitude, body to world, in the order of the source (ours is xyzw); None for a bare marker.
        vel: [m/s], world frame; None where the source gives none.
        rate: [rad/s], body frame; None where the source gives none.
        reset: counter of the source's estimator; a change says that it jumped.
        measured: on the runner's clock [s], where the source's clock is known; else None.
    """

    stamp: float
    arrival: float
    body: str
    pos: Vector
    quat: Quaternion | None = None
    vel: Vector | None = None
    rate: Vector | None = None
    reset: int = 0
    measured: float | None = None

    def transit(self, usual: float) -> float:
        """Time from measurement to arrival [s]: known, or what is usual."""
        return usual if self.measured is None else self.arrival - self.measured

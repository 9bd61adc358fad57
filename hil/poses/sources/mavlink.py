"""Poses from MAVLink messages, over a link or out of a .tlog (see ``hil.poses.sources.player``):
one decoder for both.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from typing import Annotated, Any, Literal

from hil.errors import SourceError
from hil.links.mavlink_link import Link, pose_from_message
from hil.links.roster import MavlinkId
from hil.poses.pose import Body, Pose
from hil.poses.sources.base import Source
from visthrow.config.bounds import Bound, Bounded

COMPANIONS = {"LOCAL_POSITION_NED": ("LOCAL_POSITION_NED", "ATTITUDE_QUATERNION")}
"""Messages that make up a pose, where it is more than one."""

# an attitude older than this against the position that it is to be paired with is none [s]
PAIR_AGE = 0.05


@dataclass(frozen=True)
class BodyIds(Bounded):
    """Which sender speaks of which body, and in which message."""

    body: Body
    # LOCAL_POSITION_NED is paired with ATTITUDE_QUATERNION.
    message: Literal["ATT_POS_MOCAP", "VISION_POSITION_ESTIMATE", "ODOMETRY", "LOCAL_POSITION_NED"]
    system: MavlinkId
    component: Annotated[int, Bound(0, 255)]  # 0 for any


class MavlinkDecoder:
    """Messages to poses; bodies told apart by their senders."""

    def __init__(self, bodies: tuple[BodyIds, ...]) -> None:
        """Take the senders; raises `SourceError` for none, or the same sender and message for two
        bodies.
        """
        keys = [(ids.message, ids.system, ids.component) for ids in bodies]
        if not bodies or any(
            a[:2] == b[:2] and (a[2] == b[2] or 0 in (a[2], b[2])) for a, b in combinations(keys, 2)
        ):
            raise SourceError(
                f"senders {keys}; expected at least one, and no two bodies with the same message,"
                " system and component"
            )
        self._bodies = bodies
        self._attitudes: dict[tuple[int, int], Any] = {}

    def feed(self, message: Any, arrival: float) -> Pose | None:
        """Return the pose in a message, if it is one of ours."""
        kind, sender = message.get_type(), (message.get_srcSystem(), message.get_srcComponent())
        if kind == "ATTITUDE_QUATERNION":
            self._attitudes[sender] = message
            return None
        for ids in self._bodies:
            if ids.message == kind and ids.system == sender[0] and ids.component in (0, sender[1]):
                paired = kind == "LOCAL_POSITION_NED"
                return (
                    self._paired(message, sender, ids.body, arrival)
                    if paired
                    else pose_from_message(message, ids.body, arrival)
                )
        return None

    def _paired(
        self, message: Any, sender: tuple[int, int], body: str, arrival: float
    ) -> Pose | None:
        attitude = self._attitudes.get(sender)
        if attitude is None or abs(message.time_boot_ms - attitude.time_boot_ms) > 1e3 * PAIR_AGE:
            return None
        return Pose(
            message.time_boot_ms / 1e3,
            arrival,
            body,
            (message.x, message.y, message.z),
            (attitude.q1, attitude.q2, attitude.q3, attitude.q4),
            (message.vx, message.vy, message.vz),
            (attitude.rollspeed, attitude.pitchspeed, attitude.yawspeed),
        )


class MavlinkSource(Source):
    """Poses of a link.

    Polling it also serves the link's other listeners, and the autopilot's link where that is
    another one.
    """

    def __init__(
        self,
        link: Link,
        bodies: tuple[BodyIds, ...],
        clock: Callable[[], float],
        beside: Link | None = None,
    ) -> None:
        """Listen to a link; ``clock`` gives the arrivals. ``beside`` is another link to serve."""
        super().__init__((link,) if beside is None else (link, beside), clock)
        self._link, self._decoder = link, MavlinkDecoder(bodies)
        self._waiting: list[Pose] = []
        link.listen(self._hear)

    def _hear(self, message: Any, arrival: float) -> None:
        pose = self._decoder.feed(message, arrival)
        if pose is not None:
            sync = self._link.sync
            self._waiting.append(
                pose if sync is None else sync.dated(pose, message.get_srcSystem())
            )

    def poll(self, now: float) -> list[Pose]:
        self.pump()
        poses, self._waiting = self._waiting, []
        return poses

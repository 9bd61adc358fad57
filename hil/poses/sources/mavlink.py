"""Poses from MAVLink messages of a link or a .tlog (see ``hil.poses.sources.player``), with one
decoder for both.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from typing import Annotated, Any, Literal

from hil.errors import SourceError
from hil.links.mavlink_link import (
    LOCAL_FRAMES,
    Link,
    pose_from_message,
    quaternion_from_euler,
)
from hil.links.pymav import mav
from hil.links.roster import Address, MavlinkId, Traffic
from hil.poses.pose import Body, Pose
from hil.poses.sources.pose_source import Source
from visthrow.config.bounds import Bound, Bounded

ATTITUDES = ("ATTITUDE_QUATERNION", "ATTITUDE")
COMPANIONS = {"LOCAL_POSITION_NED": ("LOCAL_POSITION_NED", *ATTITUDES)}
"""Messages that form a pose together, if it needs more than one."""

Drop = Callable[[Any, str], None]
"""Function that receives a body's message that is not a pose, and the reason."""

# largest age of an attitude that is paired with a position [s]
PAIR_AGE = 0.05


@dataclass(frozen=True)
class BodyIds(Bounded):
    """The sender and the message of one body's poses."""

    body: Body
    # LOCAL_POSITION_NED is paired with ATTITUDE_QUATERNION or ATTITUDE.
    message: Literal["ATT_POS_MOCAP", "VISION_POSITION_ESTIMATE", "ODOMETRY", "LOCAL_POSITION_NED"]
    system: MavlinkId
    component: Annotated[int, Bound(0, 255)]  # 0 for any


class MavlinkDecoder:
    """A decoder of MAVLink messages to poses; senders identify the bodies."""

    def __init__(self, bodies: tuple[BodyIds, ...], drop: Drop = lambda message, why: None):
        """Take the senders; raises `SourceError` for none, or the same sender and message for two
        bodies. ``drop`` is called for what is a body's and no pose.
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
        self._drop = drop
        self._attitudes: dict[tuple[int, int], Any] = {}

    def feed(self, message: Any, arrival: float) -> Pose | None:
        """Return the pose in a message, if it is one of ours."""
        kind = message.get_type()
        sender = (message.get_srcSystem(), message.get_srcComponent())
        if kind in ATTITUDES:
            self._attitudes[sender] = message
            return None
        for ids in self._bodies:
            if ids.message == kind and ids.system == sender[0] and ids.component in (0, sender[1]):
                paired = kind == "LOCAL_POSITION_NED"
                pose = (
                    self._pair(message, sender, ids.body, arrival)
                    if paired
                    else pose_from_message(message, ids.body, arrival)
                )
                if pose is None:
                    self._drop(message, self._objection(message, paired))
                return pose
        return None

    def _objection(self, message: Any, paired: bool) -> str:
        """Return why a body's message is not a pose."""
        if paired:
            return f"no {' or '.join(ATTITUDES)} within {1e3 * PAIR_AGE:g} ms of it"
        accepted = " or ".join(map(frame_name, LOCAL_FRAMES))
        return f"frame {frame_name(message.frame_id)} is not taken; expected {accepted}"

    def _pair(
        self, message: Any, sender: tuple[int, int], body: str, arrival: float
    ) -> Pose | None:
        attitude = self._attitudes.get(sender)
        if attitude is None or abs(message.time_boot_ms - attitude.time_boot_ms) > 1e3 * PAIR_AGE:
            return None
        if attitude.get_type() == "ATTITUDE":
            quat = quaternion_from_euler(attitude.roll, attitude.pitch, attitude.yaw)
        else:
            quat = (attitude.q1, attitude.q2, attitude.q3, attitude.q4)
        return Pose(
            message.time_boot_ms / 1e3,
            arrival,
            body,
            (message.x, message.y, message.z),
            quat,
            (message.vx, message.vy, message.vz),
            (attitude.rollspeed, attitude.pitchspeed, attitude.yawspeed),
        )


FORMER_FRAMES = dict(enumerate(["MOCAP_NED", "MOCAP_ENU", "VISION_NED", "VISION_ENU"], start=14))
"""MAV_FRAMEs from before 2019, which MAVLink now reserves."""


def frame_name(number: int) -> str:
    """Return the name of a MAV_FRAME."""
    entry = mav.enums["MAV_FRAME"].get(number)
    name = str(number) if entry is None else entry.name.removeprefix("MAV_FRAME_")
    return FORMER_FRAMES.get(number, name)


def traffic_of(message: Any, address: Address, why: str) -> Traffic:
    """Return the key by which a refused message is counted."""
    ids = message.get_srcSystem(), message.get_srcComponent()
    return Traffic(address, *ids, message.get_type(), why)


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
        autopilot_link: Link | None = None,
    ):
        """Listen to a link, and serve the autopilot's too; ``clock`` gives the arrivals."""
        super().__init__((link,) if autopilot_link is None else (link, autopilot_link), clock)
        self._link, self._decoder = link, MavlinkDecoder(bodies, self._drop)
        self._waiting: list[Pose] = []
        link.listen(self._hear)

    def _hear(self, message: Any, arrival: float) -> None:
        pose = self._decoder.feed(message, arrival)
        if pose is not None:
            sync = self._link.sync
            self._waiting.append(
                pose if sync is None else sync.date_pose(pose, message.get_srcSystem())
            )

    def _drop(self, message: Any, why: str) -> None:
        self._link.roster.refuse(traffic_of(message, self._link.sender, why))

    def poll(self, time: float) -> list[Pose]:
        self.pump()
        poses = self._waiting
        self._waiting = []
        return poses

"""The MAVLink link: datagrams in, messages to whoever listens, messages out, both ways into a
.tlog; TIMESYNC on it, both ways.

Nothing here waits, and no bytes that arrive make it raise. :func:`poses_from_message` and
:func:`attitude_target` are the boundary between MAVLink's units and orders and ours."""

import math
import random
import struct
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from hil.links.clock import TimeSync
from hil.links.device import Port, chunks
from hil.links.pymav import Parser, Signed, mav
from hil.links.roster import Address, Roster, Traffic, address_text
from hil.links.writer import TlogWriter
from hil.poses.pose import Pose, Quaternion, Vector, has_attitude
from visthrow.common.rotations import quat_of_euler, rotate_one

LOCAL_FRAMES = (mav.MAV_FRAME_LOCAL_NED, mav.MAV_FRAME_LOCAL_FRD)
BODY_FRAMES = (mav.MAV_FRAME_BODY_FRD, mav.MAV_FRAME_BODY_NED)
POSE_MESSAGES = ("ATT_POS_MOCAP", "VISION_POSITION_ESTIMATE", "ODOMETRY")
NAN_QUATERNION = (math.nan,) * 4

# type_mask of SET_ATTITUDE_TARGET: rates and thrust, no attitude. Other bits beside it are silently
# not followed
IGNORE_ATTITUDE = mav.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE
OUR_SYSTEM = 245
OUR_COMPONENT = mav.MAV_COMP_ID_ONBOARD_COMPUTER
COMMAND_VALUES = 7  # of COMMAND_LONG
# where system and component stand in a message's bytes
IDS = {mav.PROTOCOL_MARKER_V1: slice(3, 5), mav.PROTOCOL_MARKER_V2: slice(5, 7)}
MOST_PENDING = 50  # questions for a time whose answer may still come


class Link:
    """The MAVLink peers of a port.

    Attributes:
        received, sent, dropped: messages that were taken in, went, and could not be sent.
        parser: counts what was no message. roster: who may speak.
        sender: address of the message that listeners are called with.
        on_pump: called with the time [s] whenever arrivals were taken in. sync:
            `hil.links.mavlink_link.LinkSync`, where there is one.
    """

    def __init__(
        self,
        port: Port,
        system: int = OUR_SYSTEM,
        component: int = OUR_COMPONENT,
        tlog: TlogWriter | None = None,
        roster: Roster | None = None,
        key: bytes | None = None,
    ):
        """Wrap an open port.

        Args:
            port: see `hil.links.device`. system, component: our own ids; component 191 is an
                onboard computer.
            tlog: written both ways; closed with the link. roster: who may speak; None takes
                anybody.
            key: that messages are signed with, and have to be; None: neither.
        """
        self.port = port
        self.roster = roster or Roster()
        self._tlog = tlog
        self.roster.only = port.peer
        self._key = key
        streams = {}
        self.parser = Parser() if key is None else Parser(lambda: Signed(key, streams=streams))
        self._mav = self.packer(system, component)
        self._listeners: list[Callable[[Any, float], None]] = []
        self.on_pump: list[Callable[[float], None]] = []
        self.sync: Any = None
        self.sender: Address = None
        self.received = self.sent = self.dropped = 0

    def packer(self, system: int, component: int) -> mav.MAVLink:
        """Return what packs messages of ids of their own for this link, signed where it is."""
        return (
            mav.MAVLink(None, system, component)
            if self._key is None
            else Signed(self._key, system, component)
        )

    def listen(self, listener: Callable[[Any, float], None]) -> None:
        """Call ``listener(message, arrival)`` for every message from now on."""
        self._listeners.append(listener)

    def pump(self, clock: Callable[[], float]) -> int:
        """Hand all that has arrived to the listeners; returns 0 where nothing has."""
        looked = 0
        refused = self.roster.refused
        for data in chunks(self.port, self.roster.shuts_out):
            self.sender = self.port.sender
            looked += 1
            self.received += self._take(data, clock())
        for call in self.on_pump:
            call(clock())
        return looked + self.roster.refused - refused

    def _take(self, data: bytes, arrival: float) -> int:
        """Hand on the messages in a chunk that are of our parties; returns their number."""
        parser = self.parser
        count = 0
        errors = parser.errors
        messages = parser.parse(data, self.port.whole)
        if parser.errors > errors and not parser.forged:
            self.roster.drop(self.sender, "bytes", "no MAVLink message")
        for message in messages:
            if not self.roster.admit(message, self.sender, arrival):
                continue
            if self._tlog is not None:
                self._tlog.write(message)
            for listener in self._listeners:
                listener(message, arrival)
            count += 1
        for forged in parser.forged:
            ids = forged[IDS[forged[0]]]
            self.roster.refuse(Traffic(self.sender, *ids, "message", "no valid signature"))
        return count

    def send(self, message: Any, address: Address = None) -> bool:
        """Send a message, to one address or to the autopilot's where it names a target, else to all
        parties'; whether the port took it.
        """
        try:
            if isinstance(self._mav, Signed):
                self._mav.touch()
            data = message.pack(self._mav)
        except (struct.error, TypeError, ValueError, OverflowError):
            self.dropped += 1
            return False
        self._mav.seq = (self._mav.seq + 1) % 256
        addresses = (address,) if address is not None else self.roster.addresses(message) or (None,)
        taken = all([self.port.write(data, address) for address in addresses])
        if taken and self._tlog is not None:
            self._tlog.write(message)
        self.sent += taken
        self.dropped += not taken
        return taken

    def close(self) -> None:
        """Close port and .tlog."""
        self.port.close()
        if self._tlog is not None:
            self._tlog.close()


def quaternion_from_euler(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the attitude wxyz of MAVLink's angles (yaw, then pitch, then roll) [rad]; NaN where
    one is not finite.
    """
    if not (math.isfinite(roll) and math.isfinite(pitch) and math.isfinite(yaw)):
        return NAN_QUATERNION
    x, y, z, w = quat_of_euler(roll, pitch, yaw)
    return (w, x, y, z)


def pose_from_message(message: Any, body: str, arrival: float) -> Pose | None:
    """Return a body's pose in SI units, still in MAVLink's frames: world north east down or the
    like, quaternion wxyz.

    None for what is no ATT_POS_MOCAP, VISION_POSITION_ESTIMATE or ODOMETRY, and for an ODOMETRY in
    another frame than LOCAL_NED or LOCAL_FRD."""
    kind = message.get_type()
    if kind not in POSE_MESSAGES:
        return None
    pos = (message.x, message.y, message.z)
    if kind == "ATT_POS_MOCAP":
        return Pose(message.time_usec / 1e6, arrival, body, pos, tuple(message.q))
    if kind == "VISION_POSITION_ESTIMATE":
        quat = quaternion_from_euler(message.roll, message.pitch, message.yaw)
        return Pose(message.usec / 1e6, arrival, body, pos, quat, reset=message.reset_counter)
    if message.frame_id not in LOCAL_FRAMES:
        return None
    quat = tuple(message.q)
    vel = _vector_or_none((message.vx, message.vy, message.vz))
    if vel is not None and message.child_frame_id in BODY_FRAMES:
        vel = rotate_one((*quat[1:], quat[0]), vel) if has_attitude(quat) else None
    elif message.child_frame_id not in LOCAL_FRAMES:
        vel = None
    rate = _vector_or_none((message.rollspeed, message.pitchspeed, message.yawspeed))
    return Pose(
        message.time_usec / 1e6,
        arrival,
        body,
        pos,
        quat,
        vel,
        rate,
        message.reset_counter,
        valid=message.quality >= 0,  # negative: its estimator has failed
    )


def _vector_or_none(vector: Vector) -> Vector | None:
    """Return a vector; None for NaN, which MAVLink writes for a quantity that is not known."""
    return None if any(math.isnan(x) for x in vector) else vector


def attitude_target(time_s: float, target: tuple[int, int], thrust: float, rate_frd: Vector) -> Any:
    """Return SET_ATTITUDE_TARGET at a time [s]: collective thrust, 0 to 1, body rates forward,
    right, down [rad/s].
    """
    stamp = int(time_s * 1e3) & 0xFFFFFFFF
    return mav.MAVLink_set_attitude_target_message(
        stamp, *target, IGNORE_ATTITUDE, [1.0, 0.0, 0.0, 0.0], *rate_frd, thrust
    )


def command_long(target: tuple[int, int], number: int, *values: float, repetition: int = 0) -> Any:
    """Return COMMAND_LONG; parameters that are left out are 0."""
    seven = [*map(float, values), *([0.0] * (COMMAND_VALUES - len(values)))]
    return mav.MAVLink_command_long_message(*target, number, min(repetition, 255), *seven)


def parameter_request(target: tuple[int, int], name: str) -> Any:
    """Return PARAM_REQUEST_READ of a parameter."""
    return mav.MAVLink_param_request_read_message(*target, name.encode(), -1)


ASK_EVERY = (0.05, 0.15)
"""Between two questions [s], drawn anew for each: a peer that works in periods of its own answers a
question that comes at the same point of its period always with the same delay, which no shortest
round trip would betray.
"""

EARLY = 0.005
LATE = 0.2
"""A pose that seems to arrive earlier than it was measured by more than this, or later by more,
bears another clock [s].
"""


class LinkSync:
    """Keeps the clocks of all peers of a link, by MAVLink system and address: two senders of one
    system may have two clocks. ``foreign`` counts poses whose stamps are not of their sender's
    TIMESYNC clock.
    """

    def __init__(self, link: Link):
        self._link = link
        self._asked = -1e9
        self._pause = 0.0
        self._random = random.Random(0)
        self.peers: dict[tuple[int, Address], TimeSync] = {}
        self._pending: list[int] = []
        self.foreign = 0
        link.listen(self._hear)
        link.on_pump.append(self.service)
        link.sync = self

    def service(self, host_time: float) -> None:
        """Ask where it is time; nobody is asked before anybody was heard."""
        if self._link.received and host_time - self._asked >= self._pause:
            self._asked, self._pause = host_time, self._random.uniform(*ASK_EVERY)
            stamp = TimeSync.stamp(host_time)
            self._pending = [*self._pending[-MOST_PENDING:], stamp]
            self._link.send(mav.MAVLink_timesync_message(0, stamp))

    def _hear(self, message: Any, arrival: float) -> None:
        if message.get_type() != "TIMESYNC":
            return
        if message.tc1 == 0:
            self._link.send(
                mav.MAVLink_timesync_message(TimeSync.stamp(arrival), message.ts1),
                self._link.sender,
            )
        elif message.ts1 in self._pending:
            peer = self.peers.setdefault((message.get_srcSystem(), self._link.sender), TimeSync())
            peer.take(message.tc1, message.ts1, arrival)

    def date_pose(self, pose: Pose, system: int) -> Pose:
        """Return a pose of the message just handed on, dated on our clock where its sender's is
        known and the stamp is of it.
        """
        peer = self.peers.get((system, self._link.sender))
        if peer is None or peer.offset is None:
            return pose
        measured = pose.stamp - peer.offset
        if not -EARLY <= pose.arrival - measured <= LATE:
            self.foreign += 1
            return pose
        return replace(pose, measured=min(measured, pose.arrival))

    def summary(self) -> dict[str, Any]:
        """Return offsets and round trips [s] by system and address."""
        return {
            "peers": {
                f"{system} at {address_text(address)}": {
                    "offset": peer.offset,
                    "round_trip": peer.round_trip,
                    "steps": peer.steps,
                }
                for (system, address), peer in self.peers.items()
            },
            "foreign_stamps": self.foreign,
        }

"""The MAVLink link: it passes received messages to listeners, sends messages, records both in a
.tlog, and exchanges TIMESYNC.

No call waits, and received bytes never make it raise. :func:`pose_from_message` and
:func:`attitude_target` convert between MAVLink's units and conventions and ours."""

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

# type_mask of SET_ATTITUDE_TARGET: rates and thrust, no attitude. With further bits set, autopilots
# silently ignore the message
IGNORE_ATTITUDE = mav.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE
OUR_SYSTEM = 245
OUR_COMPONENT = mav.MAV_COMP_ID_ONBOARD_COMPUTER
COMMAND_VALUES = 7  # of COMMAND_LONG
# positions of system and component in a message's bytes
IDS = {mav.PROTOCOL_MARKER_V1: slice(3, 5), mav.PROTOCOL_MARKER_V2: slice(5, 7)}
MOST_PENDING = 50  # most TIMESYNC requests that wait for an answer


class Link:
    """The MAVLink peers of a port.

    Attributes:
        received, sent, dropped: numbers of messages accepted, sent, and not sent because of an
            error.
        parser: counts invalid messages. roster: who may send.
        sender: address of the message that listeners are processing.
        on_pump: called with the time [s] after arrivals were processed. sync:
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
            tlog: records both directions; closed with the link. roster: who may send; None:
                anybody.
            key: with which sent messages are signed and received ones must be; None: no signatures.
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
        """Return an encoder of messages with the given ids for this link, with signatures if the
        link has a key.
        """
        return (
            mav.MAVLink(None, system, component)
            if self._key is None
            else Signed(self._key, system, component)
        )

    def listen(self, listener: Callable[[Any, float], None]) -> None:
        """Call ``listener(message, arrival)`` for every message from now on."""
        self._listeners.append(listener)

    def pump(self, clock: Callable[[], float]) -> int:
        """Pass all arrivals to the listeners; return 0 if nothing has arrived."""
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
        """Pass the accepted messages in a chunk to the listeners; return their number."""
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
        """Send a message to an address; without one, to the autopilot if the message names a
        target, else to all parties. Return whether the port accepted it.
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
    """Return the attitude wxyz for MAVLink's angles (yaw, then pitch, then roll) [rad]; NaN if
    one is not finite.
    """
    if not (math.isfinite(roll) and math.isfinite(pitch) and math.isfinite(yaw)):
        return NAN_QUATERNION
    x, y, z, w = quat_of_euler(roll, pitch, yaw)
    return (w, x, y, z)


def pose_from_message(message: Any, body: str, arrival: float) -> Pose | None:
    """Return a body's pose in SI units, still in the sender's frames (such as north, east, down),
    quaternion wxyz.

    None for messages other than ATT_POS_MOCAP, VISION_POSITION_ESTIMATE and ODOMETRY, and for
    ODOMETRY in a frame other than LOCAL_NED and LOCAL_FRD."""
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
    """Return a vector; None if it has a NaN, which MAVLink uses for unknown quantities."""
    return None if any(math.isnan(x) for x in vector) else vector


def attitude_target(time_s: float, target: tuple[int, int], thrust: float, rate_frd: Vector) -> Any:
    """Return SET_ATTITUDE_TARGET at a time [s] with collective thrust, 0 to 1, and body rates
    forward, right, down [rad/s].
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
"""Range of the random time between two requests [s]. A periodic peer answers requests at one
phase of its period always with the same delay, which the shortest round trip would not reveal.
"""

EARLY = 0.005
LATE = 0.2
"""Limits of a pose's delay: if it seems to arrive before its measurement by more than ``EARLY``,
or after it by more than ``LATE``, its stamp is of another clock [s].
"""


class LinkSync:
    """Synchronises with the clocks of all peers of a link, by MAVLink system and address,
    because two senders of one system may have different clocks. ``foreign`` counts poses whose
    stamps are not of their sender's TIMESYNC clock.
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
        """Send a TIMESYNC request when it is due, but none before the first message has arrived."""
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
        """Return a pose from the current message with its time of measurement on our clock, if
        the sender's clock is known and the stamp is of that clock.
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

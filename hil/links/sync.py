"""TIMESYNC on a link, both ways: peers are answered and asked, and poses are dated by their senders' clocks."""

import random
from dataclasses import replace
from typing import Any

from hil.links.clock import TimeSync
from hil.links.mavlink_link import Link
from hil.links.pymav import mav
from hil.links.roster import Address, shown
from hil.poses.pose import Pose

ASK_EVERY = (0.05, 0.15)
"""Between two questions [s], drawn anew for each: a peer that works in periods of its own answers a question that comes at the same
point of its period always with the same delay, which no shortest round trip would betray."""

EARLY, LATE = 0.005, 0.2
"""A pose that seems to arrive earlier than it was measured by more than this, or later by more, bears another clock [s]."""


class LinkSync:
    """Keeps the clocks of all peers of a link, by MAVLink system and address: two senders of one system may have two clocks.

    ``foreign`` counts poses whose stamps are not of their sender's TIMESYNC clock.
    """

    def __init__(self, link: Link) -> None:
        """Listen to a link, and ask from its pump."""
        self._link = link
        self._asked, self._pause, self._random = -1e9, 0.0, random.Random(0)
        self.peers: dict[tuple[int, Address], TimeSync] = {}
        self._pending: list[int] = []
        self.foreign = 0
        link.listen(self._hear)
        link.on_pump.append(self.service)
        link.sync = self

    def service(self, now: float) -> None:
        """Ask where it is time; nobody is asked before anybody was heard."""
        if self._link.received and now - self._asked >= self._pause:
            self._asked, self._pause = now, self._random.uniform(*ASK_EVERY)
            stamp = TimeSync.stamp(now)
            self._pending = [*self._pending[-50:], stamp]
            self._link.send(mav.MAVLink_timesync_message(0, stamp))

    def _hear(self, message: Any, arrival: float) -> None:
        if message.get_type() != "TIMESYNC":
            return
        if message.tc1 == 0:
            self._link.send(mav.MAVLink_timesync_message(TimeSync.stamp(arrival), message.ts1), self._link.sender)
        elif message.ts1 in self._pending:
            peer = self.peers.setdefault((message.get_srcSystem(), self._link.sender), TimeSync())
            peer.take(message.tc1, message.ts1, arrival)

    def dated(self, pose: Pose, system: int) -> Pose:
        """Return a pose of the message just handed on, dated on our clock where its sender's is known and the stamp is of it."""
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
                f"{system} at {shown(address)}": {"offset": peer.offset, "round_trip": peer.round_trip, "steps": peer.steps}
                for (system, address), peer in self.peers.items()
            },
            "foreign_stamps": self.foreign,
        }

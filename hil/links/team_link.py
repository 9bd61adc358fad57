"""Agreement of a team's vehicles on a throw, by datagrams between their runners.

All runners share a clock and tick at multiples of the period. In each tick a runner sends what it
is ready for: nothing, a throw, or the release. The minimum of what all were ready for ``delay``
ticks ago is agreed, so that all act in the same tick. A late or lost message counts as "nothing". A
release cannot be taken back: its runner keeps sending it, so a member that missed one message
follows in the next tick."""

import struct
from dataclasses import dataclass, field
from typing import Annotated

from hil.errors import ConfigError
from hil.links.device import check_device, chunks, open_port
from visthrow.config.bounds import Bound, Bounded

NOTHING, THROW, RELEASE = range(3)
"""States of readiness of a vehicle."""

MESSAGE = struct.Struct("<4sBq")
"""Format of a message: mark, readiness of the sender, number of the tick."""
MARK = b"VTC2"
WINDOW = 25  # most ticks by which a message may be off; a runner with another clock is ignored
ROUNDING = 1e-3  # of a tick's time [ticks]


@dataclass(frozen=True)
class TeamLinkParams(Bounded):
    """A team whose runners agree on each throw."""

    member: Annotated[int, Bound(0)]  # index of this vehicle in ``members``
    members: tuple[str, ...]  # ADDRESS:PORT of each vehicle's runner, including this one
    delay: Annotated[int, Bound(1)] = 1  # age of the messages that count [ticks]

    def __post_init__(self) -> None:
        super().__post_init__()
        count = len(self.members)
        if not (self.member < count == len(set(self.members)) > 1):
            raise ConfigError(
                f"team: member {self.member} of {', '.join(self.members) or 'nobody'}; expected two"
                " different addresses or more, and the place of one, from 0"
            )


@dataclass
class Agreement:
    """The readiness of a team's members, by tick."""

    member: int  # this one
    team: int
    delay: int = 1  # [ticks]
    _now: int = 0
    _words: dict[int, dict[int, int]] = field(default_factory=dict)  # by tick and member

    def begin(self, tick: int) -> None:
        """Begin a tick; delete outdated messages."""
        self._now = tick
        self._words = {k: v for k, v in self._words.items() if k >= tick - self.delay}

    def say(self, ready: int) -> bytes:
        """Record what this vehicle is ready for in this tick; return the message to the others."""
        self._note(self._now, self.member, ready)
        return MESSAGE.pack(MARK, ready, self._now)

    def receive(self, datagram: bytes, member: int) -> bool:
        """Record another member's message; return whether it is valid. The first message for a
        tick counts.
        """
        if len(datagram) != MESSAGE.size:
            return False
        mark, ready, tick = MESSAGE.unpack(datagram)
        if mark != MARK or ready > RELEASE or abs(tick - self._now) > WINDOW:
            return False
        self._note(tick, member, ready)
        return True

    @property
    def agreed(self) -> int:
        """Readiness that all members share for this tick."""
        words = self._words.get(self._now - self.delay, {})
        return min(words.values()) if len(words) == self.team else NOTHING

    def _note(self, tick: int, member: int, ready: int) -> None:
        self._words.setdefault(tick, {}).setdefault(member, ready)


class TeamLink:
    """The UDP link to the other members; other senders are ignored.

    Attributes:
        offset: of the team's clock from the runner's [s].
    """

    def __init__(
        self, params: TeamLinkParams, period: float, offset: float = 0.0, remote: bool = False
    ):
        """Listen at this member's address; ``period``: of the ticks [s].

        Raises LinkError: an address is invalid, in use, or on another machine without ``remote``.
        """
        devices = [check_device(f"udp:{text}", remote=remote) for text in params.members]
        self.offset = offset
        self._period = period
        self._agreement = Agreement(params.member, len(devices), params.delay)
        self._port = open_port(devices[params.member], "team.members in every config")
        members = {(device.host, device.port): k for k, device in enumerate(devices)}
        self._others = {address: k for address, k in members.items() if k != params.member}

    def agree(self, time: float) -> int:
        """Read the received messages; return what all agreed on for the tick at a time [s]."""
        self._agreement.begin(int((time + self.offset) / self._period + ROUNDING))
        for datagram in chunks(self._port, lambda sender: sender not in self._others):
            self._agreement.receive(datagram, self._others[self._port.sender])
        return self._agreement.agreed

    def say(self, ready: int) -> None:
        """Tell the others what this vehicle is ready for in this tick."""
        message = self._agreement.say(ready)
        for address in self._others:
            self._port.write(message, address)

    def close(self) -> None:
        """Close the port."""
        self._port.close()

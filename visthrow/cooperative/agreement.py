"""A release that needs every vehicle, agreed on by datagrams between the runners of a team.

All runners have one clock and step at the same instants. Each sends what its policy asks for in a
step; a latch trips in the step ``delay`` later where every member asked, so that all trip together.
A message that comes later than that, or never, is a no: then no latch trips. Onboard-safe."""

import socket
import struct
from dataclasses import dataclass, field

from visthrow.common.errors import VisthrowError

MESSAGE = struct.Struct("<4sBBq")
"""Mark, member, whether it asks, step."""
MARK = b"VTC1"


@dataclass
class Agreement:
    """Requests of the members of a team, step by step.

    Attributes:
        member, team: this vehicle's number, and how many there are.
        delay: age of the requests that count [control steps], at least 1.
    """

    member: int
    team: int
    delay: int = 1
    _requests: dict[int, dict[int, bool]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (0 <= self.member < self.team and self.delay >= 1):
            raise VisthrowError(
                f"member {self.member} of {self.team} with a delay of {self.delay}; expected a"
                " member below the team's size and a delay of 1 or more"
            )

    def ask(self, step: int, release: bool) -> bytes:
        """Take down this vehicle's own request of a step; returns the message for the others."""
        self._take(step, self.member, release)
        return MESSAGE.pack(MARK, self.member, release, step)

    def receive(self, datagram: bytes) -> bool:
        """Take down another's request; returns whether it was one of this team's.

        The first word of a member on a step counts.
        """
        if len(datagram) != MESSAGE.size:
            return False
        mark, member, release, step = MESSAGE.unpack(datagram)
        if mark != MARK or member >= self.team or member == self.member or release > 1:
            return False
        self._take(step, member, bool(release))
        return True

    def trips(self, step: int) -> bool:
        """Whether the latch trips in this step; earlier steps are forgotten."""
        due = step - self.delay
        requests = self._requests.get(due, {})
        self._requests = {k: v for k, v in self._requests.items() if k >= due}
        return len(requests) == self.team and all(requests.values())

    def _take(self, step: int, member: int, release: bool) -> None:
        self._requests.setdefault(step, {}).setdefault(member, release)


class TeamLink:
    """Datagrams to and from the other members, over UDP.

    Others than the named addresses are not listened to.
    """

    def __init__(self, agreement: Agreement, address: tuple[str, int], members: list[tuple]):
        """Bind to an address; ``members``: those of the others."""
        self.agreement, self._members = agreement, members
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(address)
        self._socket.setblocking(False)

    @property
    def address(self) -> tuple[str, int]:
        """Host and port that it is bound to."""
        host, port = self._socket.getsockname()
        return host, port

    def step(self, step: int, release: bool) -> bool:
        """Send this vehicle's request of a step, read what came; whether the latch trips now."""
        message = self.agreement.ask(step, release)
        for member in self._members:
            self._socket.sendto(message, member)
        while True:
            try:
                datagram, sender = self._socket.recvfrom(64)
            except BlockingIOError:
                break
            if sender in self._members:
                self.agreement.receive(datagram)
        return self.agreement.trips(step)

    def close(self) -> None:
        """Give the port back."""
        self._socket.close()

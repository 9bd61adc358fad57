"""Access control of a link: each party is bound to the ids in the config and to the address of its
first valid message.

A party is the source of a body's poses or the autopilot. Messages with unknown ids, from another
address than their party's, or from an autopilot of another type are refused, counted, and reported
once for each sender. On the ground a silent party may return from another address (a restarted
bridge); in flight it may not."""

import ipaddress
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Annotated, Any

from hil.errors import LinkError
from hil.links.pymav import mav
from visthrow.config.bounds import Bound

MavlinkId = Annotated[int, Bound(1, 255)]

# function that shows lines to the operator and never waits; None: nobody reads them
Announce = Callable[[str], None] | None

# address of a datagram's sender; None on a stream, which has one peer
Address = tuple[str, int] | None

# silence after which a party may return from another address on the ground [s]: longer than the
# heartbeat's period
SILENT = 1.5
# most combinations of sender and kind that are counted separately; others are counted together
MOST_KEPT = 256
MOST_SAID = 20  # most senders that are reported during a run; the summary has the others
# reason to refuse a party's message that arrives before its identifying one
NOT_YET = "before its first"
# messages that every party may send: its clock, and whether it is simulated
SHARED = frozenset({"TIMESYNC", "NAMED_VALUE_INT"})
SIMULATED = "SIMULATED"  # NAMED_VALUE_INT by which a fake states that nothing real flies


@dataclass(frozen=True)
class Party:
    """A sender that the config expects."""

    name: str  # of a body, or "autopilot"
    system: int  # MAVLink id
    component: int  # MAVLink id; 0 for any
    # its kinds of messages; empty: all that belong to no other party
    kinds: frozenset[str] = frozenset()
    autopilot: int | None = None  # MAV_AUTOPILOT that its HEARTBEAT must state

    def has(self, system: int, component: int) -> bool:
        """Return whether MAVLink ids belong to the party."""
        return self.system == system and self.component in (0, component)


@dataclass(frozen=True)
class Traffic:
    """Messages of one kind from one sender."""

    address: Address
    system: int | None
    component: int | None
    kind: str
    why: str = ""  # reason of the refusal; empty if accepted

    def text(self) -> str:
        """Return a description."""
        ids = "" if self.system is None else f" of system {self.system}, component {self.component}"
        return f"{self.kind}{ids} from {address_text(self.address)}" + (
            f": {self.why}" if self.why else ""
        )


OTHER_TRAFFIC = Traffic(None, None, None, "others")


def address_text(address: Address) -> str:
    """Return an address as text."""
    if address is None:
        return "the link's peer"
    if not address[1]:
        return address[0]
    return f"[{address[0]}]:{address[1]}" if ":" in address[0] else f"{address[0]}:{address[1]}"


def autopilot_name(number: int) -> str:
    """Return the name of a MAV_AUTOPILOT."""
    entry = mav.enums["MAV_AUTOPILOT"].get(number)
    return str(number) if entry is None else entry.name.removeprefix("MAV_AUTOPILOT_")


def check_allowed(senders: Iterable[str]) -> tuple[tuple[str, int | None], ...]:
    """Parse a list of allowed senders, ``ADDRESS`` or ``ADDRESS:PORT`` each. Raises `LinkError`:
    an entry is neither.
    """
    out = []
    for text in senders:
        host, _, port = (
            text.rpartition(":")
            if text.count(":") == 1 or (text.startswith("[") and "]:" in text)
            else (text, "", "")
        )
        try:
            address = str(ipaddress.ip_address(host.strip("[]")))
            number = int(port) if port else None
        except ValueError:
            raise LinkError(
                f"link.allow '{text}'; expected a numeric address such as 192.168.1.10, or"
                " 192.168.1.10:14550"
            ) from None
        out.append((address, number))
    return tuple(out)


class Roster:
    """The parties of a link, with their addresses.

    Attributes:
        at: address by party. heard: time of its last message [s]. flying: whether parties must keep
            their addresses.
        received: counts of traffic by kind and sender. refused: number of refused messages and
            datagrams.
        moved: called with a party that returned from another address. tell: called once for each
            refused sender.
        simulated: whether a party has stated that nothing real flies. only: address that the device
            names, or None.
    """

    def __init__(
        self,
        parties: Iterable[Party] = (),
        allow: Iterable[str] = (),
        tell: Announce = None,
    ):
        """Start before the first message. Without parties, the sender of the first valid message
        is the peer. ``allow``: addresses that may send at all; empty: all.
        """
        self.parties = tuple(parties)
        self._allow = set(check_allowed(allow))
        self.tell = tell
        self.at: dict[str, Address] = {}
        self.heard: dict[str, float] = {}
        self.flying = self.simulated = False
        self.received: Counter[Traffic] = Counter()
        self.refused = 0
        self.only: Address = None
        self.moved: list[Callable[[Party], None]] = []
        self._said: set[tuple] = set()

    def shuts_out(self, address: Address) -> bool:
        """Return whether a datagram is refused unread: its sender is not the device's peer, not
        allowed, or unknown in flight.
        """
        if address is None:
            return False
        host, number = address
        if self.only not in (None, address):
            why = f"the link's device is {address_text(self.only)}"
        elif self._allow and not {(host, number), (host, None)} & self._allow:
            why = "not on link.allow"
        elif self.flying and self.parties and address not in self.at.values():
            why = "another sender while it flies"
        else:
            return False
        self.refuse(Traffic(address, None, None, "datagram", why))
        return True

    def refuse(self, traffic: Traffic, count: int = 1) -> None:
        """Count refused traffic, and report its sender once."""
        self.refused += count
        self._count(traffic, count)
        who = (traffic.address, traffic.system, traffic.component, traffic.why)
        if self.tell is not None and who not in self._said and len(self._said) < MOST_SAID:
            self._said.add(who)
            self.tell(f"refused: {traffic.text()}")

    def _count(self, traffic: Traffic, count: int = 1) -> None:
        traffic = (
            traffic if traffic in self.received or len(self.received) < MOST_KEPT else OTHER_TRAFFIC
        )
        self.received[traffic] += count

    def admit(self, message: Any, address: Address, host_time: float) -> bool:
        """Return whether a message belongs to a party; bind the party to the sender's address at
        a time [s].
        """
        kind = message.get_type()
        system = message.get_srcSystem()
        component = message.get_srcComponent()
        party = self._party(kind, system, component, address)
        if party is None and any(
            p.has(system, component) and self.at.get(p.name, ...) == address for p in self.parties
        ):
            # a message of a party that the run does not use
            self._count(Traffic(address, system, component, kind))
            return False
        if self.parties:
            why = self._objection(party, message, kind, address, host_time)
        else:
            why = None if self.at.setdefault("peer", address) == address else "a second sender"
        traffic = Traffic(address, system, component, kind, why or "")
        # a message before the identifying one is no intruder's
        if why is not None and not why.startswith(NOT_YET):
            self.refuse(traffic)
        else:
            self._count(traffic)
        if why is not None or party is None:
            return why is None
        self.heard[party.name] = host_time
        if kind == "NAMED_VALUE_INT" and message.name == SIMULATED:
            self.simulated = bool(message.value)
        before = self.at.get(party.name, address)
        self.at[party.name] = address
        if before != address:
            if self.tell is not None:
                self.tell(f"the {party.name} speaks from {address_text(address)} now")
            for call in self.moved:
                call(party)
        return True

    def _party(self, kind: str, system: int, component: int, address: Address) -> Party | None:
        """Return the party of a message by kind and ids; for shared kinds, preferably one at
        this address.
        """
        ours = [party for party in self.parties if party.has(system, component)]
        if kind in SHARED:
            senders = [
                party for party in ours if party.name in self.at and self.at[party.name] == address
            ]
            return next(iter([*senders, *ours]), None)
        return next(
            (p for p in ours if kind in p.kinds), next((p for p in ours if not p.kinds), None)
        )

    def _objection(
        self, party: Party | None, message: Any, kind: str, address: Address, host_time: float
    ) -> str | None:
        """Return why a message is refused, or None."""
        if party is None:
            return f"nobody of this run, which expects {self.describe_parties()}"
        if (
            party.autopilot is not None
            and kind == "HEARTBEAT"
            and message.autopilot != party.autopilot
        ):
            return (
                f"it is a {autopilot_name(message.autopilot)}, expected is a"
                f" {autopilot_name(party.autopilot)}"
            )
        if self.at.get(party.name, ...) == address:
            return None
        if (why := self._find_conflict(party.name, address, host_time)) is not None:
            return why
        first = "HEARTBEAT" if party.autopilot is not None else ", ".join(sorted(party.kinds))
        return None if not first or kind in first.split(", ") else f"{NOT_YET} {first}"

    def _find_conflict(self, name: str, address: Address, host_time: float) -> str | None:
        """Return why an address may not send for a name that is bound to another address, or
        None.
        """
        bound = self.at.get(name, address)
        if bound == address:
            return None
        if self.flying:
            return f"another sender while it flies; the {name} speaks from {address_text(bound)}"
        if host_time - self.heard[name] < SILENT:
            return f"a second sender; the {name} speaks from {address_text(bound)}"
        return None

    def claim(self, name: str, address: Address, host_time: float) -> bool:
        """Return whether an address may send for a name at a time [s]; the first address is
        bound to the name, under the rules for parties.
        """
        why = self._find_conflict(name, address, host_time)
        if why is not None:
            self.refuse(Traffic(address, None, None, name, why))
            return False
        self.at[name] = address
        self.heard[name] = host_time
        return True

    def drop(self, address: Address, kind: str, why: str, count: int = 1) -> None:
        """Count traffic of a sender that a source could not use, and report it once."""
        self.refuse(Traffic(address, None, None, kind, why), count)

    def describe_parties(self) -> str:
        """Return a text that lists the parties."""
        texts = []
        for p in self.parties:
            what = "/".join(sorted(p.kinds)) if p.kinds else "all"
            kind = "" if p.autopilot is None else f" {autopilot_name(p.autopilot)}"
            texts.append(f"{p.name}{kind} as {p.system}/{p.component or 'any'} ({what})")
        return ", ".join(texts) or "anybody"

    def addresses(self, message: Any) -> tuple[Address, ...]:
        """Return the addresses that a message is sent to: the autopilot's if it names a target,
        else all.
        """
        if hasattr(message, "target_system") and "autopilot" in self.at:
            return (self.at["autopilot"],)
        return tuple(dict.fromkeys(self.at.values()))

    def summary(self) -> dict[str, Any]:
        """Return each party's address and the refused traffic, most frequent first."""
        refused = [
            {"count": count, "what": traffic.text()}
            for traffic, count in self.received.most_common()
            if traffic.why or traffic is OTHER_TRAFFIC
        ]
        return {
            "at": {name: address_text(address) for name, address in self.at.items()},
            "simulated": self.simulated,
            "refused": self.refused,
            "refused_most": refused[:MOST_SAID],
        }

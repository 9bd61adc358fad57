"""Who may speak on a link: each party belongs to the ids that the config names, and to the address
of its first valid message.

A party is a body's poses or the autopilot. What comes from nobody's ids, from another address than
its party's, or from an autopilot of another type is refused, counted, and said once a sender. On
the ground a party that has fallen silent may come back from another address (a bridge that was
started again); in flight none may."""

import ipaddress
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Annotated, Any

from hil.errors import LinkError
from hil.links.pymav import mav
from visthrow.config.bounds import Bound

MavlinkId = Annotated[int, Bound(1, 255)]

# takes lines for the operator, and never waits; None where nobody reads them
Announce = Callable[[str], None] | None

# address of a datagram's sender; None on a stream, which has one peer
Address = tuple[str, int] | None

# after which another address may take a party's place on the ground: longer than a heartbeat's
# second [s]
SILENT = 1.5
# kinds of messages of all senders that are counted apart; the rest is counted together
MOST_KEPT = 256
MOST_SAID = 20  # senders that are said while a run goes on; the summary has the others
# why a message of a party is not taken that has not been heard as the one that it is to be
NOT_YET = "before its first"
# messages that a party may send beside its own: its clock, and whether it is simulated
SHARED = frozenset({"TIMESYNC", "NAMED_VALUE_INT"})
SIMULATED = "SIMULATED"  # name of the NAMED_VALUE_INT by which a fake says that nothing real flies


@dataclass(frozen=True)
class Party:
    """One that the config names."""

    name: str  # of a body, or "autopilot"
    system: int  # MAVLink id
    component: int  # MAVLink id; 0 for any
    # messages that are its; empty: all that are no other party's
    kinds: frozenset[str] = frozenset()
    autopilot: int | None = None  # MAV_AUTOPILOT that its HEARTBEAT must name

    def has(self, system: int, component: int) -> bool:
        """Return whether ids are those of the party."""
        return self.system == system and self.component in (0, component)


@dataclass(frozen=True)
class Traffic:
    """Messages of one kind from one sender."""

    address: Address
    system: int | None
    component: int | None
    kind: str
    why: str = ""  # it was refused; empty where it was taken

    def text(self) -> str:
        """Return it in words."""
        ids = "" if self.system is None else f" of system {self.system}, component {self.component}"
        return f"{self.kind}{ids} from {address_text(self.address)}" + (
            f": {self.why}" if self.why else ""
        )


OTHER_TRAFFIC = Traffic(None, None, None, "others")


def address_text(address: Address) -> str:
    """Return an address in words."""
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
    """Read a list of allowed senders, ``ADDRESS`` or ``ADDRESS:PORT`` each; raises `LinkError` for
    what is neither.
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
    """The parties of a link and where they are.

    Attributes:
        at: address by party. heard: when it last spoke [s]. flying: whether parties are held to
            their addresses.
        received: counts of what came. refused: messages and datagrams that were not taken.
        moved: called with a party that came back from another address. tell: is handed each sender
            that is refused, once.
        simulated: whether a party has said that nothing real flies. only: address that the device
            names, or None.
    """

    def __init__(
        self,
        parties: Iterable[Party] = (),
        allow: Iterable[str] = (),
        tell: Announce = None,
    ):
        """Wait for all parties; without one, the first valid message of anybody says who is heard
        and answered. ``allow``: addresses that may send at all; none: any.
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
        """Return whether a datagram is not even looked into: not from the device's peer, not on the
        list, from nobody in flight.
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
        """Count what is not taken, and say who sent it."""
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
        """Return whether a message is one of a party's; binds the party to its sender's address at
        a time [s].
        """
        kind = message.get_type()
        system = message.get_srcSystem()
        component = message.get_srcComponent()
        party = self._party(kind, system, component, address)
        if party is None and any(
            p.has(system, component) and self.at.get(p.name, ...) == address for p in self.parties
        ):
            # a party's, that nobody asked for
            self._count(Traffic(address, system, component, kind))
            return False
        if self.parties:
            why = self._objection(party, message, kind, address, host_time)
        else:
            why = None if self.at.setdefault("peer", address) == address else "a second sender"
        traffic = Traffic(address, system, component, kind, why or "")
        # a message before a party's first is no stranger's
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
        """Return whose message it is by kind and ids; of a shared kind, one of theirs at this
        address first.
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
        """Return why a message is not taken, or None."""
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
        """Return why an address may not speak for a name that another one speaks for, or None."""
        bound = self.at.get(name, address)
        if bound == address:
            return None
        if self.flying:
            return f"another sender while it flies; the {name} speaks from {address_text(bound)}"
        if host_time - self.heard[name] < SILENT:
            return f"a second sender; the {name} speaks from {address_text(bound)}"
        return None

    def claim(self, name: str, address: Address, host_time: float) -> bool:
        """Return whether an address may speak for a name at a time [s]; the first one that asks is
        bound to it, under the rules of parties.
        """
        why = self._find_conflict(name, address, host_time)
        if why is not None:
            self.refuse(Traffic(address, None, None, name, why))
            return False
        self.at[name] = address
        self.heard[name] = host_time
        return True

    def drop(self, address: Address, kind: str, why: str, count: int = 1) -> None:
        """Count what a source could not take from a sender, and say it once."""
        self.refuse(Traffic(address, None, None, kind, why), count)

    def describe_parties(self) -> str:
        """Return the parties in words."""
        texts = []
        for p in self.parties:
            what = "/".join(sorted(p.kinds)) if p.kinds else "all"
            kind = "" if p.autopilot is None else f" {autopilot_name(p.autopilot)}"
            texts.append(f"{p.name}{kind} as {p.system}/{p.component or 'any'} ({what})")
        return ", ".join(texts) or "anybody"

    def addresses(self, message: Any) -> tuple[Address, ...]:
        """Return where a message of ours goes: what names a target to the autopilot, the rest to
        all.
        """
        if hasattr(message, "target_system") and "autopilot" in self.at:
            return (self.at["autopilot"],)
        return tuple(dict.fromkeys(self.at.values()))

    def summary(self) -> dict[str, Any]:
        """Return who was heard from where, and what was refused, most first."""
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

"""Rows of a check: one finding each, with topic, channel, verdict, text and figures."""

from dataclasses import dataclass, field
from typing import Any, Literal

Verdict = Literal["ok", "warn", "bad"]
ORDER = ("ok", "warn", "bad")


@dataclass(frozen=True)
class Row:
    """One finding."""

    # clock, gaps, values, noise, units, frames, delay, cable, thrust, excited, answers, duplicates
    topic: str
    channel: str  # or several channels; "": the whole log
    verdict: Verdict
    text: str
    figures: dict[str, Any] = field(default_factory=dict)  # with units in their names

    @property
    def name(self) -> str:
        """Topic and channel: the name by which a model overrules the row."""
        return f"{self.topic} {self.channel}".strip()


def worst(rows: list[Row]) -> Verdict:
    """Return the worst verdict among rows; ``ok`` where there is none."""
    return ORDER[max((ORDER.index(row.verdict) for row in rows), default=0)]


@dataclass(frozen=True)
class KnownVehicle:
    """Facts that a model states about a vehicle."""

    cable_length: float = 0.0  # to the payload's centre [m]; 0: none
    mass: float = 0.0  # of vehicle, cable and payload [kg]; 0: unknown
    thrust_input: str = ""  # channel from which the thrust follows; "": any that the log holds
    # polynomial of a motor's thrust (of all motors', for a thrust command), powers 0, 1, 2 [N]
    thrust_map: tuple[float, float, float] | None = None
    # channels that the model does not read, and names of rows that are overruled
    unread: frozenset[str] = frozenset()


NOTHING = KnownVehicle()

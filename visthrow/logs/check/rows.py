"""One finding a row: topic, channel, verdict, words and figures."""

from dataclasses import dataclass, field
from typing import Any, Literal

Verdict = Literal["ok", "warn", "bad"]
ORDER = ("ok", "warn", "bad")


@dataclass(frozen=True)
class Row:
    """One finding."""

    # clock, gaps, values, noise, units, frames, delay, cable, thrust, excited, answers, duplicates
    topic: str
    channel: str  # that it speaks of; or several; or "" for the whole log
    verdict: Verdict
    text: str
    figures: dict[str, Any] = field(default_factory=dict)  # with units in their names

    @property
    def name(self) -> str:
        """Topic and channel, by which it is overruled."""
        return f"{self.topic} {self.channel}".strip()


def worst(rows: list[Row]) -> Verdict:
    """Return the worst verdict among rows; ``ok`` where there is none."""
    return ORDER[max((ORDER.index(row.verdict) for row in rows), default=0)]


@dataclass(frozen=True)
class KnownVehicle:
    """A model's statements about a vehicle."""

    cable_length: float = 0.0  # to the payload's centre [m]; 0: none
    mass: float = 0.0  # of all that flies [kg]; 0: not known
    thrust_input: str = ""  # channel that the thrust comes from; "": whatever the log holds
    # thrust of a motor (of all, for a thrust command) by powers 0, 1, 2 [N]
    thrust_map: tuple[float, float, float] | None = None
    # channels that the model does not read, and names of rows that are overruled
    unread: frozenset[str] = frozenset()


NOTHING = KnownVehicle()

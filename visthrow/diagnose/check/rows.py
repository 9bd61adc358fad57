"""One finding a row: topic, channel, verdict, words and figures."""

from dataclasses import dataclass, field
from typing import Any, Literal

Verdict = Literal["ok", "warn", "bad"]
ORDER = ("ok", "warn", "bad")


@dataclass(frozen=True)
class Row:
    """One finding."""

    topic: str  # clock, gaps, values, noise, units, frames, delay, excited, answers, duplicates
    channel: str  # that it speaks of; or several; or "" for the whole log
    verdict: Verdict
    text: str
    figures: dict[str, Any] = field(default_factory=dict)  # with units in their names


def worst(rows: list[Row]) -> Verdict:
    """Return the worst verdict among rows; ``ok`` where there is none."""
    return ORDER[max((ORDER.index(row.verdict) for row in rows), default=0)]

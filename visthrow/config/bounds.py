"""Bounds of numbers, declared where the field is:

``lag: NotNegative``, ``share: Annotated[float, Bound(0.0, 1.0)]``. Onboard-safe.
"""

import math
import typing
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any

from visthrow.common.errors import ConfigError


@dataclass(frozen=True)
class Bound:
    """An interval; of a tuple every number lies in it, None passes."""

    low: float = -math.inf
    high: float = math.inf
    ends: str = "[]"  # as intervals are written: "(" and ")" leave an end out

    def holds(self, value: float) -> bool:
        """Whether a number lies within; NaN never does."""
        above = value > self.low if self.ends[0] == "(" else value >= self.low
        return above and (value < self.high if self.ends[1] == ")" else value <= self.high)

    def __str__(self) -> str:
        if self.ends == "[]" and math.isfinite(self.low + self.high):
            return f"{self.low:g} to {self.high:g}"
        low = f"above {self.low:g}" if self.ends[0] == "(" else f"{self.low:g} or more"
        high = f"below {self.high:g}" if self.ends[1] == ")" else f"at most {self.high:g}"
        return " and ".join(
            text for text, end in ((low, self.low), (high, self.high)) if math.isfinite(end)
        )


Positive = Annotated[float, Bound(0.0, ends="(]")]
NotNegative = Annotated[float, Bound(0.0)]


class Bounded:
    """Base of dataclasses whose annotations state bounds; raises `ConfigError` for a number outside
    of its own.
    """

    def __post_init__(self) -> None:
        for name, bound in _bounds(type(self)).items():
            value = getattr(self, name)
            numbers = value if isinstance(value, tuple) else () if value is None else (value,)
            if not all(map(bound.holds, numbers)):
                raise ConfigError(f"{name} is {value}; expected {bound}")


@cache
def _bounds(schema: type) -> dict[str, Bound]:
    bounds = {
        name: _bound(hint)
        for name, hint in typing.get_type_hints(schema, include_extras=True).items()
    }
    return {name: bound for name, bound in bounds.items() if bound is not None}


def _bound(hint: Any) -> Bound | None:
    notes = [note for note in getattr(hint, "__metadata__", ()) if isinstance(note, Bound)]
    inner = [bound for part in typing.get_args(hint) if (bound := _bound(part)) is not None]
    return next(iter([*notes, *inner]), None)

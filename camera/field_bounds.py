"""Bounds of the numbers of dataclasses, declared in the annotations of their fields:

``lag: NotNegative``, ``angle: Annotated[float, Bound(0.0, 180.0)]``. A number without a bound must
be finite. The module may be imported on board.
"""

import math
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, ClassVar


@dataclass(frozen=True)
class Bound:
    """An interval. Every number of a tuple must lie in it; None is accepted."""

    low: float = -math.inf
    high: float = math.inf
    ends: str = "[]"  # "(" or ")" excludes an end

    def holds(self, value: float) -> bool:
        """Return whether a number is finite and inside the interval."""
        if self.ends[0] == "(":
            above = value > self.low
        else:
            above = value >= self.low
        if self.ends[1] == ")":
            below = value < self.high
        else:
            below = value <= self.high
        return above and below and math.isfinite(value)

    def __str__(self) -> str:
        if self.ends == "[]" and math.isfinite(self.low + self.high):
            return f"{self.low:g} to {self.high:g}"
        low = f"above {self.low:g}" if self.ends[0] == "(" else f"{self.low:g} or more"
        high = f"below {self.high:g}" if self.ends[1] == ")" else f"at most {self.high:g}"
        limits = [text for text, end in ((low, self.low), (high, self.high)) if math.isfinite(end)]
        return " and ".join(limits) or "a finite number"


Positive = Annotated[float, Bound(0.0, ends="(]")]
NotNegative = Annotated[float, Bound(0.0)]
Vector = tuple[float, float, float]  # of numbers along three axes
NotNegativeVector = tuple[NotNegative, NotNegative, NotNegative]
Share = Annotated[float, Bound(0.0, 1.0)]
# Bounds for anything that flies in a hall: a number outside has a wrong unit.
Mass = Annotated[float, Bound(0.0, 1e5, "(]")]  # [kg]
Length = Annotated[float, Bound(0.0, 1e3, "(]")]  # [m]
Arm = Annotated[float, Bound(-10.0, 10.0)]  # of a rotor [m]
Duration = Annotated[float, Bound(0.0, 5.0, "(]")]  # of a filter, a lag or a step [s]
Lag = Annotated[float, Bound(0.0, 5.0)]  # a duration that may be 0 [s]
Drag = Annotated[float, Bound(0.0, 10.0)]  # force over speed [kg/s] or its square [kg/m]
AirCoefficient = Annotated[float, Bound(-10.0, 10.0)]  # of any other air force, in SI units


class BoundedFields:
    """Base of dataclasses with bounds in their annotations. Raises `error` for a number outside
    its bounds.
    """

    error: ClassVar[type[Exception]] = ValueError

    def __post_init__(self) -> None:
        for name, bound in _bounds(type(self)).items():
            value = getattr(self, name)
            if not all(map(bound.holds, _numbers(value))):
                raise self.error(f"{name} is {value}; expected {bound}")


def _numbers(value: Any) -> Iterator[float]:
    """Yield all numbers in the value of a field."""
    if isinstance(value, tuple | list | dict):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _numbers(item)
    elif isinstance(value, int | float):
        yield value


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
    return next(iter([*notes, *inner]), Bound() if hint is float else None)

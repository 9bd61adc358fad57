"""Conversion of a plant to other units of length, mass and time, to compare vehicles of any size.

The unit of time is the square root of the unit of length. Gravity then keeps its numerical value,
so that a plant in other units has the same equations with the same gravity. Volts are not
converted."""

import dataclasses
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from sim.params import PlantParams

Value = TypeVar("Value")
Dimension = tuple[int, int, int]
"""Exponents of length, mass and time."""

_FILE = tomllib.loads(Path(__file__).with_name("dimensions.toml").read_text(encoding="utf-8"))
_EXPONENTS: dict[str, Dimension] = {
    name: tuple(exponents) for name, exponents in _FILE.pop("dimensions").items()
}


def dimensions_of(tables: Mapping[str, Mapping[str, str]]) -> dict[str, dict[str, Dimension]]:
    """Return the dimension of each field of tables such as those of ``dimensions.toml``."""
    return {
        table: {
            field: _EXPONENTS[name] for name, fields in kinds.items() for field in fields.split()
        }
        for table, kinds in tables.items()
    }


PLANT = dimensions_of(_FILE)
"""Class of a plant's parameters -> field -> dimension."""


@dataclass(frozen=True)
class Units:
    """Units of length [m] and mass [kg]; the unit of time [s] follows from gravity."""

    length: float
    mass: float

    @property
    def time(self) -> float:
        """Unit of time [s]."""
        return math.sqrt(self.length)

    def size(self, dimension: Dimension) -> float:
        """Return the unit of a dimension in SI units."""
        length, mass, time = dimension
        return self.length**length * self.mass**mass * self.time**time

    @property
    def inverse(self) -> "Units":
        """Units of the inverse conversion."""
        return Units(1.0 / self.length, 1.0 / self.mass)


def convert_units(
    value: Value, units: Units, dimensions: Mapping[str, Mapping[str, Dimension]] = PLANT
) -> Value:
    """Convert a dataclass of SI values, and the dataclasses in it, to other units.

    Raises ValueError: a field without a known dimension, or a plant with laws, whose coefficients
    have various dimensions."""
    if isinstance(value, PlantParams) and value.laws:
        raise ValueError(
            f"{len(value.laws)} laws of a plant to state in other units; expected none: the"
            " dimensions of their coefficients are unknown"
        )
    dimension_of = dimensions.get(type(value).__name__, {})

    def convert(name: str, item: Any) -> Any:
        if dataclasses.is_dataclass(item) and not isinstance(item, type):
            return convert_units(item, units, dimensions)
        if item == ():
            return item
        if name not in dimension_of:
            raise ValueError(
                f"{type(value).__name__}.{name} has no dimension; expected it in"
                f" sim/scaling/dimensions.toml, table [{type(value).__name__}], under one of:"
                f" {', '.join(_EXPONENTS)}"
            )
        if not any(dimension_of[name]):
            return item
        size = units.size(dimension_of[name])
        return tuple(x / size for x in item) if isinstance(item, tuple) else item / size

    names = [f.name for f in dataclasses.fields(value)]  # type: ignore[arg-type]
    return type(value)(**{name: convert(name, getattr(value, name)) for name in names})

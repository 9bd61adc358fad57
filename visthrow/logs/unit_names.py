"""Units of input files, with the factor of each to the unit that this project uses."""

from collections.abc import Iterable, Mapping

import numpy as np

from visthrow.common.errors import ConfigError
from visthrow.common.toml_text import tables_beside

G = 9.80665  # standard gravity [m/s^2] of units such as g and gram-force; not the local gravity

_TABLES = tables_beside(__file__)
UNITS: dict[str, tuple[str, float]] = {
    name: (ours, size) for ours, sizes in _TABLES.items() for name, size in sizes.items()
}
"""Unit -> (our unit of the same kind, size in it)."""


def nearest(number: float, sizes: Mapping[str, float]) -> tuple[str, float]:
    """Return the name of the size whose product with a number is nearest to 1, and the absolute
    logarithm of that product.
    """
    misses = {name: abs(float(np.log(number * size))) for name, size in sizes.items()}
    best = min(misses, key=misses.__getitem__)
    return best, misses[best]


def nearest_unit(number: float, units: Iterable[str]) -> tuple[str, float]:
    """Return the unit for which a number, converted to our unit, is nearest to 1, and the absolute
    logarithm of the converted number.
    """
    return nearest(number, {unit: UNITS[unit][1] for unit in units})


def fitting_units(number: float, units: Iterable[str], low: float, high: float) -> list[str]:
    """Return the units for which a number, converted to our unit, lies within two bounds."""
    return [unit for unit in units if low <= number * UNITS[unit][1] <= high]


def to_si(unit: str, where: str) -> tuple[str, float]:
    """Return our unit of the same kind, and the factor that converts to it.

    Raises ConfigError: an unknown unit.
    """
    if unit not in UNITS:
        raise ConfigError(f"{where}: unit '{unit}'; known: {', '.join(UNITS)}")
    return UNITS[unit]

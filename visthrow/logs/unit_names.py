"""Units at the edge of the house: what each is worth in ours."""

from collections.abc import Iterable, Mapping

import numpy as np

from visthrow.common.errors import ConfigError
from visthrow.common.toml_text import tables_beside

G = 9.80665  # standard gravity [m/s^2]: what a datasheet's g and gram-force mean; not the local one

_TABLES = tables_beside(__file__)
UNITS: dict[str, tuple[str, float]] = {
    name: (ours, size) for ours, sizes in _TABLES.items() for name, size in sizes.items()
}
"""Name -> (ours, size in ours)."""


def nearest(number: float, sizes: Mapping[str, float]) -> tuple[str, float]:
    """Return the name of the size that brings a number nearest to 1, and by how much of the
    logarithm it misses.
    """
    misses = {name: abs(float(np.log(number * size))) for name, size in sizes.items()}
    best = min(misses, key=misses.__getitem__)
    return best, misses[best]


def nearest_unit(number: float, units: Iterable[str]) -> tuple[str, float]:
    """Return the unit in which a number comes nearest to 1 in ours, and by how much of the
    logarithm it misses.
    """
    return nearest(number, {unit: UNITS[unit][1] for unit in units})


def fitting_units(number: float, units: Iterable[str], low: float, high: float) -> list[str]:
    """Return the units in which a number lies between two sizes in ours."""
    return [unit for unit in units if low <= number * UNITS[unit][1] <= high]


def to_si(unit: str, where: str) -> tuple[str, float]:
    """Return our unit of the same kind and the factor to it.

    Raises ConfigError: an unknown unit.
    """
    if unit not in UNITS:
        raise ConfigError(f"{where}: unit '{unit}'; known: {', '.join(UNITS)}")
    return UNITS[unit]

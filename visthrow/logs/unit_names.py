"""Units at the edge of the house: what each is worth in ours."""

import tomllib
from pathlib import Path

from visthrow.common.errors import ConfigError, suggest

G = 9.80665  # standard gravity [m/s^2]: what a datasheet's g and gram-force mean; not the local one

_TABLES = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
UNITS: dict[str, tuple[str, float]] = {
    name: (ours, size) for ours, sizes in _TABLES.items() for name, size in sizes.items()
}
"""Name -> (ours, size in ours)."""


def to_si(unit: str, where: str) -> tuple[str, float]:
    """Return our unit of the same kind and the factor to it.

    Raises ConfigError: an unknown unit.
    """
    if unit not in UNITS:
        raise ConfigError(f"{where}: unit '{unit}'; {suggest(unit, UNITS)}")
    return UNITS[unit]

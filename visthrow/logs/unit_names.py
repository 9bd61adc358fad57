"""Units at the edge of the house: what each is worth in ours."""

import math

from visthrow.common.errors import ConfigError, suggest

G = 9.80665  # standard gravity [m/s^2]: what a datasheet's g and gram-force mean; not the local one

UNITS = {
    "s": ("s", 1.0),
    "ms": ("s", 1e-3),
    "us": ("s", 1e-6),
    "ns": ("s", 1e-9),
    "min": ("s", 60.0),
    **{
        f"1/{rate} s": ("s", 1.0 / rate)
        for rate in (30, 50, 60, 100, 120, 200, 240, 250, 300, 500, 1000)
    },
    "m": ("m", 1.0),
    "cm": ("m", 1e-2),
    "mm": ("m", 1e-3),
    "ft": ("m", 0.3048),
    "in": ("m", 0.0254),
    "m/s": ("m/s", 1.0),
    "cm/s": ("m/s", 1e-2),
    "mm/s": ("m/s", 1e-3),
    "m/s^2": ("m/s^2", 1.0),
    "g": ("m/s^2", G),
    "mg": ("m/s^2", 1e-3 * G),
    "rad": ("rad", 1.0),
    "deg": ("rad", math.pi / 180),
    "mrad": ("rad", 1e-3),
    "cdeg": ("rad", math.pi / 18000),
    "rad/s": ("rad/s", 1.0),
    "deg/s": ("rad/s", math.pi / 180),
    "mrad/s": ("rad/s", 1e-3),
    "rpm": ("rad/s", math.pi / 30),
    "N": ("N", 1.0),
    "mN": ("N", 1e-3),
    "gf": ("N", 1e-3 * G),
    "kgf": ("N", G),
    "N m": ("N m", 1.0),
    "N mm": ("N m", 1e-3),
    "V": ("V", 1.0),
    "mV": ("V", 1e-3),
    "cV": ("V", 1e-2),
    "A": ("A", 1.0),
    "mA": ("A", 1e-3),
    "cA": ("A", 1e-2),
    "W": ("W", 1.0),
    "1": ("1", 1.0),
    "%": ("1", 1e-2),
    "1/65535": ("1", 1 / 65535),
    "1/1000": ("1", 1e-3),
}
"""Name -> (ours, size in ours)."""


def to_si(unit: str, where: str) -> tuple[str, float]:
    """Return our unit of the same kind and the factor to it.

    Raises ConfigError: an unknown unit.
    """
    if unit not in UNITS:
        raise ConfigError(f"{where}: unit '{unit}'; {suggest(unit, UNITS)}")
    return UNITS[unit]

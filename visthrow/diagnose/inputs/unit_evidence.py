"""Units that no name says, by physics: what a path does against gravity, what a hall holds, what a
thrust carries.
"""

from collections.abc import Iterable, Mapping

import numpy as np

from visthrow.common.free_fall import GRAVITY
from visthrow.common.rotations import matrix_of_quat
from visthrow.logs.check import physics, relations
from visthrow.logs.check.thrust_checks import MASS_BAD
from visthrow.logs.flightlog import Channel
from visthrow.logs.unit_names import UNITS

LENGTHS = ("m", "mm", "cm")
"""Units of a path, the usual ones first."""
THRUSTS = ("N", "gf", "mN", "kgf")
"""Units of a thrust, the usual ones first."""
LIGHTEST = 0.01
"""Of what is tracked and flies by four rotors [kg]: from 10 up a number of kilograms may be one of
grams.
"""

USUAL = (0.7, 1.4)
"""What vehicles of 13 recorded flights accelerate by, over what their lean makes."""

# over which a path is differentiated: noise of motion capture of 1 mm makes 0.05 m/s^2, a lean of
# 0.3 deg [s]
_SPAN = 0.2
_DECADES = 0.5  # half of the least step between two lengths
_LEANS = 0.02  # least acceleration of a lean that says something: 0.1 deg [m/s^2]
_FALLS = 0.15  # of gravity, that a fall may be off by: drag of a light ball
# of a path, that falls where things are thrown: 0.18 and 0.21 of two recorded ones, at most 0.05 of
# 13 flights in any unit
_SHARE = 0.1
_HALL = (0.1, 60.0)  # what a path in a hall reaches from the origin of the capture [m]


Lean = tuple[str, str, float]
"""Unit of length, unit of the angles, and path over lean in them."""


def by_lean(
    time: np.ndarray,
    path: np.ndarray,
    attitudes: Mapping[str, Channel],
    units: Iterable[str] = LENGTHS,
) -> list[Lean]:
    """Find the units in which a path does what its vehicle's lean makes of gravity: level, a
    rotor's lean accelerates by g tan(tilt).

    Args:
        time: Stamps of the path [s], shape (T,).
        path: The path in its unknown unit, shape (T, 3).
        attitudes: Attitudes by the unit of their angles.
        units: Units of length that are tried.

    Returns:
        Each pair of units that goes together; none where nothing leans.
    """
    time, path = rising(time, path)
    fits = []
    stamps, acc = physics.accelerations(time, path, "m", _SPAN)
    for angle, attitude in attitudes.items():
        time_q, quat = attitude.samples()
        if min(len(stamps), len(time_q)) < 50:
            continue
        up = matrix_of_quat(relations.attitude_at(time_q, quat, stamps))[:, :, 2]
        lean = relations.mean_over(
            stamps, GRAVITY * up[:, :2] / np.maximum(up[:, 2:], 0.2), stamps, _SPAN
        )
        size, does = (
            float(np.sqrt(np.sum(np.var(values, axis=0)))) for values in (lean, acc[:, :2])
        )
        if size < _LEANS or does <= 0.0:
            continue
        ratios = {unit: does * UNITS[unit][1] / size for unit in units}
        fits += [
            (unit, angle, ratio)
            for unit, ratio in ratios.items()
            if abs(np.log10(ratio)) < _DECADES
        ]
    return fits


def lean_misfit(time: np.ndarray, path: np.ndarray, attitude: Channel) -> tuple[float, float]:
    """Measure how badly the force on a path points along its vehicle's z axis.

    Args:
        time: Stamps of the path [s], shape (T,).
        path: The path [m], z up, shape (T, 3).
        attitude: Of the vehicle.

    Returns:
        Mean square of the force across that axis [m^2/s^4], and half the number of samples that
        count as independent; infinite and 0 where too little is known.
    """
    time_q, quat = attitude.samples()
    stamps, acc = physics.accelerations(*rising(time, path), "m", _SPAN)
    if min(len(stamps), len(time_q)) < 50:
        return np.inf, 0.0
    up = matrix_of_quat(relations.attitude_at(time_q, quat, stamps))[:, :, 2]
    sideways = np.cross(up, acc + [0.0, 0.0, GRAVITY])
    floor = 1e-4  # noise of a still path [m^2/s^4]
    return float(np.mean(np.sum(sideways**2, axis=1))) + floor, 0.5 * float(np.ptp(stamps)) / _SPAN


def by_fall(time: np.ndarray, path: np.ndarray) -> str:
    """Find the unit in which a part of a path falls freely: gravity along one axis and nothing
    level; "" where none does.
    """
    acc = physics.accelerations(*rising(time, path), "m")[1]
    if not len(acc):
        return ""
    down = GRAVITY * np.vstack([np.eye(3), -np.eye(3)])
    off = {unit: np.linalg.norm(acc[:, None] * UNITS[unit][1] - down, axis=2) for unit in LENGTHS}
    shares = {
        unit: float(np.max(np.mean(excess < _FALLS * GRAVITY, axis=0)))
        for unit, excess in off.items()
    }
    best = max(shares, key=shares.__getitem__)
    return best if shares[best] > _SHARE else ""


def by_hall(path: np.ndarray) -> tuple[list[str], float]:
    """Find the units in which a path stays in a hall.

    Returns them and how far it reaches from the origin, in its own unit.
    """
    reach = float(np.nanmax(np.abs(path)))
    return [unit for unit in LENGTHS if _HALL[0] <= reach * UNITS[unit][1] <= _HALL[1]], reach


def by_mass(carried: float, weighed: float, units: Iterable[str] = THRUSTS) -> str:
    """Find the unit of a thrust in which it carries what was weighed.

    Args:
        carried: What it carries if it is in newtons [kg].
        weighed: Mass of the vehicle [kg]; a payload and the charge of the battery may add to it or
            take from it, by less than e.
        units: Units that are tried.

    Returns:
        The unit, "" where none does.
    """
    off = {unit: abs(float(np.log(weighed / (carried * UNITS[unit][1])))) for unit in units}
    best = min(off, key=off.__getitem__)
    return best if off[best] < MASS_BAD else ""


def rising(time: np.ndarray, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows that are numbers, later than those before."""
    good = np.isfinite(time) & np.all(np.isfinite(path), axis=1)
    time = time[good]
    path = path[good]
    later = np.diff(np.maximum.accumulate(time), prepend=-np.inf) > 0.0
    return time[later], path[later]

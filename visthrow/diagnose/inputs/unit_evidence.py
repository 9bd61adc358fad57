"""Units that no name says, by physics: what a path does against gravity, what a hall holds, what a
thrust carries.
"""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy import ndarray

from visthrow.common.free_fall import GRAVITY
from visthrow.common.rotations import matrix_of_quat
from visthrow.logs.axes import OURS, turn_of
from visthrow.logs.check import physics
from visthrow.logs.check.thrust_checks import MASS_BAD
from visthrow.logs.flightlog import Channel
from visthrow.logs.mapping import ChannelMap
from visthrow.logs.readers.table_to_log import forward_rows
from visthrow.logs.samples import Samples
from visthrow.logs.unit_names import UNITS, fitting_units, nearest_unit

LENGTHS = ("m", "mm", "cm")
"""Units of a path, the usual ones first."""
THRUSTS = ("N", "gf", "mN", "kgf")
"""Units of a thrust, the usual ones first."""
LIGHTEST = 0.01
"""Of what is tracked and flies by four rotors [kg]: from 10 up a number of kilograms may be one of
grams.
"""
SURE = 5.0
"""Nats by which a reading must beat all others: odds of 148 to 1."""

# of the logarithm of what a vehicle accelerates by over what its lean makes: those of 13 recorded
# flights lie from 0.7 to 1.4
_SCATTER = 0.17
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
# nats against a unit in which a path leaves a hall or does not fall as it falls
_OUTSIDE = 15.0
_BELOW = 4.0  # nats against an attitude by which a path stays below the floor
_FAR = 2.5  # deviations beyond which doubt grows with the distance alone: more than a lean may push


@dataclass(frozen=True)
class Attitude:
    """One way to read the columns of an attitude."""

    entry: ChannelMap
    channel: Channel
    doubt: float  # nats against it before any path is looked at
    words: str = ""  # by which it differs from the other ways; "" where there is only one

    @property
    def kind(self) -> tuple[str, str, tuple[str, ...]]:
        """Order of a quaternion, axes of the world and signs: all but the unit of angles."""
        return self.entry.order, self.entry.axes, self.entry.columns


_NEVER = Channel(np.empty(0), np.empty((0, 4)), "1")
NO_ATTITUDE = Attitude(ChannelMap("none", ("none",), "1"), _NEVER, doubt=0.0)
"""Of a vehicle none of whose columns is an attitude."""


@dataclass(frozen=True)
class PathReading:
    """One way to read the columns of a path, beside an attitude."""

    unit: str
    attitude: Attitude
    doubt: float  # nats against it, less those of other readings of the same path
    why: str

    @property
    def words(self) -> str:
        """Unit, and the attitude's reading where there are several."""
        way = self.attitude.words
        return f"'{self.unit}'" + (f" with {way}" if way else "")


class Lean(NamedTuple):
    """A path's motion beside the lean of an attitude."""

    size: float  # what the lean accelerates it by [m/s^2]
    times: float  # how many times that it accelerates by in its own unit; 0: not known
    correlation: float  # of the two
    nats: float  # for their going together


NO_LEAN = Lean(0.0, 0.0, 0.0, 0.0)


def readings(
    time: ndarray, path: ndarray, units: Iterable[str], attitudes: Iterable[Attitude]
) -> list[PathReading]:
    """Weigh all readings of a path, the likeliest first.

    Level, a rotor's lean accelerates by about g sin(tilt); what is thrown falls with g; and a path
    stays in a hall.

    Args:
        time: Stamps of the path [s], shape (T,).
        path: The path in its unknown unit, shape (T, 3).
        units: Units of length that are tried.
        attitudes: Readings of the vehicle's attitude.
    """
    reach = np.nanmax(np.abs(path))
    in_hall = fitting_units(reach, units, *_HALL)
    fall = find_unit_by_fall(time, path)
    leans = [_weigh_by_lean(time, path, way) for way in attitudes]
    together = defaultdict(float)  # by kind: angles in whatever unit
    for attitude, lean in zip(attitudes, leans):
        together[attitude.kind] = max(together[attitude.kind], lean.nats)
    decades = []  # of what a lean makes, by which a unit is off
    for lean, unit in product(leans, units):
        if lean.times > 0.0:
            decades.append(abs(np.log10(UNITS[unit][1] * lean.times)))
    leaning = min(decades, default=np.inf) < _DECADES and max(x.size for x in leans) > _LEANS
    correlation = max((lean.correlation for lean in leans if lean.nats >= SURE), default=0.0)
    leaning = leaning and correlation > 0.0
    slack = -np.log(correlation) if leaning else 0.0  # by which noise of either changes their ratio
    listed = []
    for attitude, lean in zip(attitudes, leans):
        height = np.nanmedian(path @ turn_to(attitude.entry.axes)[:, 2])
        below = _BELOW * (height < 0.0)
        for unit in units:
            doubt = attitude.doubt + below + _OUTSIDE * (unit not in in_hall)
            doubt += _OUTSIDE * (fall not in ("", unit))
            why = f"{unit} by the size of a hall: {reach:.3g} from the origin"
            if leaning:
                doubt -= together[attitude.kind]
            if leaning and lean.times > 0.0:
                times = UNITS[unit][1] * lean.times
                doubt += _huber(max(0.0, abs(np.log(times)) - slack) / _SCATTER)
                why = f"{unit} by gravity: it accelerates by {times:.2g} times what its lean makes"
            elif fall:
                why = f"{unit} by gravity: a part of it falls freely"
            listed.append(PathReading(unit, attitude, doubt, why))
    return sorted(listed, key=lambda reading: reading.doubt)


def _weigh_by_lean(time: ndarray, path: ndarray, attitude: Attitude) -> Lean:
    """Weigh a path against the lean that an attitude gives it."""
    attitudes = attitude.channel.samples()
    turned = path @ turn_to(attitude.entry.axes)
    stamps, acc = physics.accelerations(select_rising(time, turned), "m", _SPAN)
    if min(len(stamps), len(attitudes.time)) < 50:
        return NO_LEAN
    up = matrix_of_quat(attitudes.attitudes(stamps))[:, :, 2]
    lean = Samples(stamps, GRAVITY * up[:, :2]).mean_over(stamps, _SPAN)
    lean = (lean - lean.mean(0)).ravel()
    moved = (acc - acc.mean(0))[:, :2].ravel()
    power = np.linalg.norm(lean) * np.linalg.norm(moved)
    if power <= 0.0:
        return NO_LEAN
    correlation = min(max(lean @ moved / power, 0.0), 0.999)
    independent = np.ptp(stamps) / _SPAN
    nats = -0.5 * independent * np.log(1.0 - correlation**2)
    times = np.linalg.norm(moved) / np.linalg.norm(lean)
    return Lean(np.linalg.norm(lean) / np.sqrt(len(stamps)), times, correlation, nats)


def _huber(deviations: float) -> float:
    """Nats against a ratio so many deviations off."""
    near = min(abs(deviations), _FAR)
    return near * (abs(deviations) - 0.5 * near)


def turn_to(axes: str) -> ndarray:
    """Return the matrix that turns rows about a source's axes into ours."""
    return turn_of(axes or OURS).T


def find_unit_by_fall(time: ndarray, path: ndarray) -> str:
    """Find the unit in which a part of a path falls freely: gravity along one axis and nothing
    level; "" where none does.
    """
    acc = physics.accelerations(select_rising(time, path), "m").values
    if not len(acc):
        return ""
    down = GRAVITY * np.vstack([np.eye(3), -np.eye(3)])
    shares = {}
    for unit in LENGTHS:
        off = np.linalg.norm(acc[:, None] * UNITS[unit][1] - down, axis=2)
        shares[unit] = (off < _FALLS * GRAVITY).mean(0).max()
    best = max(shares, key=shares.__getitem__)
    return best if shares[best] > _SHARE else ""


def find_unit_by_mass(carried: float, weighed: float, units: Iterable[str]) -> str:
    """Find the unit of a thrust in which it carries what was weighed.

    Args:
        carried: What it carries if it is in newtons [kg].
        weighed: Mass of the vehicle [kg]; a payload and the charge of the battery may add to it or
            take from it, by less than e.
        units: Units that are tried.

    Returns:
        The unit, "" where none does.
    """
    unit, miss = nearest_unit(carried / weighed, units)
    return unit if miss < MASS_BAD else ""


def select_rising(time: ndarray, path: ndarray) -> Samples:
    """Rows that are numbers and leave the clock going on."""
    rows = forward_rows(np.where(np.isfinite(path).all(1), time, np.nan))
    return Samples(time[rows], path[rows])

"""Units determined by physics: by gravity in a path, by the size of a hall, and by the mass that a
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
"""Units of a path, most common first."""
THRUSTS = ("N", "gf", "mN", "kgf")
"""Units of a thrust, most common first."""
LIGHTEST = 0.01
"""Lightest tracked quadrotor [kg]: from 10 up, a number that should be kilograms may be grams."""
SURE = 5.0
"""Nats by which a reading must be ahead of all others: odds of 148 to 1."""

# standard deviation of the log ratio of measured acceleration to that by tilt: the ratios of 13
# recorded flights are from 0.7 to 1.4
_SCATTER = 0.17
# span over which a path is differentiated [s]: noise of motion capture of 1 mm causes 0.05 m/s^2,
# as much as a tilt of 0.3 deg
_SPAN = 0.2
_DECADES = 0.5  # half of the smallest log10 ratio between units of length
_LEANS = 0.02  # smallest informative acceleration by tilt, that of 0.1 deg [m/s^2]
_FALLS = 0.15  # largest deviation of free fall from gravity, relative to it: drag of a light ball
# smallest share of a path in free fall for a thrown object: two recorded throws have 0.18 and 0.21,
# 13 flights at most 0.05 in any unit
_SHARE = 0.1
_HALL = (0.1, 60.0)  # range of a path's largest distance from the capture's origin in a hall [m]
# nats against a unit in which a path leaves a hall, or its free fall does not have gravity
_OUTSIDE = 15.0
_BELOW = 4.0  # nats against an attitude whose axes put a path below the floor
_FAR = 2.5  # deviations from which on the nats grow linearly


@dataclass(frozen=True)
class Attitude:
    """A possible reading of the columns of an attitude."""

    entry: ChannelMap
    channel: Channel
    doubt: float  # nats against it before any path is considered
    words: str = ""  # its difference from other readings; "" if it is the only one

    @property
    def kind(self) -> tuple[str, str, tuple[str, ...]]:
        """Order of a quaternion, axes of the world and signs; not the unit of angles."""
        return self.entry.order, self.entry.axes, self.entry.columns


_NEVER = Channel(np.empty(0), np.empty((0, 4)), "1")
NO_ATTITUDE = Attitude(ChannelMap("none", ("none",), "1"), _NEVER, doubt=0.0)
"""Placeholder for a table without an attitude."""


@dataclass(frozen=True)
class PathReading:
    """A possible reading of the columns of a path, together with one of the attitude."""

    unit: str
    attitude: Attitude
    doubt: float  # nats against it; only differences between readings of a path matter
    why: str

    @property
    def words(self) -> str:
        """Unit, and the attitude's reading if there are several."""
        way = self.attitude.words
        return f"'{self.unit}'" + (f" with {way}" if way else "")


class Lean(NamedTuple):
    """The relation between a path's acceleration and the tilt of an attitude."""

    size: float  # root mean square acceleration by tilt [m/s^2]
    times: float  # ratio of the path's acceleration, in its unit, to that by tilt; 0: unknown
    correlation: float  # of the two accelerations
    nats: float  # evidence for their correlation


NO_LEAN = Lean(0.0, 0.0, 0.0, 0.0)


def readings(
    time: ndarray, path: ndarray, units: Iterable[str], attitudes: Iterable[Attitude]
) -> list[PathReading]:
    """Return all readings of a path, the likeliest first.

    In level flight, a tilt causes an acceleration of about g sin(tilt); a thrown object falls with
    g; and a path is within a hall.

    Args:
        time: Stamps of the path [s], shape (T,).
        path: Path in its unknown unit, shape (T, 3).
        units: Units of length to try.
        attitudes: Readings of the vehicle's attitude.
    """
    reach = np.nanmax(np.abs(path))
    in_hall = fitting_units(reach, units, *_HALL)
    fall = find_unit_by_fall(time, path)
    leans = [_weigh_by_lean(time, path, way) for way in attitudes]
    together = defaultdict(float)  # best evidence by kind, over units of angles
    for attitude, lean in zip(attitudes, leans):
        together[attitude.kind] = max(together[attitude.kind], lean.nats)
    decades = []  # log10 ratios of the path's acceleration in a unit to that by tilt
    for lean, unit in product(leans, units):
        if lean.times > 0.0:
            decades.append(abs(np.log10(UNITS[unit][1] * lean.times)))
    leaning = min(decades, default=np.inf) < _DECADES and max(x.size for x in leans) > _LEANS
    correlation = max((lean.correlation for lean in leans if lean.nats >= SURE), default=0.0)
    leaning = leaning and correlation > 0.0
    slack = -np.log(correlation) if leaning else 0.0  # change of the log ratio by noise
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
                why = f"{unit} by gravity: its acceleration is {times:.2g} times that by its tilt"
            elif fall:
                why = f"{unit} by gravity: a part of it falls freely"
            listed.append(PathReading(unit, attitude, doubt, why))
    return sorted(listed, key=lambda reading: reading.doubt)


def _weigh_by_lean(time: ndarray, path: ndarray, attitude: Attitude) -> Lean:
    """Compare a path's acceleration with the one that an attitude's tilt causes."""
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
    """Return the nats against a log ratio by its distance in standard deviations (Huber's loss)."""
    near = min(abs(deviations), _FAR)
    return near * (abs(deviations) - 0.5 * near)


def turn_to(axes: str) -> ndarray:
    """Return the matrix that rotates row vectors from a source's axes to this project's."""
    return turn_of(axes or OURS).T


def find_unit_by_fall(time: ndarray, path: ndarray) -> str:
    """Find the unit in which a part of a path is in free fall, with gravity along one axis only; ""
    if there is none.
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
    """Find the unit of a thrust in which it carries the weighed mass.

    Args:
        carried: Mass that the thrust carries if it is in newtons [kg].
        weighed: Mass of the vehicle [kg]; a payload and the battery's charge may change the carried
            mass by less than a factor of e.
        units: Units to try.

    Returns:
        The unit, "" if there is none.
    """
    unit, miss = nearest_unit(carried / weighed, units)
    return unit if miss < MASS_BAD else ""


def select_rising(time: ndarray, path: ndarray) -> Samples:
    """Return the finite rows of a path at which the clock moves forward."""
    rows = forward_rows(np.where(np.isfinite(path).all(1), time, np.nan))
    return Samples(time[rows], path[rows])

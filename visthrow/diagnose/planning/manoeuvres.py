"""Safe flights that separate causes: references of position, heading and what is added to the
commands, 50 times a second.

A pilot or controller follows the position; doublets and thrust steps are added to its commands.
Each stays within a box of a few metres and leaves the payload well below the rotors;
:meth:`Manoeuvre.limits` says when to abort."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from io import StringIO
from typing import Any

import numpy as np
from numpy import ndarray
from numpy.polynomial import Polynomial

from visthrow.common.errors import DiagnoseError, expect_known
from visthrow.common.toml_text import tables_beside

PERIOD = 0.02  # between two rows of a reference [s]: the paper's command rate
SETTLE = 1.0  # hover before and after [s]
# height of most manoeuvres above the floor [m]: out of ground effect, the payload 1.2 m up
HEIGHT = 1.5


@dataclass(frozen=True)
class Manoeuvre:
    """One flight: N rows of a reference, ``PERIOD`` apart, from the start of the hover before it to
    the end of that after it.
    """

    name: str
    purpose: str
    seconds: float  # with SETTLE at both ends
    pos_w: ndarray  # [m], shape (N, 3)
    yaw: ndarray  # [rad], shape (N,)
    rates_b: ndarray  # added to the commanded body rates [rad/s], shape (N, 3)
    thrust_factor: ndarray  # on the commanded thrust, shape (N,)
    release: ndarray  # bool, shape (N,)
    payload: bool = True

    @property
    def time(self) -> ndarray:
        """Times of the rows [s], shape (N,)."""
        return times_of(self.seconds)

    @cached_property
    def vel_w(self) -> ndarray:
        """[m/s], shape (N, 3)."""
        return np.gradient(self.pos_w, PERIOD, axis=0)

    @property
    def lowest(self) -> float:
        """Return the height at which a flight is aborted [m]."""
        low = self.pos_w[:, 2].min()
        return max(0.05, low - min(0.3, 0.5 * low))

    @property
    def file(self) -> str:
        """Name of the file that holds its reference."""
        return "".join(c if c.isalnum() else "_" for c in self.name) + ".csv"

    def limits(self) -> str:
        """Return when to abort, in words."""
        low = self.pos_w.min(0) - 0.5
        high = self.pos_w.max(0) + 0.5
        speed = np.linalg.norm(self.vel_w, axis=1).max()
        return (
            f"x {low[0]:.1f}..{high[0]:.1f}, y {low[1]:.1f}..{high[1]:.1f}, z"
            f" {self.lowest:.2f}..{high[2]:.1f} m, {1.5 * speed + 0.5:.1f} m/s, 60 deg of tilt"
        )

    def csv(self) -> str:
        """The reference as a table with units in its header."""
        header = (
            "time [s],x_w [m],y_w [m],z_w [m],vx_w [m/s],vy_w [m/s],vz_w [m/s],yaw [rad],added"
            " rate_x_b [rad/s],added rate_y_b [rad/s],added rate_z_b [rad/s],thrust factor,release"
        )
        columns = (self.time, self.pos_w, self.vel_w, self.yaw, self.rates_b)
        rows = np.column_stack((*columns, self.thrust_factor, self.release))
        table = StringIO()
        np.savetxt(table, rows, "%.5g", ",", header=header, comments="")
        return table.getvalue()


def times_of(seconds: float) -> ndarray:
    """Return the times of a manoeuvre's rows [s]."""
    return np.arange(0.0, seconds - 0.5 * PERIOD, PERIOD)


def moving_times(seconds: float) -> ndarray:
    """Return the times after SETTLE of a manoeuvre's rows [s], those in the hover before and after
    at the ends of its motion.
    """
    return np.clip(times_of(seconds) - SETTLE, 0.0, seconds - 2.0 * SETTLE)


def _share(t: ndarray, begin: float, length: float) -> ndarray:
    """Return the share of a stretch that is over, 0 to 1."""
    return np.clip((t - begin) / length, 0.0, 1.0)


RISE = Polynomial([0.0, 0.0, 0.0, 10.0, -15.0, 6.0])
"""From 0 at 0 to 1 at 1, with speed and acceleration 0 at both ends."""


def rise(t: ndarray, begin: float, length: float) -> ndarray:
    """Return a rise from 0 to 1 over a stretch."""
    return RISE(_share(t, begin, length))


def _doublets(t: ndarray) -> ndarray:
    """Rates of 3 rad/s about roll, pitch and yaw in turn, every 0.8 s, 0.08 s there and back."""
    out = np.zeros((len(t), 3))
    number, phase = np.divmod(t, 0.8)
    rows = np.arange(len(t))
    out[rows, number.astype(int) % 3] = 3.0 * _pulse(phase, 0.08)
    return out


def _pulse(phase: ndarray, width: float) -> ndarray:
    """Return 1 for a time and -1 for as long after it, then 0."""
    forth = phase < width
    back = (phase >= width) & (phase < 2.0 * width)
    return 1.0 * forth - back


def _steps(t: ndarray) -> ndarray:
    """Thrust up and down by 40 %, 0.15 s each way and back, every 1.5 s; the controller brings the
    height back.
    """
    return 1.0 + 0.4 * _pulse(np.mod(t, 1.5), 0.15)


def _integrate_rise(t: ndarray, begin: float, length: float) -> ndarray:
    """Integral of :func:`rise` over time."""
    after = np.maximum(t - begin - length, 0.0)
    return length * RISE.integ()(_share(t, begin, length)) + after


def _stop(t: ndarray) -> ndarray:
    """Gather 1.5 m/s over 1.6 s, stop within 0.3 s, come back slowly: from this speed the rope
    stays taut.
    """
    distance = 1.5 * 0.5 * (1.6 + 0.3)
    velocity = 1.5 * (_integrate_rise(t, 0.0, 1.6) - _integrate_rise(t, 1.6, 0.3))
    return velocity - distance * rise(t, 3.9, 2.5) - 0.5 * distance


def _sine(t: ndarray) -> ndarray:
    """Height that swings by 0.25 m at 0.8 Hz, begun and ended within a second."""
    grown = rise(t, 0.0, 1.0) * (1.0 - rise(t, 5.0, 1.0))
    return HEIGHT + 0.25 * np.sin(2 * np.pi * 0.8 * t) * grown


def _round(t: ndarray) -> ndarray:
    """Angle of two turns in eight seconds."""
    return 4.0 * np.pi * rise(t, 0.0, 8.0)


SHAPES: dict[str, Callable[[ndarray], ndarray]] = {
    "sine": _sine,
    "stop": _stop,
    "cosine": lambda t: np.cos(_round(t)),
    "turning sine": lambda t: np.sin(_round(t)),
    "doublets": _doublets,
    "steps": _steps,
}
"""What the table of manoeuvres names."""


def _along(shape: Any, t: ndarray) -> ndarray:
    """Return values at times [s] of a named shape, or of a value and its rises, each with its size,
    its begin and its length [s].
    """
    if isinstance(shape, str):
        return SHAPES[shape](t)
    start, *rises = shape if isinstance(shape, list) else [shape]
    total = start + 0.0 * t
    for size, begin, length in rises:
        total = total + size * rise(t, begin, length)
    return total


def _manoeuvre(
    name: str,
    purpose: str,
    seconds: float,
    *,
    x: Any = 0.0,
    y: Any = 0.0,
    z: Any = HEIGHT,
    yaw: Any = 0.0,
    thrust: Any = 1.0,
    rates: str | None = None,
    release: float = np.inf,
    payload: bool = True,
) -> Manoeuvre:
    """Return a manoeuvre of a row of the table, whose shapes :func:`_along` reads."""
    time = times_of(seconds)
    t = moving_times(seconds)
    pos_w = np.column_stack([_along(axis, t) for axis in (x, y, z)])
    factor = _along(thrust, t)
    added = SHAPES[rates](t) if rates else np.zeros((len(t), 3))
    moving = (time > SETTLE) & (time < seconds - SETTLE)
    factor[~moving] = 1.0
    added[~moving] = 0.0
    released = time - SETTLE >= release
    heading = _along(yaw, t)
    return Manoeuvre(name, purpose, seconds, pos_w, heading, added, factor, released, payload)


def catalogue() -> tuple[Manoeuvre, ...]:
    """All manoeuvres, in the order in which they would be flown on a day."""
    return tuple(_manoeuvre(name, **row) for name, row in tables_beside(__file__).items())


def named(names: Iterable[str]) -> list[Manoeuvre]:
    """Return the manoeuvres of these names, in their order.

    Raises DiagnoseError for one that the catalogue does not hold.
    """
    names = list(names)
    by_name = {m.name: m for m in catalogue()}
    expect_known(names, by_name, "no manoeuvre '{}'", DiagnoseError)
    return [by_name[name] for name in names]

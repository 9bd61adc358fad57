"""Safe manoeuvres that separate effects: references of position, heading and additions to the
commands, at 50 Hz.

A pilot or controller follows the position; doublets and thrust steps are added to its commands.
Each manoeuvre stays within a box of a few metres, and its payload stays well below the rotors.
:meth:`Manoeuvre.limits` states when to abort."""

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

PERIOD = 0.02  # time between rows of a reference [s]: the paper's command rate
SETTLE = 1.0  # hover before and after the motion [s]
# height of most manoeuvres above the floor [m]: out of ground effect, the payload 1.2 m up
HEIGHT = 1.5


@dataclass(frozen=True)
class Manoeuvre:
    """A manoeuvre: a reference of N rows, ``PERIOD`` apart, including the hover before and after
    the motion.
    """

    name: str
    purpose: str
    seconds: float  # duration, including SETTLE at both ends
    pos_w: ndarray  # [m], shape (N, 3)
    yaw: ndarray  # [rad], shape (N,)
    rates_b: ndarray  # added to the commanded body rates [rad/s], shape (N, 3)
    thrust_factor: ndarray  # on the commanded thrust, shape (N,)
    release: ndarray  # bool, shape (N,)
    payload: bool = True

    @property
    def time(self) -> ndarray:
        """Return the times of the rows [s], shape (N,)."""
        return times_of(self.seconds)

    @cached_property
    def vel_w(self) -> ndarray:
        """Return the velocity of the reference [m/s], shape (N, 3)."""
        return np.gradient(self.pos_w, PERIOD, axis=0)

    @property
    def lowest(self) -> float:
        """Return the height at which a flight is aborted [m]."""
        low = self.pos_w[:, 2].min()
        return max(0.05, low - min(0.3, 0.5 * low))

    @property
    def file(self) -> str:
        """Return the name of the file for the reference."""
        return "".join(c if c.isalnum() else "_" for c in self.name) + ".csv"

    def limits(self) -> str:
        """Return in words the limits beyond which to abort."""
        low = self.pos_w.min(0) - 0.5
        high = self.pos_w.max(0) + 0.5
        speed = np.linalg.norm(self.vel_w, axis=1).max()
        return (
            f"x {low[0]:.1f}..{high[0]:.1f}, y {low[1]:.1f}..{high[1]:.1f}, z"
            f" {self.lowest:.2f}..{high[2]:.1f} m, {1.5 * speed + 0.5:.1f} m/s, 60 deg of tilt"
        )

    def csv(self) -> str:
        """Return the reference as a CSV table with units in its header."""
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
    """Return the times of a manoeuvre's rows since the start of its motion [s], clipped to the
    motion during the hover before and after.
    """
    return np.clip(times_of(seconds) - SETTLE, 0.0, seconds - 2.0 * SETTLE)


def _share(t: ndarray, begin: float, length: float) -> ndarray:
    """Return the elapsed share of an interval, 0 to 1."""
    return np.clip((t - begin) / length, 0.0, 1.0)


RISE = Polynomial([0.0, 0.0, 0.0, 10.0, -15.0, 6.0])
"""Polynomial from 0 at 0 to 1 at 1, whose first two derivatives are 0 at both ends."""


def rise(t: ndarray, begin: float, length: float) -> ndarray:
    """Return a smooth rise from 0 to 1 over an interval of time."""
    return RISE(_share(t, begin, length))


def _doublets(t: ndarray) -> ndarray:
    """Return rate doublets of 3 rad/s about roll, pitch and yaw in turn, one every 0.8 s, 0.08 s in
    each direction; shape (N, 3).
    """
    out = np.zeros((len(t), 3))
    number, phase = np.divmod(t, 0.8)
    rows = np.arange(len(t))
    out[rows, number.astype(int) % 3] = 3.0 * _pulse(phase, 0.08)
    return out


def _pulse(phase: ndarray, width: float) -> ndarray:
    """Return 1 during ``width``, -1 for as long after it, then 0."""
    forth = phase < width
    back = (phase >= width) & (phase < 2.0 * width)
    return 1.0 * forth - back


def _steps(t: ndarray) -> ndarray:
    """Return a factor on the thrust of 1.4, then 0.6, for 0.15 s each, every 1.5 s; the controller
    restores the height.
    """
    return 1.0 + 0.4 * _pulse(np.mod(t, 1.5), 0.15)


def _integrate_rise(t: ndarray, begin: float, length: float) -> ndarray:
    """Return the integral of :func:`rise` over time [s]."""
    after = np.maximum(t - begin - length, 0.0)
    return length * RISE.integ()(_share(t, begin, length)) + after


def _stop(t: ndarray) -> ndarray:
    """Return a path that accelerates to 1.5 m/s over 1.6 s, stops within 0.3 s and returns slowly
    [m]; from this speed the rope stays taut.
    """
    distance = 1.5 * 0.5 * (1.6 + 0.3)
    velocity = 1.5 * (_integrate_rise(t, 0.0, 1.6) - _integrate_rise(t, 1.6, 0.3))
    return velocity - distance * rise(t, 3.9, 2.5) - 0.5 * distance


def _sine(t: ndarray) -> ndarray:
    """Return a height [m] that oscillates by 0.25 m at 0.8 Hz, faded in and out over a second."""
    grown = rise(t, 0.0, 1.0) * (1.0 - rise(t, 5.0, 1.0))
    return HEIGHT + 0.25 * np.sin(2 * np.pi * 0.8 * t) * grown


def _round(t: ndarray) -> ndarray:
    """Return the angle of two turns in eight seconds [rad]."""
    return 4.0 * np.pi * rise(t, 0.0, 8.0)


SHAPES: dict[str, Callable[[ndarray], ndarray]] = {
    "sine": _sine,
    "stop": _stop,
    "cosine": lambda t: np.cos(_round(t)),
    "turning sine": lambda t: np.sin(_round(t)),
    "doublets": _doublets,
    "steps": _steps,
}
"""Shapes that the table of manoeuvres refers to by name."""


def _evaluate_shape(shape: Any, t: ndarray) -> ndarray:
    """Return the values of a shape at times [s].

    ``shape``: a name of :data:`SHAPES`; a constant; or a start value and rises, each with its size,
    start [s] and duration [s].
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
    """Make a manoeuvre from a row of the table, whose shapes :func:`_along` reads."""
    time = times_of(seconds)
    t = moving_times(seconds)
    pos_w = np.column_stack([_evaluate_shape(axis, t) for axis in (x, y, z)])
    factor = _evaluate_shape(thrust, t)
    added = SHAPES[rates](t) if rates else np.zeros((len(t), 3))
    moving = (time > SETTLE) & (time < seconds - SETTLE)
    factor[~moving] = 1.0
    added[~moving] = 0.0
    released = time - SETTLE >= release
    heading = _evaluate_shape(yaw, t)
    return Manoeuvre(name, purpose, seconds, pos_w, heading, added, factor, released, payload)


def catalogue() -> tuple[Manoeuvre, ...]:
    """Return all manoeuvres, in the order in which to fly them on one day."""
    return tuple(_manoeuvre(name, **row) for name, row in tables_beside(__file__).items())


def select_manoeuvres(names: Iterable[str]) -> list[Manoeuvre]:
    """Return the manoeuvres of these names, in the order of the names.

    Raises DiagnoseError: the catalogue has no manoeuvre of a name.
    """
    names = list(names)
    by_name = {m.name: m for m in catalogue()}
    expect_known(names, by_name, "no manoeuvre '{}'", DiagnoseError)
    return [by_name[name] for name in names]

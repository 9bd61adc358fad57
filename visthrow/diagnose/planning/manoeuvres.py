"""Safe flights that separate causes: references of position, heading and what is added to the
commands, 50 times a second.

A pilot or controller follows the position; doublets and thrust steps are added to its commands.
Each stays within a box of a few metres and leaves the payload well below the rotors;
:meth:`Reference.limits` says when to abort."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from visthrow.common.toml_text import tables_beside

PERIOD = 0.02  # between two rows of a reference [s]: the paper's command rate
SETTLE = 1.0  # hover before and after [s]
# height of most manoeuvres above the floor [m]: out of ground effect, the payload 1.2 m up
HEIGHT = 1.5


@dataclass(frozen=True)
class Reference:
    """Rows of a manoeuvre, N of them."""

    time: np.ndarray  # [s], shape (N,)
    pos_w: np.ndarray  # [m], shape (N, 3)
    yaw: np.ndarray  # [rad], shape (N,)
    rates_b: np.ndarray  # added to the commanded body rates [rad/s], shape (N, 3)
    thrust_factor: np.ndarray  # on the commanded thrust, shape (N,)
    release: np.ndarray  # bool, shape (N,)

    @cached_property
    def vel_w(self) -> np.ndarray:
        """[m/s], shape (N, 3)."""
        return np.gradient(self.pos_w, PERIOD, axis=0)

    @cached_property
    def acc_w(self) -> np.ndarray:
        """[m/s^2], shape (N, 3)."""
        return np.gradient(self.vel_w, PERIOD, axis=0)

    @property
    def lowest(self) -> float:
        """Return the height at which a flight is aborted [m]."""
        low = self.pos_w[:, 2].min()
        return max(0.05, low - min(0.3, 0.5 * low))

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
        lines = [header]
        for row in rows:
            lines.append(",".join(f"{value:.5g}" for value in row))
        return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class Manoeuvre:
    """One flight."""

    name: str
    purpose: str
    seconds: float  # with SETTLE at both ends
    path: Callable[
        [np.ndarray], np.ndarray
    ]  # of the time after SETTLE [s], shape (N,), to a place [m], shape (N, 3)
    yaw: Callable[[np.ndarray], np.ndarray] = field(default=lambda t: np.zeros_like(t))
    rates: Callable[[np.ndarray], np.ndarray] = field(default=lambda t: np.zeros((len(t), 3)))
    thrust: Callable[[np.ndarray], np.ndarray] = field(default=lambda t: np.ones_like(t))
    release: float = np.inf  # [s] after SETTLE
    payload: bool = True

    @property
    def file(self) -> str:
        """Name of the file that holds its reference."""
        return "".join(c if c.isalnum() else "_" for c in self.name) + ".csv"

    def reference(self) -> Reference:
        """Rows from the start of the hover before it to the end of that after it."""
        time = np.arange(0.0, self.seconds - 0.5 * PERIOD, PERIOD)
        inner = np.clip(time - SETTLE, 0.0, self.seconds - 2.0 * SETTLE)
        moving = (time > SETTLE) & (time < self.seconds - SETTLE)
        rates = np.where(moving[:, None], self.rates(inner), 0.0)
        thrust = np.where(moving, self.thrust(inner), 1.0)
        path = self.path(inner)
        yaw = self.yaw(inner)
        release = time - SETTLE >= self.release
        return Reference(time, path, yaw, rates, thrust, release)


def rise(t: np.ndarray, begin: float, length: float) -> np.ndarray:
    """Return a rise from 0 to 1 with speed and acceleration 0 at both ends."""
    s = np.clip((t - begin) / length, 0.0, 1.0)
    return s**3 * (10.0 + s * (-15.0 + 6.0 * s))


def _doublets(t: np.ndarray) -> np.ndarray:
    """Rates of 3 rad/s about roll, pitch and yaw in turn, every 0.8 s, 0.08 s there and back."""
    out = np.zeros((len(t), 3))
    number = np.floor(t / 0.8).astype(int)
    phase = np.mod(t, 0.8)
    out[np.arange(len(t)), number % 3] = 3.0 * (1.0 * (phase < 0.08) - _between(phase, 0.08, 0.16))
    return out


def _between(t: np.ndarray, begin: float, end: float) -> np.ndarray:
    return (t >= begin) & (t < end)


def _steps(t: np.ndarray) -> np.ndarray:
    """Thrust up and down by 40 %, 0.15 s each way and back, every 1.5 s; the controller brings the
    height back.
    """
    phase = np.mod(t, 1.5)
    return 1.0 + 0.4 * ((phase < 0.15) * 1.0 - _between(phase, 0.15, 0.3))


def _risen(t: np.ndarray, begin: float, length: float) -> np.ndarray:
    """Integral of :func:`rise` over time."""
    s = np.clip((t - begin) / length, 0.0, 1.0)
    return length * s**4 * (2.5 + s * (-3.0 + s)) + np.maximum(t - begin - length, 0.0)


def _stop(t: np.ndarray) -> np.ndarray:
    """Gather 1.5 m/s over 1.6 s, stop within 0.3 s, come back slowly: from this speed the rope
    stays taut.
    """
    distance = 1.5 * 0.5 * (1.6 + 0.3)
    velocity = 1.5 * (_risen(t, 0.0, 1.6) - _risen(t, 1.6, 0.3))
    return velocity - distance * rise(t, 3.9, 2.5) - 0.5 * distance


def _sine(t: np.ndarray) -> np.ndarray:
    """Height that swings by 0.25 m at 0.8 Hz, begun and ended within a second."""
    grown = rise(t, 0.0, 1.0) * (1.0 - rise(t, 5.0, 1.0))
    return HEIGHT + 0.25 * np.sin(2 * np.pi * 0.8 * t) * grown


def _round(t: np.ndarray) -> np.ndarray:
    """Angle of two turns in eight seconds."""
    return 4.0 * np.pi * rise(t, 0.0, 8.0)


SHAPES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "sine": _sine,
    "stop": _stop,
    "cosine": lambda t: np.cos(_round(t)),
    "turning sine": lambda t: np.sin(_round(t)),
    "doublets": _doublets,
    "steps": _steps,
}
"""What the table of manoeuvres names."""


def _along(shape: Any) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function of time: a named shape, or a value and its rises, each with its size, its
    begin and its length [s].
    """
    if isinstance(shape, str):
        return SHAPES[shape]
    start, *rises = shape if isinstance(shape, list) else [shape]

    def along(t: np.ndarray) -> np.ndarray:
        total = start + 0.0 * t
        for size, *span in rises:
            total = total + size * rise(t, *span)
        return total

    return along


def _manoeuvre(name: str, row: dict[str, Any]) -> Manoeuvre:
    axes = [_along(row.pop(a, default)) for a, default in zip("xyz", (0.0, 0.0, HEIGHT))]
    shapes = {key: _along(row.pop(key)) for key in ("yaw", "rates", "thrust") if key in row}

    def path(t: np.ndarray) -> np.ndarray:
        return np.column_stack([axis(t) for axis in axes])

    return Manoeuvre(name, path=path, **shapes, **row)


def catalogue() -> tuple[Manoeuvre, ...]:
    """All manoeuvres, in the order in which they would be flown on a day."""
    return tuple(_manoeuvre(name, row) for name, row in tables_beside(__file__).items())

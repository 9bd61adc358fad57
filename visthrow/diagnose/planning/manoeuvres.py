"""Safe flights that separate causes: references of position, heading and what is added to the
commands, 50 times a second.

A pilot or controller follows the position; doublets and thrust steps are added to its commands.
Each stays within a box of a few metres and leaves the payload well below the rotors;
:meth:`Reference.limits` says when to abort."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

PERIOD = 0.02  # between two rows of a reference [s]: the paper's command rate
SETTLE = 1.0  # hover before and after [s]
# height of most manoeuvres above the floor [m]: out of ground effect, the payload 1.2 m up
HEIGHT = 1.5

RUN = 3.6
"""Way of a throw from rest to rest [m], released half way: over a shorter one the payload would
trail as high as the rotors.
"""


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
        low = float(self.pos_w[:, 2].min())
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
        rows = np.column_stack(
            (
                self.time,
                self.pos_w,
                self.vel_w,
                self.yaw,
                self.rates_b,
                self.thrust_factor,
                self.release,
            )
        )
        return (
            "\n".join([header, *(",".join(f"{value:.5g}" for value in row) for row in rows)]) + "\n"
        )


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
        return Reference(
            time, self.path(inner), self.yaw(inner), rates, thrust, time - SETTLE >= self.release
        )


def rise(t: np.ndarray, begin: float, length: float) -> np.ndarray:
    """Return a rise from 0 to 1 with speed and acceleration 0 at both ends."""
    s = np.clip((t - begin) / length, 0.0, 1.0)
    return s**3 * (10.0 + s * (-15.0 + 6.0 * s))


def _hold_at(x=0.0, y=0.0, z=HEIGHT) -> Callable[[np.ndarray], np.ndarray]:
    def path(t: np.ndarray) -> np.ndarray:
        parts = [part(t) if callable(part) else np.full_like(t, part) for part in (x, y, z)]
        return np.column_stack(parts)

    return path


def _passes(
    length: float, speeds: tuple[float, ...]
) -> tuple[Callable[[np.ndarray], np.ndarray], float]:
    """Back and forth over a length, each way in the time that its mean speed takes, a second
    between.
    """

    def position(t: np.ndarray) -> np.ndarray:
        value = np.zeros_like(t)
        begin = 0.0
        forth = 1.0
        for speed in speeds:
            value += forth * length * rise(t, begin, length / speed)
            begin = begin + length / speed + 1.0
            forth = -forth
        return value - 0.5 * length

    return position, sum(length / speed + 1.0 for speed in speeds)


def _doublets(size: float, width: float) -> Callable[[np.ndarray], np.ndarray]:
    """Roll, pitch and yaw in turn, every 0.8 s, there and back."""

    def rates(t: np.ndarray) -> np.ndarray:
        out = np.zeros((len(t), 3))
        number = np.floor(t / 0.8).astype(int)
        phase = np.mod(t, 0.8)
        value = size * ((phase < width) * 1.0 - ((phase >= width) & (phase < 2 * width)))
        out[np.arange(len(t)), number % 3] = value
        return out

    return rates


def _steps(t: np.ndarray) -> np.ndarray:
    """Thrust up and down by 40 %, 0.15 s each way and back, every 1.5 s; the controller brings the
    height back.
    """
    phase = np.mod(t, 1.5)
    return 1.0 + 0.4 * ((phase < 0.15) * 1.0 - ((phase >= 0.15) & (phase < 0.3)))


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


def _run(speed: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda t: RUN * rise(t, 0.0, RUN * 1.875 / speed) - 0.5 * RUN


def _round(t: np.ndarray) -> np.ndarray:
    """Angle of two turns in eight seconds."""
    return 4.0 * np.pi * rise(t, 0.0, 8.0)


def _turns(t: np.ndarray) -> np.ndarray:
    return 0.5 * np.pi * sum(rise(t, 2.0 + 3.0 * i, 1.0) for i in range(4))


def catalogue() -> tuple[Manoeuvre, ...]:
    """All manoeuvres, in the order in which they would be flown on a day."""
    slow, slow_time = _passes(3.0, (0.8, 0.8, 1.2, 1.2))
    fast, fast_time = _passes(4.8, (1.6, 1.6, 1.9, 1.9))
    runs = tuple(
        Manoeuvre(
            f"throw at {speed:.0f} m/s",
            "when the payload leaves, at several speeds and pulls",
            2.8 + RUN * 1.875 / speed,
            _hold_at(x=_run(speed), z=1.7),
            release=0.5 * RUN * 1.875 / speed,
        )
        for speed in (2.0, 3.0, 4.0)
    )
    return (
        Manoeuvre(
            "hover", "thrust against weight, battery, frame against gravity", 8.0, _hold_at()
        ),
        Manoeuvre(
            "hover without payload",
            "thrust against the vehicle's weight alone",
            7.0,
            _hold_at(),
            payload=False,
        ),
        Manoeuvre(
            "hover low without payload",
            "ground effect",
            11.0,
            _hold_at(
                z=lambda t: (
                    0.6
                    - 0.3 * rise(t, 0.0, 1.5)
                    - 0.15 * rise(t, 4.0, 1.0)
                    - 0.04 * rise(t, 6.5, 0.7)
                )
            ),
            payload=False,
        ),
        Manoeuvre(
            "vertical sine",
            "drag and inflow along the rotors' axis, delay against clock",
            8.0,
            _hold_at(
                z=lambda t: (
                    HEIGHT
                    + 0.25
                    * np.sin(2 * np.pi * 0.8 * t)
                    * rise(t, 0.0, 1.0)
                    * (1.0 - rise(t, 5.0, 1.0))
                )
            ),
        ),
        Manoeuvre("thrust steps", "motor lag, thrust curve", 8.0, _hold_at(), thrust=_steps),
        Manoeuvre(
            "rate doublets",
            "motor lag, rate controller, inertia, delay",
            8.0,
            _hold_at(),
            rates=_doublets(3.0, 0.08),
        ),
        Manoeuvre(
            "yaw turns",
            "centre of mass and markers (turn along) against frame and wind (stay)",
            16.0,
            _hold_at(),
            yaw=_turns,
        ),
        Manoeuvre(
            "slow passes x",
            "drag along x, both ways: wind against drag",
            2.0 + slow_time,
            _hold_at(x=slow),
        ),
        Manoeuvre("slow passes y", "drag along y, both ways", 2.0 + slow_time, _hold_at(y=slow)),
        Manoeuvre(
            "fast passes x",
            "drag that grows with the square of the speed, lift by translation",
            2.0 + fast_time,
            _hold_at(x=fast),
        ),
        Manoeuvre(
            "circle",
            "drag in all directions, lever arms",
            10.0,
            _hold_at(x=lambda t: np.cos(_round(t)), y=lambda t: np.sin(_round(t))),
        ),
        Manoeuvre(
            "swing and decay",
            "rope length by period, damping by decay, payload drag",
            9.0,
            _hold_at(x=lambda t: 0.35 * rise(t, 0.0, 0.8)),
        ),
        Manoeuvre(
            "stop after speed",
            "rope mass and bending, payload's second mode, mount",
            9.0,
            _hold_at(x=_stop),
        ),
        *runs,
    )

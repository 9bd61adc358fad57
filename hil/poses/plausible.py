"""Physics against wrong units: what vehicles and payloads cannot do, and where two quantities of a source disagree.

A position in millimetres read as metres, an angle in degrees read as radians or a time in milliseconds read as seconds gives
numbers that no gate can tell from a far hall or a calm flight one by one; over a recording they give themselves away.
"""

import math
from collections.abc import Iterable

import numpy as np

from hil.poses.frames import FrameParams, Frames
from hil.poses.pose import PAYLOAD, VEHICLE, Pose
from visthrow.onboard.hover import GRAVITY

FASTEST = 40.0
"""No multirotor with a payload indoors is faster for half of a recording [m/s]."""
LARGEST = 500.0
"""Nor is a hall wider [m]."""
CABLE = (0.01, 30.0)
"""Between vehicle and payload, median [m]."""
PERIOD = (2e-4, 2.0)
"""Between two poses, median [s]."""
STEEPEST = math.radians(75.0)
"""Median tilt of a flight [rad]."""
SPAN = 0.1
"""Over which speeds are taken [s]: noise of millimetres is then centimetres a second."""
SIGNAL = {"velocity": 0.05, "body rate": 0.1, "tilt": 0.02}
"""RMS that one of two quantities must have before they are compared [m/s], [rad/s], [rad]."""
AGREES = 0.8
"""Correlation from which two quantities are the same but for a factor."""
FACTORS = {1e3: "1000", 1e-3: "1/1000", 1e2: "100", 1e-2: "1/100", math.degrees(1.0): "57.3", math.radians(1.0): "1/57.3"}
NEAR = 1.6
"""A factor counts as one of these within this ratio: cables pull, drag brakes, and a filter smooths."""
LEAST = 20
"""Poses below which nothing is said."""


def unit_problems(poses: Iterable[Pose], frames: dict[str, FrameParams]) -> list[str]:
    """What in the poses of a recording no vehicle does; each says which unit would make sense of it.

    Args:
        poses: raw, of all bodies.
        frames: of each body.
    """
    tables = {name: _Table([p for p in poses if p.body == name], Frames(f)) for name, f in frames.items()}
    known = {name: table for name, table in tables.items() if len(table.times) >= LEAST}
    problems = [text for name, table in known.items() for text in table.problems(name)]
    if not problems and {VEHICLE, PAYLOAD} <= set(known):
        apart = known[VEHICLE].distance(known[PAYLOAD])
        if not CABLE[0] <= apart <= CABLE[1]:
            problems.append(
                f"vehicle and payload are {apart:.3g} m apart, expected {CABLE[0]:g} to {CABLE[1]:g}: is the unit of a "
                "position wrong (mm given as m, or m as mm)?"
            )
    return problems


class _Table:
    """Poses of one body as arrays, in our frames."""

    def __init__(self, poses: list[Pose], frames: Frames) -> None:
        ours = [frames.pose_from_source(p) for p in poses if all(map(math.isfinite, (p.stamp, p.arrival, *p.pos)))]
        # A clock may be set in between: stamps that do not ascend are left to the gate.
        ours = [p for p, before in zip(ours, [None, *ours]) if before is None or p.stamp > before.stamp]
        self.times = np.array([p.stamp for p in ours])
        self.pos = np.array([p.pos for p in ours]).reshape(-1, 3)
        self.quat, self.vel, self.rate = (
            None if any(getattr(p, name) is None for p in ours) else np.array([getattr(p, name) for p in ours])
            for name in ("quat", "vel", "rate")
        )

    def distance(self, other: "_Table") -> float:
        """Median distance from another body at the same times [m]."""
        there = np.column_stack([np.interp(self.times, other.times, other.pos[:, i]) for i in range(3)])
        return float(np.median(np.linalg.norm(self.pos - there, axis=1)))

    def problems(self, name: str) -> list[str]:
        """What this body cannot do."""
        period = float(np.median(np.diff(self.times)))
        if not PERIOD[0] <= period <= PERIOD[1]:
            return [f"{name}: a pose every {period:.3g} s, expected {PERIOD[0]:g} to {PERIOD[1]:g}: is the unit of time wrong?"]
        width = float(np.ptp(self.pos, axis=0).max())
        speed = float(np.median(np.linalg.norm(self._slope(self.pos), axis=1)))
        if speed > FASTEST or width > LARGEST:
            return [
                f"{name}: its positions span {width:.3g} m at a median speed of {speed:.3g} m/s, expected below {LARGEST:g} m and "
                f"{FASTEST:g} m/s: are they millimetres given as 'm', or is the unit of time wrong?"
            ]
        return [text for text in (self._velocity(name), self._turning(name), self._tilt(name)) if text is not None]

    def _slope(self, values: np.ndarray) -> np.ndarray:
        """Central differences over about SPAN, shape of values without the ends."""
        n = self._steps()
        return (values[2 * n :] - values[: -2 * n]) / (self.times[2 * n :] - self.times[: -2 * n])[:, None]

    def _steps(self) -> int:
        period = float(np.median(np.diff(self.times)))
        return int(min(max(1, round(SPAN / 2 / period)), (len(self.times) - 1) // 4))

    def _velocity(self, name: str) -> str | None:
        if self.vel is None:
            return None
        n = self._steps()
        found = _factor(self.vel[n:-n].ravel(), self._slope(self.pos).ravel(), SIGNAL["velocity"])
        return None if found is None else f"{name}: its velocity is {found} times the change of its position: wrong unit?"

    def _turning(self, name: str) -> str | None:
        """Size of the given rates against that of the turns; both are the same in every frame and quaternion order."""
        if self.rate is None or self.quat is None:
            return None
        n = self._steps()
        cosine = np.clip(np.abs(np.sum(self.quat[2 * n :] * self.quat[: -2 * n], axis=1)), 0.0, 1.0)
        turned = 2.0 * np.arccos(cosine) / (self.times[2 * n :] - self.times[: -2 * n])
        # Averaged over the same span, so that a shake does not count on one side only.
        weights = np.ones(2 * n + 1) / (2 * n + 1)
        given = np.linalg.norm(np.column_stack([np.convolve(self.rate[:, i], weights, "valid") for i in range(3)]), axis=1)
        found = _factor(given, turned, SIGNAL["body rate"])
        return None if found is None else (
            f"{name}: its body rates are {found} times the turning of its attitude: deg/s given as 'rad/s', or angles in "
            "the other unit?"
        )  # fmt: skip

    def _tilt(self, name: str) -> str | None:
        """A multirotor tilts where it accelerates: its thrust, along body z, carries its weight and pushes it."""
        if name != VEHICLE or self.quat is None:
            return None
        x, y, z, w = self.quat.T
        up = np.column_stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)])
        tilt = float(np.median(np.arccos(np.clip(up[:, 2], -1.0, 1.0))))
        if tilt > STEEPEST:
            return (
                f"{name}: half of the time it is tilted by more than {math.degrees(tilt):.0f} deg: degrees given as 'rad', or "
                "axes or quaternion order wrong? (visthrow hil check --hand-carry finds out)"
            )
        n = self._steps()
        if len(self.times) < 4 * n + LEAST:
            return None
        push = (self.pos[2 * n :] - 2 * self.pos[n:-n] + self.pos[: -2 * n])[:, :2]
        push = push / ((self.times[2 * n :] - self.times[: -2 * n])[:, None] / 2) ** 2 / GRAVITY
        found = _factor(up[n:-n, :2].ravel(), push.ravel(), SIGNAL["tilt"])
        return None if found is None else f"{name}: it tilts {found} times as far as it accelerates: radians given as 'deg'?"


def _factor(given: np.ndarray, expected: np.ndarray, signal: float) -> str | None:
    """By which of the units' factors a quantity is off; None where it is not, or nothing can be said."""
    good = np.isfinite(given) & np.isfinite(expected)
    given, expected = given[good], expected[good]
    if len(given) < LEAST or np.sqrt(max(np.mean(given**2), np.mean(expected**2))) < signal:
        return None
    scale = np.sqrt(np.mean(given**2) * np.mean(expected**2))
    if not scale > 0.0 or np.mean(given * expected) / scale < AGREES:
        return None
    ratio = float(np.sqrt(np.mean(given**2) / np.mean(expected**2)))
    close = min(FACTORS, key=lambda factor: abs(math.log(ratio / factor)))
    return FACTORS[close] if 1 / NEAR < ratio / close < NEAR else None

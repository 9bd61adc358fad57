"""Thrust calibration: conversion of thrust [N] to the share of full thrust that an autopilot
expects, and its measurement in hover.

Around hover the thrust of a vehicle is ``T = W (1 + s (u / h - 1))``: weight W [N] at the share h,
with a slope s relative to a straight line through the origin. Vehicles in software hovered at
shares of 0.37 and 0.49, with slopes of 0.70 to 0.92.

If the autopilot does not linearise the rotors' curve (Betaflight compensates the throttle for its
``thrust_linear``, so only the controller's output is linearised) it is ``T = W (1 + s ((z / z_h)^n
- 1))`` with the motors' command ``z = idle + (1 - idle) u``; n is 2 if thrust is proportional to
the square of that command.

Source: betaflight 4.6, src/main/flight/pid.c, pidApplyThrustLinearization and
pidCompensateThrustLinearization."""

import math
from collections import deque
from dataclasses import dataclass
from typing import Annotated

from visthrow.config.bounds import Bound, Bounded, NotNegative, Positive
from visthrow.onboard.hover import GRAVITY

Share = Annotated[float, Bound(0.0, 1.0, "()")]

LEAST_SHARES = 50  # values that a mean hover share needs: 5 s at 10 Hz
VOLTAGE_RANGE = (
    0.8,
    1.25,
    # ratios beyond these are wrong readings; the correction stops there
)


@dataclass(frozen=True)
class HoverThrustParams(Bounded):
    """The thrust calibration of one vehicle."""

    weight: Positive  # thrust in the calibrated hover [N]
    hover: Share  # share of full thrust in that hover, 0 to 1
    # of the thrust over the share around hover, relative to weight / hover
    slope: Annotated[float, Bound(0.3, 2.0)]
    tolerance: Share  # relative, of a measured hover share; beyond it the runner does not fly
    voltage: NotNegative  # of the battery in that hover [V]; 0: no correction for its voltage
    # of thrust over the motors' command, if the autopilot does not linearise it
    exponent: Annotated[float, Bound(1.0, 3.0)] = 1.0
    idle: Annotated[float, Bound(0.0, 0.5, "[)")] = 0.0  # motors' command at share 0, 0 to 1

    def share(self, thrust: float, voltage: float | None = None) -> float:
        """Return the share of full thrust, 0 to 1, for a thrust [N]; ``voltage``: of the battery
        [V], None if unknown.
        """
        relative = max(0.0, 1.0 + (thrust / self.weight - 1.0) / self.slope) ** (
            1.0 / self.exponent
        )
        share = (relative * self._command(self.hover) - self.idle) / (1.0 - self.idle)
        return min(max(share * self._sag(voltage), 0.0), 1.0)

    def thrust(self, share: float, voltage: float | None = None) -> float:
        """Return the thrust [N] at a share of at least 0; ``voltage``: of the battery [V], None
        if unknown.
        """
        share /= self._sag(voltage)
        relative = (self._command(share) / self._command(self.hover)) ** self.exponent
        return max(0.0, self.weight * (1.0 + self.slope * (relative - 1.0)))

    def _sag(self, voltage: float | None) -> float:
        """Return the factor on the share that a battery's voltage [V] requires."""
        if self.voltage == 0.0 or voltage is None:
            return 1.0
        low, high = VOLTAGE_RANGE
        # Thrust is proportional to the square of the rotor speed, which is proportional to the
        # voltage.
        return min(max(self.voltage / max(voltage, 1e-6), low), high) ** 2

    def _command(self, share: float) -> float:
        return self.idle + (1.0 - self.idle) * share

    @property
    def full_thrust(self) -> float:
        """Thrust at full share [N]."""
        return self.thrust(1.0)


class HoverMeter:
    """A meter of the mean thrust share while the vehicle hovers by itself."""

    def __init__(self, params: HoverThrustParams):
        self.params = params
        self._shares: deque[float] = deque(maxlen=20 * LEAST_SHARES)

    def add(self, share: float | None) -> None:
        """Add a share reported in steady hover; None if there was no report since the last call."""
        if share is not None and math.isfinite(share):
            self._shares.append(share)

    @property
    def share(self) -> float | None:
        """Mean share; None with too few values."""
        return sum(self._shares) / len(self._shares) if len(self._shares) >= LEAST_SHARES else None

    def summary_text(self, mass: float) -> tuple[bool, str]:
        """Compare the mean share with the calibration for a hovering mass [kg]; return whether
        they agree (also true if it was not measured), and a text.
        """
        if self.share is None:
            return (
                True,
                (
                    f"hover share not measured: {len(self._shares)} of {LEAST_SHARES} values in"
                    " steady hover"
                ),
            )
        want = self.params.share(mass * GRAVITY)
        off = self.share / want - 1.0
        text = (
            f"hover share measured {self.share:.3f}, by the config {want:.3f} ({100 * off:+.1f} %, "
            f"{100 * self.params.tolerance:g} % allowed)"
        )
        good = abs(off) <= self.params.tolerance
        return good, (
            text if good else f"{text}; calibrate thrust.hover, or look at battery and propellers"
        )

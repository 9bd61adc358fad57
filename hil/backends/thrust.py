"""Thrust calibration: from newtons to the share of full thrust that an autopilot takes, and its measurement in hover.

Around hover the thrust of a vehicle is ``T = W (1 + s (u / h - 1))``: weight W [N] at the share h, with a slope s relative
to a straight line through the origin. Vehicles in software hovered at shares of 0.37 and 0.49, with slopes of 0.70 to 0.92.

Where the autopilot does not straighten the rotors' curve (Betaflight: its ``thrust_linear`` acts on what the controller puts
out, and takes it off the pilot's throttle again) it is ``T = W (1 + s ((z / z_h)^n - 1))`` with the motors' command
``z = idle + (1 - idle) u``; n is 2 where thrust goes with the square of that command.

Source: betaflight 4.6, src/main/flight/pid.c, pidApplyThrustLinearization and pidCompensateThrustLinearization.
"""

import math
from collections import deque
from dataclasses import dataclass

from visthrow.onboard.hover import GRAVITY

LEAST_SHARES = 50
"""Values that a mean share of hover is taken over: 5 s at 10 Hz."""

VOLTAGE_RANGE = (0.8, 1.25)
"""Voltages further from the calibration's are no battery's, but a wrong reading; the correction stops there."""


@dataclass(frozen=True)
class ThrustParams:
    """The calibration of one vehicle.

    Raises:
        ValueError: a number out of its range.
    """

    weight: float  # thrust of the hover that was measured [N]
    hover: float  # share of full thrust in that hover, 0 to 1
    slope: float  # of the thrust over the share around hover, relative to weight / hover
    tolerance: float  # of a measured share of hover, relative; beyond it the runner does not fly
    voltage: float  # of the battery in that hover [V]; 0: no correction for its voltage
    exponent: float = 1.0  # of thrust over the motors' command, where the autopilot does not straighten it
    idle: float = 0.0  # motors' command at share 0, 0 to 1

    def __post_init__(self) -> None:
        if not (self.weight > 0.0 and 0.0 < self.hover < 1.0 and 0.3 <= self.slope <= 2.0):
            raise ValueError(
                f"thrust: weight {self.weight} N, hover {self.hover}, slope {self.slope}; expected a weight above 0, a share "
                "of hover between 0 and 1, and a slope of 0.3 to 2"
            )
        if not (1.0 <= self.exponent <= 3.0 and 0.0 <= self.idle < 0.5):
            raise ValueError(f"thrust: exponent {self.exponent}, idle {self.idle}; expected 1 to 3, and 0 to below 0.5")
        if not 0.0 < self.tolerance < 1.0 or self.voltage < 0.0:
            raise ValueError(
                f"thrust: tolerance {self.tolerance}, voltage {self.voltage} V; expected above 0 and below 1, and 0 or more"
            )

    def share(self, thrust: float, voltage: float | None = None) -> float:
        """Share of full thrust, 0 to 1, for a thrust [N], at the battery's voltage [V] where it is known."""
        relative = max(0.0, 1.0 + (thrust / self.weight - 1.0) / self.slope) ** (1.0 / self.exponent)
        share = (relative * self._command(self.hover) - self.idle) / (1.0 - self.idle)
        if self.voltage > 0.0 and voltage is not None:
            low, high = VOLTAGE_RANGE
            # Thrust goes with the square of the rotor's speed, and that with the voltage.
            share *= min(max(self.voltage / max(voltage, 1e-6), low), high) ** 2
        return min(max(share, 0.0), 1.0)

    def thrust(self, share: float) -> float:
        """Thrust [N] at a share, at the calibration's voltage; 0 or more."""
        relative = (self._command(share) / self._command(self.hover)) ** self.exponent
        return max(0.0, self.weight * (1.0 + self.slope * (relative - 1.0)))

    def _command(self, share: float) -> float:
        """Motors' command, 0 to 1, at a share."""
        return self.idle + (1.0 - self.idle) * share

    @property
    def most(self) -> float:
        """Thrust at full share [N]."""
        return self.thrust(1.0)


class HoverMeter:
    """Mean share of thrust while the vehicle hovers by itself."""

    def __init__(self, params: ThrustParams) -> None:
        """Start empty."""
        self.params = params
        self._shares: deque[float] = deque(maxlen=20 * LEAST_SHARES)

    def add(self, share: float | None, still: bool) -> None:
        """Take a share; None where the autopilot has said none since the last call, and only those of a still vehicle count."""
        if share is not None and still and math.isfinite(share):
            self._shares.append(share)

    @property
    def share(self) -> float | None:
        """Mean share; None with too few values."""
        return sum(self._shares) / len(self._shares) if len(self._shares) >= LEAST_SHARES else None

    def summary_text(self, mass: float) -> tuple[bool, str]:
        """Compare with the calibration.

        Args:
            mass: that hovered [kg].

        Returns:
            Whether it agrees, or was not measured; and that in words.
        """
        if self.share is None:
            return True, f"hover share not measured: {len(self._shares)} of {LEAST_SHARES} values in steady hover"
        want = self.params.share(mass * GRAVITY)
        off = self.share / want - 1.0
        text = (
            f"hover share measured {self.share:.3f}, by the config {want:.3f} ({100 * off:+.1f} %, "
            f"{100 * self.params.tolerance:g} % allowed)"
        )
        good = abs(off) <= self.params.tolerance
        return good, text if good else f"{text}; calibrate thrust.hover, or look at battery and propellers"

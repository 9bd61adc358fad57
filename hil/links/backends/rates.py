"""Betaflight's rate curves and their inverse, from body rates to stick positions.

Source: betaflight, src/main/fc/rc.c, applyBetaflightRates and applyActualRates; `hil.links.facts`.
"""

import math
from bisect import bisect_left
from dataclasses import dataclass
from typing import Annotated, Literal

from hil.links.facts import values
from visthrow.config.bounds import Bound, Bounded

FACTS = values("betaflight")
# numbers of rates_type; Raceflight, KISS and Quick are not supported
RATES_TYPES = {"betaflight": FACTS["rates_betaflight"], "actual": FACTS["rates_actual"]}
RATE_LIMIT = FACTS["rate_limit"]  # largest rate of any set-point [deg/s]
TRAVEL = FACTS["travel"]  # from the middle of a stick to its end [us]
MIDDLE = FACTS["middle"]  # middle of a stick [us]


Steep = Annotated[int, Bound(1, 255)]
Byte = Annotated[int, Bound(0, 255)]
Percent = Annotated[int, Bound(0, 100)]


@dataclass(frozen=True)
class RatesParams(Bounded):
    """A rate profile in the flight controller's units; roll, pitch, yaw."""

    type: Literal["betaflight", "actual"]
    # betaflight: RC rate in hundredths; actual: rate around the middle in 10 deg/s. At 0 the curve
    # would be flat there.
    rc_rates: tuple[Steep, Steep, Steep]
    # betaflight: super rate in hundredths; actual: rate at the end in 10 deg/s
    rates: tuple[Byte, Byte, Byte]
    expo: tuple[Percent, Percent, Percent]  # in hundredths

    def rate(self, axis: int, stick: float) -> float:
        """Return the body rate [rad/s] in the stick's direction; axis 0 roll, 1 pitch, 2 yaw, stick
        -1 to 1.
        """
        size = abs(stick)
        curve = self._betaflight if self.type == "betaflight" else self._actual
        return math.copysign(math.radians(min(curve(axis, size), RATE_LIMIT)), stick)

    def _betaflight(self, axis: int, size: float) -> float:
        expo = self.expo[axis] / 100.0
        gain = self.rc_rates[axis] / 100.0
        bent = size**4 * expo + size * (1.0 - expo)
        if gain > 2.0:
            gain += FACTS["rate_steep"] * (gain - 2.0)
        super_rate = min(max(1.0 - size * self.rates[axis] / 100.0, 0.01), 1.0)
        return FACTS["rate_unit"] * gain * bent / super_rate

    def _actual(self, axis: int, size: float) -> float:
        expo = self.expo[axis] / 100.0
        middle = 10.0 * self.rc_rates[axis]
        bent = size * (size ** FACTS["rate_power"] * expo + size * (1.0 - expo))
        return size * middle + max(0.0, 10.0 * self.rates[axis] - middle) * bent


class Sticks:
    """A converter of body rates to stick positions, by tables of the curves at every microsecond.

    Convention: ours are x forward, y left, z up; a stick to the right rolls right (+x), one pushed
    forward pitches the nose down (+y), one to the right yaws right (-z). So pitch keeps its sign,
    unlike in forward, right, down axes."""

    SIGNS = (FACTS["roll_sign"], FACTS["pitch_sign"], FACTS["yaw_sign"])

    def __init__(self, params: RatesParams):
        self._tables = [
            [params.rate(axis, us / TRAVEL) for us in range(TRAVEL + 1)] for axis in range(3)
        ]

    @property
    def limits(self) -> tuple[float, float, float]:
        """Rates at the ends of the sticks [rad/s]."""
        return tuple(table[-1] for table in self._tables)

    def position(self, axis: int, rate: float) -> int:
        """Return the stick position [us], rounded to whole microseconds, for a body rate [rad/s]
        about an axis of our body frame.
        """
        table = self._tables[axis]
        size = abs(rate)
        above = min(bisect_left(table, size), TRAVEL)
        index = above if above == 0 or table[above] - size <= size - table[above - 1] else above - 1
        return MIDDLE + int(math.copysign(index, self.SIGNS[axis] * rate))

"""A motor with a propeller on a thrust stand: thrust as a function of speed, and current as a
function of the propeller's power.

Motors of one type differ: the latent forces of a test are relative changes of its thrust and of its
current."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy import ndarray

from visthrow.config.bounds import Bounded, NotNegative, Positive
from visthrow.diagnose.models.numeric import Lanes, NumericModel, Stretch
from visthrow.logs.flightlog import FlightLog

NEEDED = ("rotor_speed", "thrust", "supply_voltage", "current")


@dataclass(frozen=True)
class StandParams(Bounded):
    """The motor and propeller before any effect is found."""

    k_f: Positive  # thrust over speed squared [N s^2/rad^2]
    k_p: Positive  # electric power over speed cubed [W s^3/rad^3]
    idle_power: NotNegative  # [W]
    resistance: NotNegative  # of motor and leads [Ohm]
    reference_voltage: Positive  # [V]
    thrust_sd: Positive  # constant part of the load cell's standard deviation [N]
    thrust_share: NotNegative  # part proportional to the reading [1]
    current_sd: Positive  # constant part of the current's standard deviation [A]
    current_share: NotNegative  # part proportional to the reading [1]
    lowest_speed: NotNegative  # slower steps are left out [rad/s]


class StandModel(NumericModel):
    """Static steps of tests on one stand; each test counts as a flight."""

    lawless = (
        "its steps are at rest, and its gains, exponents and offsets already cover any dependence"
        " on thrust"
    )

    table = "stand"
    pushes = ((0, 0), (0, 1))
    knot_count = 2
    channels = ("thrust", "current")
    needed = NEEDED
    inputs = ("rotor_speed", "supply_voltage")

    @cached_property
    def middle_speed(self) -> float:
        """Return the median rotor speed [rad/s]."""
        return np.median(np.concatenate([s.data["speed"] for s in self.stretches]))

    def windows_of(self, log: FlightLog, number: int) -> list[Stretch]:
        """See the base class: the settled steps of a test are one window."""
        p = self.params
        if len({len(log[name].time) for name in NEEDED}) != 1:
            return []
        # speed [rad/s], thrust [N], voltage [V] and current [A] of valid steps
        rows = np.column_stack([log[name].values.astype(float) for name in NEEDED])
        lowest = p.lowest_speed, 0.0, 1.0, 0.0
        valid = np.all([log[name].valid for name in NEEDED], axis=0)
        rows = rows[valid & np.all(rows > lowest, axis=1)]
        if len(rows) < 4:
            return []
        speed, thrust, volts, current = rows.T[..., None]
        steps = np.arange(len(rows), dtype=float)
        thrust_sd = np.hypot(p.thrust_sd, p.thrust_share * thrust)
        current_sd = np.hypot(p.current_sd, p.current_share * current)
        channels = [(steps, thrust, thrust_sd), (steps, current, current_sd)]
        data = {"speed": speed[:, 0], "volts": volts[:, 0]}
        return [self.lay_out(number, "steps", channels, (0.0, len(rows) - 1.0), data)]

    def measure(self, stretch: Stretch, path: ndarray, lanes: Lanes) -> ndarray:
        """See the base class: thrusts [N], then currents [A]."""
        p = self.params
        gain, exponent, linear, voltage, zero, power_gain, power_exponent, idle, resistance = (
            x[:, None] for x in lanes.theta.T
        )
        middle = self.middle_speed
        speed = stretch.data["speed"]
        volts = stretch.data["volts"]
        ratio = speed / middle
        square = speed**2 * ratio**exponent * (1.0 + gain)
        at_reference = p.k_f * (square + linear * middle * speed)
        thrust = at_reference * (1.0 + voltage * (volts - p.reference_voltage)) + zero
        lifting = p.k_p * (1.0 + power_gain) * speed**3 * ratio**power_exponent
        power = lifting + p.idle_power + idle
        ohm = np.maximum(p.resistance + resistance, 1e-6)
        root = np.sqrt(np.maximum(volts**2 - 4.0 * ohm * power, 0.0))
        share = 1.0 + self.pushes_at(lanes, np.linspace(0.0, 1.0, len(speed)))
        currents = (volts - root) / (2.0 * ohm)
        return np.concatenate([thrust * share[..., 0].T, currents * share[..., 1].T], axis=1)

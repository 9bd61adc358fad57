"""A motor with a propeller on a thrust stand: thrust over speed, and current over the power that
the propeller takes.

One motor of a kind is not like the other: the latent forces of a test are a share of its thrust and
of its current."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visthrow.config.bounds import Bounded, NotNegative, Positive
from visthrow.diagnose.models.catalogue import effects_of
from visthrow.diagnose.models.numeric import Lanes, NumericModel, Stretch, latent_layout, triangles
from visthrow.logs.flightlog import FlightLog

CHANNELS = ("thrust", "current")
NEEDED = ("rotor_speed", "thrust", "supply_voltage", "current")


@dataclass(frozen=True)
class StandParams(Bounded):
    """The motor and propeller that are assumed before anything is found."""

    k_f: Positive  # thrust over speed squared [N s^2/rad^2]
    k_p: Positive  # electric power over speed cubed [W s^3/rad^3]
    idle_power: NotNegative  # [W]
    resistance: NotNegative  # of motor and leads [Ohm]
    reference_voltage: Positive  # [V]
    thrust_sd: Positive  # of the load cell [N]
    thrust_share: NotNegative  # and of the reading [1]
    current_sd: Positive  # [A]
    current_share: NotNegative  # [1]
    lowest_speed: NotNegative  # steps below are left out [rad/s]


class StandModel(NumericModel):
    """Static steps of tests on one stand; a test is a flight."""

    lawless = (
        "its steps are at rest, and what thrust alone could make its gains, exponents and offsets"
        " stand for"
    )

    def __init__(self, logs: Sequence[FlightLog], params: StandParams) -> None:
        """Take the settled steps of the logs.

        Raises LogError where none has thrust, speed, voltage and current.
        """
        self.params = params
        stretches = [s for i, log in enumerate(logs) if (s := _steps(log, i, params)) is not None]
        super().__init__(
            effects_of("stand", params), CHANNELS, stretches, ("rotor_speed", "supply_voltage")
        )
        self.middle = float(np.median(np.concatenate([s.data["speed"] for s in stretches])))

    def measure(self, stretch: Stretch, path: np.ndarray, lanes: Lanes) -> np.ndarray:
        """See the base class: thrusts [N], then currents [A]."""
        p = self.params
        gain, exponent, linear, voltage, zero, power_gain, power_exponent, idle, resistance = (
            x[:, None] for x in lanes.theta.T
        )
        speed = stretch.data["speed"]
        volts = stretch.data["volts"]
        thrust = p.k_f * (
            speed**2 * (speed / self.middle) ** exponent * (1.0 + gain)
            + linear * self.middle * speed
        )
        thrust = thrust * (1.0 + voltage * (volts - p.reference_voltage)) + zero
        power = (
            p.k_p * (1.0 + power_gain) * speed**3 * (speed / self.middle) ** power_exponent
            + p.idle_power
            + idle
        )
        ohm = np.maximum(p.resistance + resistance, 1e-6)
        root = np.sqrt(np.maximum(volts**2 - 4.0 * ohm * power, 0.0))
        share = (
            lanes.latent.reshape(len(lanes.owner), 2, 2)
            @ triangles(np.arange(len(speed)), np.array([0, len(speed) - 1])).T
        )
        return np.concatenate(
            [thrust * (1.0 + share[:, 0]), (volts - root) / (2.0 * ohm) * (1.0 + share[:, 1])],
            axis=1,
        )


def settled(log: FlightLog, params: StandParams) -> np.ndarray:
    """Speed [rad/s], thrust [N], voltage [V] and current [A] of the steps that can be used, shape
    (N, 4).
    """
    rows = np.column_stack([log[name].values.astype(float) for name in NEEDED])
    good = np.all([log[name].valid for name in NEEDED], axis=0)
    good &= (
        (rows[:, 0] > params.lowest_speed)
        & (rows[:, 2] > 1.0)
        & (rows[:, 1] > 0.0)
        & (rows[:, 3] > 0.0)
    )
    return rows[good]


def _steps(log: FlightLog, number: int, params: StandParams) -> Stretch | None:
    if (
        any(name not in log for name in NEEDED)
        or len({len(log[name].time) for name in NEEDED}) != 1
    ):
        return None
    rows = settled(log, params)
    if len(rows) < 4:
        return None
    speed, thrust, volts, current = rows.T
    steps = np.arange(len(rows), dtype=float)
    thrust_sd = np.hypot(params.thrust_sd, params.thrust_share * thrust)
    current_sd = np.hypot(params.current_sd, params.current_share * current)
    channels = [
        (steps, values[:, None], sd[:, None])
        for values, sd in ((thrust, thrust_sd), (current, current_sd))
    ]
    data = {"speed": speed, "volts": volts}
    layout = latent_layout(0.0, len(rows) - 1.0, 2, (0,), (0, 1))
    return Stretch.of(number, "steps", channels, data, layout)

"""A motor with a propeller on a thrust stand: thrust over speed, and current over the power that the propeller takes.

One motor of a kind is not like the other: the latent forces of a test are a share of its thrust and of its current.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visthrow.diagnose.models.interface import Effect
from visthrow.diagnose.models.numeric import Lanes, NumericModel, Stretch, latent_layout, triangles
from visthrow.logs.flightlog import FlightLog

CHANNELS = ("thrust", "current")
NEEDED = ("thrust", "rotor_speed", "supply_voltage", "current")


@dataclass(frozen=True)
class StandParams:
    """The motor and propeller that are assumed before anything is found."""

    k_f: float  # thrust over speed squared [N s^2/rad^2]
    k_p: float  # electric power over speed cubed [W s^3/rad^3]
    idle_power: float  # [W]
    resistance: float  # of motor and leads [Ohm]
    reference_voltage: float  # [V]
    thrust_sd: float  # of the load cell [N]
    thrust_share: float  # and of the reading [1]
    current_sd: float  # [A]
    current_share: float  # [1]
    lowest_speed: float  # steps below are left out [rad/s]


def effects(params: StandParams) -> list[Effect]:
    """Catalogue of the stand."""
    seen = ("thrust", "rotor_speed")
    power = ("current", "rotor_speed", "supply_voltage")
    return [
        Effect("thrust_gain", "the propeller's thrust coefficient", "f = k_f (1 + theta) W^2", "1", "thrust map", (-0.8, 3.0), 0.3,
               3e-3, seen, "Agilicious 2022", (), ("another propeller",)),
        Effect("thrust_exponent", "the power of speed that thrust grows with", "f = k_f W^2 (W / W_mid)^theta", "1", "thrust map",
               (-0.8, 0.8), 0.1, 1e-2, seen, "arXiv 2404.07837", ("thrust_linear",), ("steps from idle to full",)),
        Effect("thrust_linear", "a linear part of the thrust curve", "f += theta k_f W_mid W", "1", "thrust map", (-0.8, 0.8), 0.1,
               1e-2, seen, "arXiv 2404.07837", ("thrust_exponent",), ("steps from idle to full",)),
        Effect("thrust_voltage", "the thrust's dependence on the supply at one speed", "f (1 + theta (U - U_ref))", "1/V",
               "battery", (-0.3, 0.3), 0.02, 1e-3, (*seen, "supply_voltage"), "there is none at a given speed", (),
               ("two supplies",)),
        Effect("load_cell_zero", "the load cell's zero", "y = f + theta", "N", "sensing", (-2.0, 2.0), 0.1, 5e-3, seen, "tare", (),
               ("a step with the motor off",)),
        Effect("power_gain", "the propeller's power coefficient", "P = k_p (1 + theta) W^3", "1", "thrust map", (-0.8, 5.0), 0.3,
               1e-2, power, "momentum theory", (), ()),
        Effect("power_exponent", "the power of speed that power grows with", "P = k_p W^3 (W / W_mid)^theta", "1", "thrust map",
               (-1.0, 1.0), 0.1, 1e-2, power, "momentum theory", ("resistance",), ("steps from idle to full",)),
        Effect("idle_power", "power at rest", "P += theta", "W", "battery", (-5.0, 20.0), 1.0, 0.1, power, "controller", (), ()),
        Effect("resistance", "the resistance of motor and leads", "U I = P + (R + theta) I^2", "Ohm", "battery", (-0.2, 0.5), 0.05,
               3e-3, power, "winding", ("power_exponent",), ("two supplies",)),
    ]  # fmt: skip


class StandModel(NumericModel):
    """Static steps of tests on one stand; a test is a flight."""

    def __init__(self, logs: Sequence[FlightLog], params: StandParams) -> None:
        """Take the settled steps of the logs.

        Raises:
            LogError: No log has thrust, speed, voltage and current.
        """
        self.params = params
        stretches = [s for i, log in enumerate(logs) if (s := _steps(log, i, params)) is not None]
        super().__init__(effects(params), CHANNELS, stretches, ("rotor_speed", "supply_voltage"))
        self.middle = float(np.median(np.concatenate([s.data["speed"] for s in stretches])))

    def measure(self, stretch: Stretch, path: np.ndarray, lanes: Lanes) -> np.ndarray:
        """See the base class: thrusts [N], then currents [A]."""
        p = self.params
        gain, exponent, linear, voltage, zero, power_gain, power_exponent, idle, resistance = (x[:, None] for x in lanes.theta.T)
        speed, volts = stretch.data["speed"], stretch.data["volts"]
        thrust = p.k_f * (speed**2 * (speed / self.middle) ** exponent * (1.0 + gain) + linear * self.middle * speed)
        thrust = thrust * (1.0 + voltage * (volts - p.reference_voltage)) + zero
        power = p.k_p * (1.0 + power_gain) * speed**3 * (speed / self.middle) ** power_exponent + p.idle_power + idle
        ohm = np.maximum(p.resistance + resistance, 1e-6)
        root = np.sqrt(np.maximum(volts**2 - 4.0 * ohm * power, 0.0))
        share = lanes.latent.reshape(len(lanes.owner), 2, 2) @ triangles(np.arange(len(speed)), np.array([0, len(speed) - 1])).T
        return np.concatenate([thrust * (1.0 + share[:, 0]), (volts - root) / (2.0 * ohm) * (1.0 + share[:, 1])], axis=1)


def settled(log: FlightLog, params: StandParams) -> np.ndarray:
    """Speed [rad/s], thrust [N], voltage [V] and current [A] of the steps that can be used, shape (N, 4)."""
    rows = np.column_stack([log[name].values.astype(float) for name in ("rotor_speed", "thrust", "supply_voltage", "current")])
    good = np.all([log[name].valid for name in ("rotor_speed", "thrust", "supply_voltage", "current")], axis=0)
    good &= (rows[:, 0] > params.lowest_speed) & (rows[:, 2] > 1.0) & (rows[:, 1] > 0.0) & (rows[:, 3] > 0.0)
    return rows[good]


def _steps(log: FlightLog, number: int, params: StandParams) -> Stretch | None:
    if any(name not in log for name in NEEDED) or len({len(log[name].time) for name in NEEDED}) != 1:
        return None
    rows = settled(log, params)
    if len(rows) < 4:
        return None
    speed, thrust, volts, current = rows.T
    sigma = np.concatenate([
        np.hypot(params.thrust_sd, params.thrust_share * thrust), np.hypot(params.current_sd, params.current_share * current),
    ])  # fmt: skip
    steps = np.arange(len(rows), dtype=float)
    return Stretch(
        number, "steps", np.tile(steps, 2), np.repeat([0, 1], len(rows)), np.concatenate([thrust, current]), sigma,
        np.zeros(0), np.zeros(0), {"speed": speed, "volts": volts},
        **latent_layout(0.0, len(rows) - 1.0, 2, (0,), (0, 1)),
    )  # fmt: skip

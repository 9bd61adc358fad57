"""Mean commands of the four motors in slow flight: what feedback had to do so that forces and
torques balance.

Where neither attitude nor rates are logged, the balance still tells: thrusts must carry the weight
and turn nothing."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visthrow.config.bounds import Bounded, NotNegative, Positive
from visthrow.diagnose.models.law_terms import exerted
from visthrow.diagnose.models.numeric import Lanes, NumericModel, Stretch, latent_layout
from visthrow.logs.check.relations import derivative
from visthrow.logs.flightlog import FlightLog


@dataclass(frozen=True)
class TrimParams(Bounded):
    """The vehicle as it was before: from its own unharmed flights."""

    command: str  # channel of the motors' commands
    position: str  # channel of the measured position
    velocity: str  # channel of the measured velocity
    mass: Positive  # [kg]
    gravity: Positive  # [m/s^2]
    thrust_map: tuple[float, float, float]  # thrust of a motor by powers of its command [N]
    reference_voltage: Positive  # [V]
    voltage_coefficient: float  # [1/V]
    motor_scale: tuple[Positive, Positive, Positive, Positive]  # each motor's thrust over the map
    arm: Positive  # of each rotor along x and along y [m]
    torque_ratio: NotNegative  # [m]
    spin: tuple[float, float, float, float]
    lowest: float  # [m]
    slowest_window: Positive  # windows' length [s]
    fastest: Positive  # mean speed of a window [m/s]
    spread: Positive  # of a window's mean command, by draught and control [1]
    motor_spread: Positive  # of an unharmed vehicle's thrusts from one flight to the next [1]
    com_spread: Positive  # of its centre of mass: the pack is not where it was [m]


class TrimModel(NumericModel):
    """Means over windows of slow level flight."""

    table = "trim"

    def __init__(self, logs: Sequence[FlightLog], params: TrimParams) -> None:
        """See the base class."""
        self.channels = (params.command,)
        self.needed = (params.command, params.position)
        self.inputs = (params.position, "battery_voltage")
        super().__init__(logs, params)

    def windows_of(self, log: FlightLog, number: int) -> list[Stretch]:
        """See the base class."""
        params = self.params
        window = params.slowest_window
        nothing = (np.zeros(0), np.zeros(0))
        stamps = log[params.command].time
        time, sent = log[params.command].samples()
        time_p, pos = log[params.position].samples()
        time_v, vel = derivative(time_p, pos, 0.2)
        if params.velocity in log:
            time_v, vel = log[params.velocity].samples()
        time_u, volts = log["battery_voltage"].samples() if "battery_voltage" in log else nothing
        stretches = []
        for start in np.arange(stamps[0], stamps[-1] - window, window):
            spans = [(t >= start) & (t < start + window) for t in (time, time_p, time_v, time_u)]
            if min(map(np.count_nonzero, spans[:3])) < 20:
                continue
            sent_here, pos_here, vel_here, volts_here = (
                values[span] for values, span in zip((sent, pos, vel, volts), spans)
            )
            fast = np.mean(np.linalg.norm(vel_here, axis=1)) > params.fastest
            if fast or np.min(pos_here[:, 2]) < params.lowest:
                continue
            rise = vel_here[-5:, 2].mean() - vel_here[:5, 2].mean()
            data = {
                "volts": float(np.mean(volts_here))
                if len(volts_here)
                else params.reference_voltage,
                "lift": 1.0 + rise / window / params.gravity,
                "pos": np.mean(pos_here, axis=0),
                "vel": np.mean(vel_here, axis=0),
            }
            table = np.array([start]), np.mean(sent_here, axis=0)[None], np.array(params.spread)
            layout = _latent(start, start + window)
            stretches.append(Stretch.laid_out(number, "hover", [table], data, layout))
        return stretches

    def measure(self, stretch: Stretch, path: np.ndarray, lanes: Lanes) -> np.ndarray:
        """See the base class: the commands at which everything balances, shape (B, 4)."""
        p = self.params
        theta = lanes.theta
        motors = theta[:, :4]
        added = theta[:, 4:8]
        mass, gain, sag, com_x, com_y, yaw = theta[:, 8:].T
        x = p.arm * np.array([1.0, 1.0, -1.0, -1.0])
        y = p.arm * np.array([1.0, -1.0, 1.0, -1.0])
        weight = (p.mass + mass + added.sum(1)) * p.gravity
        total = p.mass + mass + added.sum(1)
        off_x = ((p.mass + mass) * com_x + added @ x) / total
        off_y = ((p.mass + mass) * com_y + added @ y) / total
        spin = np.array(p.spin)
        lift = stretch.data["lift"]
        draught = lanes.latent.reshape(len(theta), 4, 2).mean(
            2
        )  # a push along the vertical, then three torques
        if self.laws:
            predictions = {
                block: np.mean(value, axis=0)
                for block, value in exerted(self.laws, self.knots(stretch, path)).items()
            }
            draught = draught + np.append(
                predictions.get("vehicle force", np.zeros(3))[2],
                predictions.get("vehicle torque", np.zeros(3)),
            )
        push, roll, pitch, turn = draught.T
        lifting = weight * lift
        wrench = [
            lifting - push,
            (lifting * off_x + pitch) / p.arm**2,
            (lifting * off_y - roll) / p.arm**2,
            -(lifting * yaw + turn / p.torque_ratio),
        ]
        thrust = 0.25 * np.stack(wrench, axis=1) @ np.stack([np.ones(4), x, y, spin])
        volts = 1.0 + (p.voltage_coefficient + sag) * (stretch.data["volts"] - p.reference_voltage)
        per_map = thrust / (
            np.array(p.motor_scale) * (1.0 + motors) * ((1.0 + gain) * volts)[:, None]
        )
        return command_of(p.thrust_map, per_map)

    def knots(self, stretch: Stretch, path: np.ndarray) -> dict[str, np.ndarray]:
        """See the base class; nothing tells the attitude, hence not the body's velocity either."""
        data = stretch.data
        start, end = np.unique(stretch.latent_time)
        thrust = self.params.mass * self.params.gravity * data["lift"]
        return {
            "time": np.array([start, end]),
            "pos_w": np.tile(data["pos"], (2, 1)),
            "vel_w": np.tile(data["vel"], (2, 1)),
            "thrust": np.full(2, thrust),
        }


def command_of(thrust_map: Sequence[float], thrust: np.ndarray) -> np.ndarray:
    """Command at which the map gives a thrust."""
    c0, c1, c2 = thrust_map
    if c2 == 0.0:
        return (thrust - c0) / c1
    return (-c1 + np.sqrt(np.maximum(c1 * c1 - 4.0 * c2 * (c0 - thrust), 0.0))) / (2.0 * c2)


def _latent(start: float, end: float) -> dict[str, np.ndarray]:
    """Draught in a window: a push along the vertical and three torques."""
    push = latent_layout(start, end, 2, (0,), (2,))
    torque = latent_layout(start, end, 2, (1,))
    return {name: np.concatenate([push[name], torque[name]]) for name in push}

"""A quadrotor whose position nobody measures: driven by its motors' logged commands, seen by its
accelerometer and gyro.

Force along the rotors' axis and body rates tell the motors' lag, the thrust map's shape and ratios
of torque to inertia. An accelerometer's offset hides the map's scale."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from visthrow.diagnose.models.numeric import (
    Lanes,
    NumericModel,
    Stretch,
    integrate,
    latent_force,
    latent_layout,
    sigma_of,
)
from visthrow.diagnose.models.quadrotor.flyer import FlyerModel
from visthrow.diagnose.models.quadrotor.flyer_params import QuadrotorParams, TorqueParams
from visthrow.diagnose.models.quadrotor.flyer_windows import KNOTS, covered, flies, held_inputs
from visthrow.logs.check.relations import Relation, derivative, on_grid, relate
from visthrow.logs.flightlog import FlightLog

CHANNELS = ("acc_b", "rate_b")
UNREAD = frozenset({"pos_w", "quat_wb", "payload_pos_w"})
OFFSET = 0.5  # deviation of what an accelerometer in flight is off by [m/s^2]
QUIETEST = (1e-2, 2e-3)  # noise of accelerometer and gyro below which none is believed
# correlation of angular acceleration with the commands' torques, from which inertia is told: 0.99
# in simulated flights, 0.2 to 0.5 in fast flights of a Crazyflie, which the air turns as well
FOLLOWS = 0.8
SMOOTHING = 0.05  # of the gyro for its slope [s]


@dataclass(frozen=True)
class ImuParams(QuadrotorParams):
    """A vehicle whose position nobody measures.

    Raises ConfigError where the map does not rise.
    """

    input: Literal["motor_command", "motor_speed"]  # channel of the commands
    torque: TorqueParams  # how thrusts turn the vehicle


class ImuModel(FlyerModel):
    """Windows of flights of one vehicle; motors and torques are those of the base class."""

    table = "imu"
    channels = CHANNELS
    lawless = "nothing tells the attitude and the velocity that a law is made of"

    def __init__(self, logs: Sequence[FlightLog], params: ImuParams) -> None:
        """See the base class."""
        self.needed = (params.input, *CHANNELS)
        turned = [r for log in logs if (r := _turned(log, params)) is not None]
        if turned and np.median([r.correlation for r in turned]) < FOLLOWS:
            self.channels = CHANNELS[:1]
            self.notes = (_why_not(turned, params.input),)
        self.has_voltage = all("battery_voltage" in log for log in logs)
        self.inputs = (params.input, *["battery_voltage"] * self.has_voltage)
        NumericModel.__init__(self, logs, params)
        self.steps = round(params.window / params.step)
        inputs, self._volts, self._since = (
            np.array([s.data[name] for s in self.stretches]) for name in ("input", "volts", "since")
        )
        self._commanded = params.thrust(inputs)

    def windows_of(self, log: FlightLog, number: int) -> list[Stretch]:
        """See the base class."""
        p = self.params
        driven = [log[name] for name in self.needed]
        first = max(c.time[0] for c in driven)
        last = min(c.time[-1] for c in driven)
        sigma = [sigma_of(log[name], floor) for name, floor in zip(CHANNELS, QUIETEST)]
        stretches = []
        for start in np.arange(first + p.window, last - p.window, p.window):
            end = start + p.window
            if not all(covered(c, start, end) for c in driven):
                continue
            inputs = held_inputs(log[p.input], p, start)
            if not flies(inputs, p):
                continue
            acc, rate = (
                log[name].only((log[name].time >= start) & (log[name].time < end)).samples()
                for name in CHANNELS
            )
            samples = [
                (time[:: p.every], values[:: p.every, part].astype(float), noise[part])
                for (time, values), noise, part in zip((acc, rate), sigma, (slice(2, 3), slice(3)))
            ]
            volts = log["battery_voltage"].hold(np.array([end]))[0] if self.has_voltage else 0.0
            data = {"start": start, "input": inputs, "volts": float(volts)}
            data["since"] = start - float(log[p.input].time[0])
            layout = latent_layout(start, end, KNOTS, (0, 1))
            guess = [*samples[1][1][0], 0.0]
            samples = samples[: len(self.channels)]
            spread = [1.0, 1.0, 1.0, OFFSET]
            stretches.append(
                Stretch.laid_out(number, "flight", samples, data, layout, guess, spread)
            )
        return stretches

    def simulate(self, lanes: Lanes) -> np.ndarray:
        """See the base class; the state: body rates, and behind them the force along the rotors'
        axis over the mass [m/s^2], with the accelerometer's offset.
        """
        p = self.params
        thrust = self._thrusts(lanes)
        latent = latent_force(lanes.latent, self.steps, 2)
        turning: Callable = self._turning(lanes, thrust)

        def slope(half: int, rate: np.ndarray) -> np.ndarray:
            return turning(half, rate, latent[half, 1])

        step = np.full((len(lanes.owner), 1), p.step)
        rates = integrate(slope, lanes.nuisance[:, :3], self.steps, step)
        push = (thrust.sum(2) + latent[:, 0, :, 2])[::2].T / p.mass + lanes.nuisance[:, 3:]
        return np.concatenate([rates, push[..., None]], 2)

    def measure(self, stretch: Stretch, path: np.ndarray, lanes: Lanes) -> np.ndarray:
        """See the base class."""
        grid = stretch.data["start"] + self.params.step * np.arange(path.shape[1])
        out = np.empty((len(path), len(stretch.time)))
        for channel, part in enumerate((slice(3, 4), slice(3))[: len(self.channels)]):
            rows = stretch.channel == channel
            width = part.stop - (part.start or 0)
            time = stretch.time[rows][::width]
            values = [on_grid(grid, states[:, part], time) for states in path]
            out[:, rows] = np.reshape(values, (len(path), -1))
        return out

    def knots(self, stretch: Stretch, path: np.ndarray) -> Mapping[str, np.ndarray]:
        """See the base class."""
        return {}


def _turned(log: FlightLog, params: ImuParams) -> Relation | None:
    """Relate the angular acceleration to what the commands' torques would give; None where a
    channel lacks or nothing turns.
    """
    if params.input not in log or "rate_b" not in log:
        return None
    time, inputs = log[params.input].samples()
    sent = params.torque.of(params.thrust(inputs)) / np.array(params.torque.inertia)
    return relate(time, sent, *derivative(*log["rate_b"].samples(), SMOOTHING))


def _why_not(turned: Sequence[Relation], source: str) -> str:
    """Return why a model leaves the rates out."""
    worst = min(turned, key=lambda r: r.correlation)
    reason = (
        f"the rates follow the torques of {source} with a correlation of {worst.correlation:.2f}"
        f" only (expected {FOLLOWS} or more): the air turns this vehicle as well, or hardly"
        " anything does"
    )
    if worst.nats > 0.0:
        reason += f"; as ({worst.axes}) it is {worst.axes_correlation:.2f}: motors in another order"
    return f"{reason}; acc_b alone is looked at, and no torque or inertia is told"

"""A model of the mean commands of the four motors in slow flight: what feedback had to do so that
forces and torques balance. Its effects stand in ``effects.toml``.

Where neither attitude nor rates are logged, the balance still tells: thrusts must carry the weight
and turn nothing."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from visthrow.config.bounds import Bounded, NotNegative, Positive
from visthrow.diagnose.models.numeric import (
    Lanes,
    NumericModel,
    Stretch,
    command_of,
    exert,
)
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


E8 = TrimParams(
    command="motor_wanted",
    position="est_pos_w",
    velocity="est_vel_w",
    mass=0.033,  # 27 g and Lighthouse deck 2.7 g, card deck 1.6 g, holder (Bitcraze's weights)
    gravity=9.81,  # at sea level in the middle latitudes
    # 60 gf of four motors at full: the firmware's own compensation (Bitcraze)
    thrust_map=(0.0, 0.1471, 0.0),
    reference_voltage=3.5,  # middle of these flights
    voltage_coefficient=0.0,  # the value is compensated for the battery
    # `diagnose_trim.py --fit` of normal_flight log00 and log03
    motor_scale=(0.980, 0.815, 0.791, 1.017),
    arm=0.0325,  # 92 mm from motor to motor across (Bitcraze)
    torque_ratio=0.006,  # Foerster 2015
    spin=(1.0, -1.0, -1.0, 1.0),  # neighbours turn against each other
    lowest=0.25,  # above the ground effect
    slowest_window=0.5,  # a gait of control
    fastest=0.6,  # their plan flies at 0.3 m/s
    spread=0.01,  # of a window's mean, by draught and control
    motor_spread=0.015,  # E8's third unharmed flight differs by 1 % in the right motors
    com_spread=0.0012,  # and by 7 % in both left ones: a pack that sits 1.2 mm further
)
"""CrazyPAD's Crazyflie 2.1 of this name."""
E9 = replace(E8, motor_scale=(0.975, 0.842, 0.784, 0.902))  # likewise fitted
UNTRIMMED = replace(E8, motor_scale=(1.0, 1.0, 1.0, 1.0))
"""The published thrust of four motors alike, as before anybody fitted a drone."""


class TrimModel(NumericModel):
    """Means over windows of slow level flight."""

    table = str(Path(__file__).with_name("effects.toml"))
    pushes = ((0, 2), (1, 0), (1, 1), (1, 2))  # a push along the vertical, then three torques
    knot_count = 2

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
        names = [params.command, params.position]
        channels = [log[name].samples() for name in names]
        if params.velocity in log:
            channels.append(log[params.velocity].samples())
        else:
            channels.append(channels[1].derivative(0.2))
        if "battery_voltage" in log:
            channels.append(log["battery_voltage"].samples())
        stamps = log[params.command].time
        stretches = []
        for start in np.arange(stamps[0], stamps[-1] - window, window):
            sent, pos, vel, *volts = [
                values[(time >= start) & (time < start + window)] for time, values in channels
            ]
            if min(len(sent), len(pos), len(vel)) < 20:
                continue
            fast = np.mean(np.linalg.norm(vel, axis=1)) > params.fastest
            if fast or np.min(pos[:, 2]) < params.lowest:
                continue
            rise = vel[-5:, 2].mean() - vel[:5, 2].mean()
            known = len(volts) and len(volts[0])
            data = {
                "volts": float(np.mean(volts[0])) if known else params.reference_voltage,
                "lift": 1.0 + rise / window / params.gravity,
                "pos": np.mean(pos, axis=0),
                "vel": np.mean(vel, axis=0),
            }
            table = np.array([start]), np.mean(sent, axis=0)[None], np.array(params.spread)
            span = start, start + window
            stretches.append(self.lay_out(number, "hover", [table], span, data))
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
        bare = p.mass + mass
        total = bare + added.sum(1)
        off_x = (bare * com_x + added @ x) / total
        off_y = (bare * com_y + added @ y) / total
        draught = self.pushes_at(lanes, np.array([0.5]))[0]
        for block, loads in exert(self.laws, self._means(stretch)).items():
            load = np.mean(loads, axis=0)
            if block == "vehicle force":
                draught[:, 0] += load[2]
            else:
                draught[:, 1:] += load
        push, roll, pitch, turn = draught.T
        lifting = total * p.gravity * stretch.data["lift"]
        wrench = [
            lifting - push,
            (lifting * off_x + pitch) / p.arm**2,
            (lifting * off_y - roll) / p.arm**2,
            -(lifting * yaw + turn / p.torque_ratio),
        ]
        thrust = 0.25 * np.stack(wrench, axis=1) @ np.stack([np.ones(4), x, y, p.spin])
        volts = 1.0 + (p.voltage_coefficient + sag) * (stretch.data["volts"] - p.reference_voltage)
        scale = np.array(p.motor_scale) * (1.0 + motors) * ((1.0 + gain) * volts)[:, None]
        return command_of(p.thrust_map, thrust / scale)

    def knots(self, lanes: Lanes) -> list[dict[str, np.ndarray]]:
        """See the base class; nothing tells the attitude, hence not the body's velocity either."""
        return [self._means(stretch) for stretch in self.stretches]

    def _means(self, stretch: Stretch) -> dict[str, np.ndarray]:
        """Return quantities of laws at both ends of a window: its means."""
        data = stretch.data
        return {
            "time": np.unique(stretch.latent_time),
            "pos_w": np.tile(data["pos"], (2, 1)),
            "vel_w": np.tile(data["vel"], (2, 1)),
            "thrust": np.full(2, self.params.mass * self.params.gravity * data["lift"]),
        }

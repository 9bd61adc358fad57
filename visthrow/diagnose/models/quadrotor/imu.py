"""A quadrotor without measured position: driven by its motors' logged commands, and measured by its
accelerometer and gyro.

Force along the rotors' axis and body rates determine the motors' lag, the shape of the thrust map
and ratios of torque to inertia. The accelerometer's offset hides the scale of the map."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy import ndarray

from visthrow.common.rotations import cross
from visthrow.diagnose.models.numeric import Lanes, Stretch, halves, integrate
from visthrow.diagnose.models.quadrotor.driven import DrivenModel, in_all
from visthrow.diagnose.models.quadrotor.flyer_params import QuadrotorParams, TorqueParams
from visthrow.diagnose.models.quadrotor.flyer_windows import cut_flying
from visthrow.logs.check.relations import Relation, relate
from visthrow.logs.flightlog import FlightLog
from visthrow.logs.samples import Samples, interpolate

CHANNELS = ("acc_b", "rate_b")
COLUMNS = slice(3, 4), slice(0, 3)  # columns of the state that CHANNELS measure
UNREAD = frozenset({"pos_w", "quat_wb", "payload_pos_w"})
OFFSET = 0.5  # prior standard deviation of an accelerometer's offset in flight [m/s^2]
# smallest correlation of angular acceleration with the commands' torques that determines inertia:
# 0.99 in simulated flights, 0.2 to 0.5 in fast flights of a Crazyflie, which air also turns
FOLLOWS = 0.8
SMOOTHING = 0.05  # span over which the gyro is differentiated [s]


@dataclass(frozen=True)
class ImuParams(QuadrotorParams):
    """A vehicle without measured position.

    Raises ConfigError: the thrust map does not rise.
    """

    input: Literal["motor_command", "motor_speed"]  # channel of the commands
    # None: rates are not simulated, and the gyro is not used
    torque: TorqueParams | None = None


class ImuModel(DrivenModel):
    """Windows of flights of one vehicle."""

    table = "imu"
    anchored = True  # an accelerometer's offset is small, the error of a wrong map is not
    channels = CHANNELS
    lawless = "a law needs the attitude and the velocity, which are not measured"

    def __init__(self, logs: Sequence[FlightLog], params: ImuParams):
        """See the base class; the gyro is not used if the setup states no torques, or if the rates
        do not follow the motors' torques.
        """
        if params.torque is None:
            self.channels = CHANNELS[:1]
        self.needed = (params.input, *self.channels)
        self.inputs = (params.input, *in_all(logs, "battery_voltage"))
        turned = [r for log in logs if (r := _relate_turning(log, params)) is not None]
        if turned and np.median([r.correlation for r in turned]) < FOLLOWS:
            self.channels = CHANNELS[:1]
            self.notes = (_why_not(turned, params.input),)
        super().__init__(logs, params)

    def windows_of(self, log: FlightLog, number: int) -> list[Stretch]:
        """See the base class."""
        p = self.params
        stretches = []
        for start, (force, *gyro), data in cut_flying(log, p, self.channels, self.needed):
            time, acc, noise = force
            tables = [(time, acc[:, 2:], noise[2:]), *gyro]
            rates = gyro[0][1][0] if gyro else np.zeros(3)
            begin = [*rates, 0.0], [1.0, 1.0, 1.0, OFFSET]
            span = start, start + p.window
            stretches.append(self.lay_out(number, "flight", tables, span, data, *begin))
        return stretches

    def simulate(self, lanes: Lanes) -> ndarray:
        """See the base class; the state is the body rates [rad/s], followed by the specific force
        along the rotors' axis [m/s^2], with the accelerometer's offset.
        """
        thrust = self.thrusts(lanes, self.steps)
        pushes = self.pushes_at(lanes, halves(self.steps))
        rates = lanes.nuisance[:, None, :3].repeat(self.steps + 1, 1)
        if "rate_b" in self.channels:
            rates = self._turn(lanes, thrust, pushes[:, :, -3:])
        gust = pushes[:, :, 2]
        gust = gust - gust.mean(0)  # a constant part belongs to the offset or to the map's scale
        push = (thrust.sum(2) + gust)[::2].T / self.params.mass
        acc = push + lanes.nuisance[:, 3:]
        return np.concatenate([rates, acc[..., None]], 2)

    def measure(self, stretch: Stretch, path: ndarray, lanes: Lanes) -> ndarray:
        """See the base class."""
        grid = stretch.data["start"] + self.params.step * np.arange(path.shape[1])
        measured = []
        for channel in range(len(self.channels)):
            states = path[..., COLUMNS[channel]]
            time = stretch.time[stretch.channel == channel][:: states.shape[2]]
            measured.append(np.array([interpolate(grid, lane, time).ravel() for lane in states]))
        return np.concatenate(measured, axis=1)

    def _turn(self, lanes: Lanes, thrust: ndarray, push: ndarray) -> ndarray:
        """Return the body rates under the motors' thrusts, the offset of the centre of mass and
        further torques at the half steps [N m], shape (B, T, 3).
        """
        p = self.params.torque
        scale = 1.0 + self.stack(lanes, "inertia_xy", "inertia_xy", "inertia_z")
        inertia = p.inertia * scale
        com_x, com_y = self.stack(lanes, "com_x", "com_y").T
        total = thrust.sum(2)
        lever = np.stack([-com_y * total, com_x * total, 0.0 * total], -1)
        torque = p.of(thrust) + lever + push

        def slope(half: int, rate: ndarray) -> ndarray:
            return (torque[half] - cross(rate, inertia * rate)) / inertia

        return integrate(slope, lanes.nuisance[:, :3], self.steps, self.params.step)


def _relate_turning(log: FlightLog, params: ImuParams) -> Relation | None:
    """Relate the angular acceleration to that by the commands' torques; None if a channel is
    missing, nothing turns, or the setup states no torques.
    """
    if params.torque is None or params.input not in log or "rate_b" not in log:
        return None
    time, inputs = log[params.input].samples()
    sent = params.torque.of(params.thrust(inputs)) / params.torque.inertia
    return relate(Samples(time, sent), log["rate_b"].samples().derivative(SMOOTHING))


def _why_not(turned: Sequence[Relation], source: str) -> str:
    """Return the reason why a model does not use the rates."""
    worst = min(turned, key=lambda r: r.correlation)
    reason = (
        f"the rates follow the torques of {source} with a correlation of {worst.correlation:.2f}"
        f" only (expected {FOLLOWS} or more): air also turns this vehicle, or it hardly turns"
    )
    if worst.nats > 0.0:
        reason += f"; as ({worst.axes}) it is {worst.axes_correlation:.2f}: motors in another order"
    return f"{reason}; acc_b alone is used, and no torque or inertia is fitted"

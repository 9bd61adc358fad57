"""Base of the models of a quadrotor whose commands were logged: flying windows, and the thrust of
the motors in them.
"""

from collections.abc import Container, Sequence

import numpy as np
from numpy import ndarray

from visthrow.diagnose.models.catalogue import ModelEffect
from visthrow.diagnose.models.numeric import Lanes, NumericModel, Stretch
from visthrow.diagnose.models.quadrotor.flyer_params import MOTORS, QuadrotorParams
from visthrow.diagnose.models.quadrotor.flyer_windows import NEIGHBOUR, apply_lag, expect_thrust
from visthrow.logs.flightlog import FlightLog

SHORTEST = 1e-3  # shortest lag of the motors [s], which divides
BLOCK_OF = {"payload_pos_w": 2, "rate_b": 1}  # channel -> index of the latent block that it shows


class DrivenModel(NumericModel):
    """Windows of flights of one vehicle."""

    latent_step = 1e-2
    knot_count = 8

    def __init__(self, logs: Sequence[FlightLog], params: QuadrotorParams):
        """Cut the flights into windows; ``channels``, ``inputs`` and ``needed`` must be set before.

        Raises LogError: no log has the channels, or no log shows a flight.
        """
        blocks = [0, *[BLOCK_OF[name] for name in self.channels if name in BLOCK_OF]]
        self.pushes = [(block, axis) for block in blocks for axis in range(3)]
        self.steps = round(params.window / params.step)
        super().__init__(logs, params)

    @property
    def motors(self) -> int:
        """Return the number of columns of the inputs."""
        return self.stretches[0].data["sent"].values.shape[1]

    @property
    def has_voltage(self) -> bool:
        """Return whether all logs hold the battery's voltage."""
        return "battery_voltage" in self.inputs

    def catalogue(self) -> list[ModelEffect]:
        """See the base class; ``thrust_fade`` is left out where the voltage is logged."""
        effects = super().catalogue()
        return [e for e in effects if not (self.has_voltage and e.name == "thrust_fade")]

    def cut(self, logs: Sequence[FlightLog]) -> list[Stretch]:
        """See the base class; at most ``most_windows``, spread evenly.

        Raises LogError: the commands' thrust is far above the weight.
        """
        stretches = super().cut(logs)
        limit = self.params.most_windows
        for name in ("battery_voltage", NEIGHBOUR):
            count = sum(name in log for log in logs)
            if 0 < count < len(logs):
                note = f"{name} is not used: only {count} of {len(logs)} logs hold it"
                self.notes = (*self.notes, note)
        if stretches:
            expect_thrust(stretches, self.params)
        if len(stretches) <= limit:
            return stretches
        self.notes = (*self.notes, f"long flights: only {limit} windows are used, spread evenly")
        chosen = np.linspace(0, len(stretches) - 1, limit).round().astype(int)
        return [stretches[i] for i in chosen]

    def thrusts(self, lanes: Lanes, steps: int) -> ndarray:
        """Return the thrust of each motor at the half steps of a window [N], shape (half steps, B,
        motors): the map's for the held commands, with lag.

        The value in the middle of a step is such that Simpson's rule, and hence the integration,
        gives the exact mean over the step, although commands may change within it."""
        p = self.params
        step = p.step * self.steps / steps
        grid = 0.5 * step * np.arange(2 * steps + 1)[:, None]
        delay = p.command_delay + self.size_of(lanes, "cmd_delay")
        tau = p.motor_time_constant + self.size_of(lanes, "motor_tau")
        columns = [lanes.owner, delay, np.maximum(tau, SHORTEST)]
        distinct, which = np.unique(np.column_stack(columns), axis=0, return_inverse=True)
        thrust = np.empty((len(grid), len(lanes.owner), self.motors))
        for number, (owner, late, lag) in enumerate(distinct):
            data = self.stretches[int(owner)].data
            time, inputs = data["sent"]
            at_ends = data["start"] + grid[::2] - late
            ends, integral = apply_lag(time, p.thrust(inputs), at_ends, lag)
            mean = np.diff(integral, axis=0) / step
            lane = which == number
            thrust[::2, lane] = ends[:, None]
            thrust[1::2, lane] = (1.5 * mean - 0.25 * (ends[:-1] + ends[1:]))[:, None]
        curve = self.size_of(lanes, "thrust_curve")[:, None]
        hover = p.total_mass * p.gravity / self.motors  # of one input channel [N]
        since = self.of_windows(lanes, "since") + grid
        faded = 1.0 + self.size_of(lanes, "thrust_fade") * since
        curved = 1.0 + curve * (thrust / hover - 1.0)
        return thrust * self._scale(lanes) * curved * faded[..., None]

    def _scale(self, lanes: Lanes) -> ndarray:
        """Return the ratio of each motor's thrust to the map's, shape (B, motors)."""
        p = self.params
        volts = np.zeros(len(lanes.owner))
        if self.has_voltage:
            volts = self.of_windows(lanes, "volts") - p.reference_voltage
        sag = p.voltage_coefficient + self.size_of(lanes, "battery_sag")
        scale = (1.0 + self.size_of(lanes, "thrust_gain")) * (1.0 + sag * volts)
        scales = self.stack(lanes, *(f"motor_{name}" for name in MOTORS))
        return scale[:, None] * (1.0 + scales[:, : self.motors])


def in_all(logs: Sequence[Container[str]], *names: str) -> list[str]:
    """Return the names that all logs hold."""
    return [name for name in names if all(name in log for log in logs)]

"""Extract from a flight log what a replay needs: commands, release, and the measurements of
vehicle, payload and gyro.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy import ndarray

from visthrow.common.errors import DiagnoseError
from visthrow.common.rotations import continuous
from visthrow.logs.check.signals import sensor_sigma
from visthrow.logs.flightlog import FlightLog
from visthrow.logs.samples import Samples

NEVER = 1e9  # a time after every flight [s]
LEAST_SIGMA = {"pos_w": 2e-5, "quat_wb": 1e-4, "payload_pos_w": 2e-5, "rate_b": 1e-3}
"""Smallest noise that is assumed, because of numerical errors and rounding [m], [rad], [m],
[rad/s].
"""

BETWEEN = 0.05  # longest time between two attitudes over which they are interpolated [s]
# sampling rate of the gyro [1/s]; at 500 steps a second, a faster one carries no more information
SUFFICIENT_RATE = 250.0
AT_START = 0.25  # beginning of a log, whose voltages give the charge used before [s]


@dataclass(frozen=True)
class ChannelSamples:
    """Valid samples of one measured channel."""

    time: ndarray  # [s], shape (T,)
    values: ndarray  # shape (T, 3) or (T, 4)
    sigma: float  # noise of one component; for an attitude, of the angle [rad]

    def during(self, first: float, last: float) -> "ChannelSamples":
        """Return the samples with first <= time < last."""
        span = slice(*np.searchsorted(self.time, (first, last)))
        return ChannelSamples(self.time[span], self.values[span], self.sigma)


NO_SAMPLES = ChannelSamples(np.zeros(0), np.zeros((0, 3)), 1.0)


@dataclass(frozen=True)
class RecordedFlight:
    """The commands and measurements of one flight."""

    command_time: ndarray  # [s], shape (C,)
    command: ndarray  # [N, rad/s], shape (C, 4)
    latch: float  # of the release, or NEVER [s]
    landing: float  # of the payload, or NEVER [s]
    vehicle: ChannelSamples  # positions [m]; attitudes at the same stamps in ``attitude``
    attitude: ChannelSamples  # quaternions xyzw
    payload: ChannelSamples | None
    gyro: ChannelSamples | None
    voltage: float | None  # at the start [V]
    hanging: bool | None = None  # whether a payload hung below at the start; None if not logged
    landing_point: ndarray | None = None  # logged landing of the payload [m], shape (3,)

    @property
    def start(self) -> float:
        """Return the first time at which both commands and poses are known [s]."""
        return max(self.command_time[0], self.vehicle.time[0])

    @property
    def end(self) -> float:
        """Return the last time at which both commands and poses are known [s]."""
        period = np.median(np.diff(self.command_time)) if len(self.command_time) > 1 else 0.02
        return min(self.command_time[-1] + period, self.vehicle.time[-1] + 1e-6)


def find_measured(log: FlightLog, name: str) -> Samples | None:
    """Return the valid samples of a channel, the measured ones if a log also holds the truth; None
    if there are none.
    """
    return log.samples(f"measured_{name}", 1) or log.samples(name, 1)


def _samples(log: FlightLog, name: str) -> ChannelSamples | None:
    samples = find_measured(log, name)
    if samples is None:
        return None
    time, values = samples
    fresh = np.ones(len(time), dtype=bool)
    fresh[1:] = (values[1:] != values[:-1]).any(1)  # a repeated sample is stale
    if np.count_nonzero(fresh) < 5:
        return None
    if not _is_rounded(values):
        time = time[fresh]
        values = values[fresh]
    if name == "quat_wb":
        values = continuous(values / np.linalg.norm(values, axis=1, keepdims=True))
    if name == "rate_b":
        time, values = _thin(time, values)
        if len(time) < 5:
            return None
    noise = sensor_sigma(values)
    # A rotation by a small angle changes three of a quaternion's four numbers by half of it.
    sigma = np.median(noise)
    if name == "quat_wb":
        sigma = 2.0 * np.sqrt((noise**2).sum() / 3.0)
    return ChannelSamples(time, values, max(sigma, LEAST_SIGMA[name]))


def _thin(time: ndarray, values: ndarray) -> tuple[ndarray, ndarray]:
    """Decimate samples that come at twice :data:`SUFFICIENT_RATE` or faster, shape (T,) and (T, N),
    to every n-th one, smoothed.

    A parabola through 2 n + 1 samples keeps a motion of 20 Hz to 0.03 %, and keeps the noise nearly
    white: neighbours correlate by at most 0.07. Times are smoothed in the same way, so single
    samples may be missing. No parabola extends across a gap.

    Source: Savitzky and Golay 1964.
    """
    steps = np.diff(time)
    stride = int(1.0 / (SUFFICIENT_RATE * np.median(steps)) + 0.1)  # clocks are some per cent off
    if stride < 2:
        return time, values
    from scipy.signal import savgol_filter

    width = 2 * stride + 1
    gaps = np.flatnonzero(steps > 1.5 / SUFFICIENT_RATE) + 1
    table = np.column_stack((time, values))
    parts = [table[:0]]
    for stretch in np.split(table, gaps):
        if len(stretch) >= width:
            smooth = savgol_filter(stretch, width, 2, axis=0)
            parts.append(smooth[stride:-stride:stride])
    thinned = np.concatenate(parts)
    return thinned[:, 0], thinned[:, 1:]


def _is_rounded(values: ndarray) -> bool:
    """Return whether most changes of a channel, shape (T, N), equal the step to which it is
    rounded.

    Samples of such a channel repeat without being stale. If the repeated ones were dropped, those
    just after a step would remain, which are half a step ahead of the measured value."""
    changes = np.abs(np.diff(values, axis=0))
    changes = changes[changes > 0.0]
    smallest = changes.min(initial=np.inf)
    return len(changes) > 0 and np.median(changes) < 1.5 * smallest


def record_of(log: FlightLog, number: int = 0) -> RecordedFlight:
    """Extract from a log what a replay needs.

    Raises DiagnoseError: no commands, or no poses of the vehicle.
    """
    missing = [name for name in ("command", "pos_w", "quat_wb") if find_measured(log, name) is None]
    if missing:
        raise DiagnoseError(
            f"flight {number} holds no {' and no '.join(missing)}; a replay needs command (or an"
            " autopilot's throttle and rate_setpoint_b, of which it is made), pos_w and quat_wb; it"
            f" has {', '.join(sorted(log.channels))}; a table's columns get these names by"
            " --config; where that holds a model, such as [flyer], other channels suffice"
            " (docs/reference/models.md)"
        )
    pos = _samples(log, "pos_w")
    quat = _samples(log, "quat_wb")
    if pos is None or quat is None:
        raise DiagnoseError(f"flight {number} holds fewer than five poses of the vehicle")
    pos, quat = _pair(pos, quat, number)
    landing, landing_point = _find_landing(log)
    time, command = log["command"].samples()
    return RecordedFlight(
        time,
        command,
        _latch(log),
        landing,
        pos,
        quat,
        _payload(log, landing),
        _samples(log, "rate_b"),
        _voltage(log),
        _hangs(log),
        landing_point,
    )


def _pair(
    pos: ChannelSamples, quat: ChannelSamples, number: int
) -> tuple[ChannelSamples, ChannelSamples]:
    """Pair positions with attitudes of the same time: those of common stamps, else attitudes
    interpolated at the stamps of the positions.

    Raises DiagnoseError: fewer than five pairs exist.
    """
    common, at_pos, at_quat = np.intersect1d(
        np.round(pos.time, 7), np.round(quat.time, 7), return_indices=True
    )
    if len(common) >= max(5, 0.2 * min(len(pos.time), len(quat.time))):
        rows = at_pos
        attitudes = quat.values[at_quat]
    else:
        last = len(quat.time) - 1
        index = np.clip(np.searchsorted(quat.time, pos.time), 1, last)
        close = quat.time[index] - quat.time[index - 1] < BETWEEN
        covered = (pos.time >= quat.time[0]) & (pos.time <= quat.time[last])
        rows = np.flatnonzero(close & covered)
        attitudes = Samples(quat.time, quat.values).attitudes(pos.time[rows])
    if len(rows) < 5:
        raise DiagnoseError(
            f"flight {number}: hardly any position lies between two attitudes less than"
            f" {1e3 * BETWEEN:.0f} ms apart: the attitude comes every"
            f" {1e3 * np.median(np.diff(quat.time)):.0f} ms, from {quat.time[0]:.1f} to"
            f" {quat.time[-1]:.1f} s; positions from {pos.time[0]:.1f} to {pos.time[-1]:.1f} s"
        )
    time = pos.time[rows]
    vehicle = ChannelSamples(time, pos.values[rows], pos.sigma)
    return vehicle, ChannelSamples(time, attitudes, quat.sigma)


def carriers(flights: Sequence[RecordedFlight]) -> list[bool]:
    """Return whether each flight carries a payload.

    The log may state it. Otherwise a flight carries one if its log measured or released a payload.
    If no flight measured a payload, a release in one flight implies a payload in all."""
    measured_somewhere = any(f.payload is not None for f in flights)
    released_somewhere = any(f.latch != NEVER for f in flights)
    hanging = [
        f.payload is not None or f.latch != NEVER if measured_somewhere else released_somewhere
        for f in flights
    ]
    return [measured if f.hanging is None else f.hanging for f, measured in zip(flights, hanging)]


def _hangs(log: FlightLog) -> bool | None:
    attached = find_measured(log, "attached")
    return None if attached is None else bool(attached.values[0, 0])


def _latch(log: FlightLog) -> float:
    """Return when the release was commanded."""
    commands = find_measured(log, "release_command")
    if commands is None:
        return NEVER
    time, values = commands
    return min(time[values[:, 0] > 0.5], default=NEVER)


def _find_landing(log: FlightLog) -> tuple[float, ndarray | None]:
    """Return time and point of the payload's landing."""
    landing = find_measured(log, "landing")
    if landing is None:
        return NEVER, None
    return landing.time[0], landing.values[0]


def _voltage(log: FlightLog) -> float | None:
    """Return the terminal voltage at the start of a log: a median, as single samples are noisy."""
    voltage = find_measured(log, "battery_voltage")
    if voltage is None:
        return None
    time, volts = voltage
    return np.median(volts[time < time[0] + AT_START])


def _payload(log: FlightLog, landing: float) -> ChannelSamples | None:
    samples = _samples(log, "payload_pos_w")
    if samples is None:
        return None
    flown = samples.during(-np.inf, landing - 1e-3)
    return flown if len(flown.time) >= 5 else None

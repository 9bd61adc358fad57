"""Windows of a quadrotor's logs: measurements, inputs, and first guesses of the initial state."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy import ndarray

from visthrow.common.errors import LogError
from visthrow.common.free_fall import GRAVITY
from visthrow.common.rotations import cross, normal_part, rotate
from visthrow.diagnose.models.numeric import Stretch, sigma_of, take_samples
from visthrow.diagnose.models.quadrotor.flyer_params import FlyerParams, QuadrotorParams
from visthrow.logs.flightlog import Channel, FlightLog
from visthrow.logs.samples import Samples

# smallest noise assumed of a channel; 1e-4 for the others
LEAST_SIGMA = {"rate_b": 2e-3, "acc_b": 1e-2}
Table = tuple[ndarray, ndarray, ndarray]
"""Stamps [s], shape (n,), values, shape (n, C), and their noise, shape (C,)."""
NEIGHBOUR = "neighbour_pos_w"  # measured position of a body that may push the vehicle
_GUESS = 0.25  # first guesses are from straight lines through this much of a window [s]
MOST_MISSING = 0.25  # largest gap in an input within a window [s]
# largest ratio of the map's median thrust to the weight: a wrong map may reach it, a wrong unit
# exceeds it
_MOST_THRUST = 5.0
_MEMORY = 10.0  # past that a filter remembers, in its time constants
IDLE = 0.3  # thrust over weight below which the vehicle is on the ground


def expect_thrust(stretches: Sequence[Stretch], params: QuadrotorParams) -> None:
    """Refuse commands in a wrong unit, whose thrust is far above the weight.

    Raises LogError: the median thrust exceeds ``_MOST_THRUST`` weights.
    """
    weight = params.gravity * params.total_mass
    inputs = np.concatenate([s.data["sent"].values for s in stretches])
    ratio = np.median(params.thrust(inputs).sum(axis=1)) / weight
    if ratio > _MOST_THRUST:
        raise LogError(
            f"the thrust by {params.input} and the setup's thrust_map is {ratio:.3g} times the"
            f" weight of {weight:.3g} N: another unit, or another vehicle's map; expected at most"
            f" {_MOST_THRUST:g} times"
        )


def cut_flying(
    log: FlightLog, params: QuadrotorParams, channels: Sequence[str], driving: Sequence[str]
) -> Iterator[tuple[float, list[Table], dict[str, Any]]]:
    """Yield each window in which the vehicle flies and no channel of ``driving`` has a large gap:
    its start [s], samples of ``channels``, and the motors' inputs.
    """
    sigma = {name: sigma_of(log[name], LEAST_SIGMA.get(name, 1e-4)) for name in channels}
    driven = [log[name] for name in driving]
    commands = log[params.input].samples()
    if params.input == "command":
        commands = Samples(commands.time, commands.values[:, :1])
    first = max(c.time[0] for c in driven)
    last = min(c.time[-1] for c in driven)
    starts = np.arange(first + params.window, last - params.window, params.window)
    # of long logs, only every stride-th window is cut
    stride = max(1, len(starts) // (4 * params.most_windows))
    for start in starts[::stride]:
        if not all(is_covered(c, start, start + params.window) for c in driven):
            continue
        end = start + params.window
        if not flies(cut_commands(commands, start, end).values, params):
            continue
        tables = [(*take_samples(log[name], params, start), sd) for name, sd in sigma.items()]
        sent = cut_commands(commands, start - params.window, end + params.window)
        common: dict[str, Any] = {"start": start, "sent": sent, "volts": 0.0}
        common["since"] = start - log[params.input].time[0]
        if "battery_voltage" in log:
            middle = np.array([start + 0.5 * params.window])
            common["volts"] = log["battery_voltage"].hold(middle)[0]
        yield start, tables, common


def is_covered(channel: Channel, start: float, end: float) -> bool:
    """Return whether a channel has no large gap between two times."""
    during = (channel.time >= start) & (channel.time <= end)
    stamps = channel.time[channel.valid & during]
    gaps = np.diff([start, *stamps, end])
    return len(stamps) > 5 and np.max(gaps) < MOST_MISSING


def flies(inputs: ndarray, params: QuadrotorParams) -> bool:
    """Return whether the thrust of a window's inputs is always above that of a vehicle on the
    ground.
    """
    thrust = params.thrust(inputs).sum(axis=1)
    return np.min(thrust) >= IDLE * params.mass * params.gravity


def cut_commands(commands: Samples, first: float, last: float) -> Samples:
    """Return the commands that are held between two times; at least one, the nearest."""
    time, values = commands
    begin = max(np.searchsorted(time, first, "right") - 1, 0)
    end = max(np.searchsorted(time, last), begin + 1)
    return Samples(time[begin:end], values[begin:end])


def apply_lag(
    time: ndarray, commanded: ndarray, instants: ndarray, lag: float
) -> tuple[ndarray, ndarray]:
    """Return the response of a first-order lag to held commands, and its integral up to a constant,
    each of shape (T, N).

    ``time``: of the commands [s], shape (C,); before it, the first is held; ``commanded``: shape
    (C, N); ``instants``: of the response [s], shape (T, 1); ``lag``: time constant [s].
    """
    changes = np.diff(commanded, axis=0)
    age = np.maximum(instants - time[1:], 0.0)
    value = commanded[0] + (1.0 - np.exp(-age / lag)) @ changes
    since = instants - instants[0]
    return value, since * commanded[0] + age @ changes - lag * value


def find_acting(time: ndarray, values: ndarray, delay: float, start: float, end: float) -> ndarray:
    """Return the indices of the commands that act between two times and differ from the one before.

    ``time``: of the commands [s], shape (C,); ``values``: shape (C, N); ``delay``: before they act
    [s]."""
    acts = time + delay
    replaced = np.append(acts[1:], np.inf)
    during = (replaced > start) & (acts < end)
    changed = np.any(np.diff(values, axis=0) != 0.0, axis=1)
    return np.flatnonzero(during & np.append(False, changed))


def without_each(commands: Samples, params: FlyerParams, start: float) -> list[Samples]:
    """Return copies of the commands, each without one that acts in the window; the command before
    it is held instead.
    """
    time, values = commands
    inputs = []
    for k in find_acting(time, values, params.command_delay, start, start + params.window):
        repeated = values.copy()
        repeated[k] = values[k - 1]
        inputs.append(Samples(time, repeated))
    return inputs


def lean_of(log: FlightLog, attitude: str, rate: float, times: ndarray) -> ndarray:
    """Return the rotation vector from the estimated attitude to the true one, shape (T, 3); 0
    without an accelerometer.

    An attitude filter that assumes a force along the rotors' axis only mistakes forces in the rotor
    plane for tilt, at ``rate`` [1/s]. A gyro's offset tilts the estimate too, until the correction,
    which is the gyro minus the estimate's rate, balances the offset. The flight's median is
    subtracted from the force, because a tilted sensor causes a constant.

    Source: Mueller, Hamer and D'Andrea 2015; firmware of the Crazyflie, kalman_core.c (only
    acceleration in z)."""
    force_b = log.samples("acc_b", 1)
    if force_b is None:
        return np.zeros((len(times), 3))
    time, force = force_b
    share = force[:, :2] / np.maximum(force[:, 2:], IDLE * GRAVITY)
    share = share - np.median(share, axis=0)
    recent = cut_commands(Samples(time, share), times[0] - _MEMORY / rate, times[-1])
    tilt, _ = apply_lag(*recent, times[:, None], 1.0 / rate)
    upright = np.array([0.0, 0.0, 1.0])
    turn = cross(np.pad(tilt, ((0, 0), (0, 1))), upright)
    gyro = log.samples("rate_b", 1)
    if gyro is not None:
        stamps, turning = log[attitude].samples().rates()
        # gyro less the rate of the estimated attitude, in the middle of the flight [rad/s]
        offset = np.median(gyro.mean_over(stamps, 0.06) - turning, axis=0)
        turn[:, :2] -= offset[:2] / rate
    return turn


def _line(table: Table, start: float) -> ndarray:
    """Return value and slope at the start of a straight line through the samples after it."""
    time, values, _ = table
    early = time <= max(start + _GUESS, time[min(3, len(time) - 1)])
    return np.polynomial.polynomial.polyfit(time[early] - start, values[early], 1)


def guess_start(
    tables: Mapping[str, Table], params: FlyerParams, quat: ndarray, rate: ndarray
) -> tuple[ndarray, ndarray, ndarray]:
    """Return a first guess of the initial state, its standard deviations, and the cable's direction
    there.

    ``tables``: samples of each channel; ``quat, rate``: attitude and body rate at the start.
    """
    measured = tables[params.position]
    start = measured[0][0]
    pos, vel = _line(measured, start)
    guess = [*pos, *vel]
    spread = [0.1] * 3 + [1.0] * 3
    direction = np.array([0.0, 0.0, -1.0])
    swing = np.zeros(3)
    if params.cable is not None:
        table = tables["payload_pos_w"]
        if len(table[0]) >= 4:
            pos_p, vel_p = _line(table, start)
            mount = np.array(params.cable.mount)
            gap = pos_p - pos - rotate(quat, mount)
            direction = gap / np.linalg.norm(gap)
            arm_rate = rotate(quat, cross(rate, mount))
            swing = normal_part((vel_p - vel - arm_rate) / params.cable.length, direction)
        guess += [0.0, 0.0, *swing[:2]]
        spread += [0.1, 0.1, 1.0, 1.0]
    if params.torque is not None:
        _, gyro, _ = tables["rate_b"]
        guess += list(gyro[0]) if len(gyro) else [0.0] * 3
        spread += [1.0] * 3
    return np.array(guess), np.array(spread), direction

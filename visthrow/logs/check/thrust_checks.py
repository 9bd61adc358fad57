"""Checks of thrust and rotors: commanded thrust and measured force, and rotors among each other."""

from collections.abc import Iterator, Sequence

import numpy as np

from visthrow.common.errors import suggest
from visthrow.common.rotations import rotate_back
from visthrow.logs.check import relations
from visthrow.logs.check.physics import (
    CLEARLY,
    DELAY_BAD,
    FIRMLY,
    GRAVITY,
    LATEST,
    MOVES,
    accelerations,
    hangs,
    is_usable,
    sparse,
)
from visthrow.logs.check.rows import NOTHING, KnownVehicle, Row
from visthrow.logs.flightlog import FlightLog
from visthrow.logs.samples import Samples
from visthrow.logs.unit_names import nearest

INPUTS = (
    "command",
    "thrust_command",
    "throttle",
    "motor_speed",
    "motor_command",
    "motor_output",
    "pwm",
)
PULSES = ("motor_output", "pwm")  # pulse lengths, or numbers from 0 upwards
ROTORS = ("motor_speed", "motor_command", "motor_output", "pwm")
NAMES = ("front left", "front right", "rear left", "rear right")

UNITS = {"N": 1.0, "g of thrust": 9.80665e-3, "mN": 1e-3, "kg of thrust": 9.80665}
"""Units of a thrust, in newtons."""
_UNIT = 0.25  # largest distance of a ratio's logarithm from a unit's
_SPAN = 0.1  # averaging time of both forces, which removes vibration [s]
# time around a change of the load in which thrust and force may belong to different loads [s]
_CHANGING = 0.5
_VARIES = 0.003  # smallest relative variation of a force at which it is compared
# Correlation. In 13 real flights, force and thrust of the same flight correlate by 0.53 to 0.94, of
# different flights by up to 0.38 (median 0.15).
_FOLLOWS = 0.4
# evidence for no relation to the thrust [nats] above which the thrust is of another flight
_AGAINST = 8.0
# samples (2 s) over which battery charge and motor temperature hardly change force over thrust
_SAGGING = 200
_DELAYS = np.arange(-0.2, 0.4001, 0.01)  # candidates [s]
_OF_MOTORS = (_DELAYS > -0.005) & (_DELAYS < LATEST)  # delays that motors can have
_MOTORS = 0.07  # typical delay of motors [s]
MASS_WARN = 0.15  # logarithm of thrust over weight that a battery's charge does not explain
MASS_BAD = 1.0  # logarithm of thrust over weight with another unit or map
IDLE_PULSE = 1000.0  # pulse length at which a motor stands still [us]
_OUTLIER = 4.0  # limit of values, in robust deviations, against crashes and tumbles
IDLE_SPEED = 100.0  # rotor speed below which a vehicle does not fly [rad/s]
IDLE_SHARE = 0.12  # share of the full command below which a vehicle does not fly
# logarithm of a rotor's value over the others'; a weight on an arm or a cut blade causes 0.25
_UNEVEN = 0.4


def look(log: FlightLog, vehicle: KnownVehicle = NOTHING) -> Iterator[Row]:
    """Yield the findings on thrust and rotors of a flight."""
    yield from _force(log, vehicle)
    yield from _rotors(log)
    yield from _check_turn_direction(log)


def thrust_of(log: FlightLog, vehicle: KnownVehicle = NOTHING) -> tuple[str, Samples] | None:
    """Return the collective thrust of a log.

    Returns channel and thrust, shape (N, 1), in newtons if the channel's unit or a map is known;
    None if no channel holds a thrust."""
    name = vehicle.thrust_input or next((name for name in INPUTS if name in log), "")
    driver = log.samples(name)
    if driver is None:
        return None
    values = driver.values
    if name == "command":
        values = values[:, :1]
    if vehicle.thrust_map is not None and name == vehicle.thrust_input:
        values = sum(c * values**i for i, c in enumerate(vehicle.thrust_map))
    elif name == "motor_speed":
        values = values**2
    elif name in PULSES and are_pulses(values):
        values = np.maximum(values - IDLE_PULSE, 0.0)
    return name, Samples(driver.time, np.sum(values, axis=1, keepdims=True))


def are_pulses(outputs: np.ndarray) -> bool:
    """Return whether outputs to motors are pulse lengths [us]."""
    return bool(IDLE_PULSE - 200.0 < np.median(outputs) < 2300.0)


def follows(log: FlightLog, name: str) -> float | None:
    """Return the correlation of the measured force with an input; None if it is unknown."""
    thrust = thrust_of(log, KnownVehicle(thrust_input=name))
    if thrust is None or np.median(thrust[1].values) <= 0.0:
        return None
    curves = [curve for _, curve, _ in _correlations(log, thrust[1])]
    return max((np.max(curve[_OF_MOTORS]) for curve in curves), default=None)


def mass_of(log: FlightLog, vehicle: KnownVehicle = NOTHING) -> float | None:
    """Return the mass that a thrust in newtons carries in flight [kg]; None if a channel is missing
    or the thrust is not in newtons.
    """
    thrust = thrust_of(log, vehicle)
    carried = thrust_over_force(log, vehicle)
    if thrust is None or carried is None or not _in_newtons(thrust[0], vehicle):
        return None
    return carried[0]


def _in_newtons(name: str, vehicle: KnownVehicle) -> bool:
    """Return whether a thrust comes from a channel or map in newtons."""
    return vehicle.thrust_map is not None or name in ("command", "thrust_command")


def thrust_over_force(log: FlightLog, vehicle: KnownVehicle = NOTHING) -> tuple[float, str] | None:
    """Return the ratio of mean thrust to mean specific force along body z in flight, [kg] for a
    thrust in newtons, and the measurement of the force; None if one of them is unknown.

    The ratio of means also holds in manoeuvres, as the mean force is the change of momentum.
    """
    thrust_signal = thrust_of(log, vehicle)
    if thrust_signal is None:
        return None
    time, thrust = thrust_signal[1]
    if np.max(thrust) <= 0.0:
        return None
    flies = thrust[:, 0] > 0.5 * _usual(thrust)
    carries = hangs(log, time)
    if np.any(flies & carries):  # the mass is that with the payload
        flies &= carries
    for measurement in ("acc_b", "path"):
        force = _measure_force_z(log, measurement)
        if force is None or not np.any(flies):
            continue
        if measurement == "path":  # reduces the effect of jumps of the motion capture
            force = Samples(force.time, _trim(force.values.T).T)
        acc = np.mean(force.at(time)[flies])
        if acc > 0.0:
            return float(np.mean(thrust[flies]) / acc), measurement
    return None


def _usual(thrust: np.ndarray) -> float:
    """Return the middle of a thrust while it flies."""
    return float(np.median(thrust[thrust > 0.2 * np.max(thrust)]))


def _load_changes(log: FlightLog) -> np.ndarray:
    """Return the times at which the vehicle picks up or releases a payload, or is commanded to [s];
    empty without such channels.
    """
    channels = [name for name in ("attached", "release_command") if name in log]
    if not channels:
        return np.empty(0)
    time = log[channels[0]].samples().time
    return time[np.diff(hangs(log, time), prepend=True)]


def _force(log: FlightLog, vehicle: KnownVehicle) -> Iterator[Row]:
    """Compare the thrust with the force along body z, by the accelerometer and by the path.

    Vibration disturbs only the accelerometer; air currents disturb neither."""
    driver = vehicle.thrust_input
    if driver and driver not in log:
        text = f"the model reads it, and the log lacks it; {suggest(driver, log.channels)}"
        yield Row("thrust", driver, "warn", text)
        return
    thrust = thrust_of(log, vehicle)
    if thrust is None or np.median(thrust[1].values) <= 0.0:
        return
    name, command = thrust
    carried = thrust_over_force(log, vehicle)
    if carried is not None and _in_newtons(name, vehicle):
        mass, measurement = carried
        yield _weight(mass, vehicle, f"{name}, {measurement}")
    if sparse(command.time):
        period = 1e3 * np.median(np.diff(command.time))
        text = f"comes every {period:.0f} ms: too seldom to be held against the force"
        yield Row("thrust", name, "warn", text)
        return
    correlations = list(_correlations(log, command))
    if correlations:
        yield _report_following(
            name, *max(correlations, key=lambda following: np.max(following[1]))
        )


def _report_following(name: str, measurement: str, curve: np.ndarray, against: float) -> Row:
    """Report how the measured force follows a thrust; ``curve``: correlation at each delay,
    ``against``: evidence for no relation between both [nats].
    """
    channels = f"{name}, {measurement}"
    peak = np.max(curve[_OF_MOTORS])
    best = np.max(curve)
    delay = _DELAYS[np.argmax(np.where(_OF_MOTORS, curve, -1.0))]
    figures = {
        "correlation": peak,
        "delay_s": delay,
        "nats_against": against,
        "felt_by": measurement,
    }
    clearest = _DELAYS[np.argmax(curve)]
    # Thrust with which a controller reacts to gusts opposes the force before it. So it seems early,
    # but the correlation is never high.
    gusty = clearest > _MOTORS and peak >= _FOLLOWS
    other_clock = best > max(FIRMLY if gusty else _FOLLOWS, peak + CLEARLY)
    # a slow flight fits every delay nearly: what it leaves at the right one is far less
    closer = best > FIRMLY and 1.0 - best**2 < 0.5 * (1.0 - peak**2)
    if other_clock or closer:
        off = max(-clearest, clearest - LATEST)
        delay = clearest
        way = "late" if delay < _MOTORS else "early"
        text = (
            f"the force follows the thrust by {1e3 * delay:+.0f} ms (correlation {best:.2f}, not"
            f" {peak:.2f}), motors by 0 to 120 ms: "
        )
        text += (
            f"the stream of the thrust is about {1e3 * abs(delay - _MOTORS):.0f} ms {way}; add"
            f" {delay - _MOTORS:+.2f} s to its time"
        )
        verdict = "bad" if other_clock or off > DELAY_BAD else "warn"
        return Row("delay", channels, verdict, text, figures | {"delay_s": delay})
    if peak >= _FOLLOWS:
        text = f"the force follows the thrust {1e3 * delay:.0f} ms later, correlation {peak:.2f}"
        return Row("delay", channels, "ok", text, figures)
    if against > _AGAINST:
        text = (
            f"the force does not follow the thrust (best correlation {peak:.2f}; none at all"
            f" explains it {against:.0f} nats better): thrust of another flight, another channel"
        )
        return Row("frames", channels, "bad", text, figures)
    text = (
        "whether the force follows the thrust cannot be judged: it hardly varies beside noise and"
        f" the battery's share (best correlation {peak:.2f})"
    )
    return Row("frames", channels, "warn", text, figures)


def _measure_force_z(log: FlightLog, measurement: str) -> Samples | None:
    """Return the specific force along body z [m/s^2], shape (N, 1), by the accelerometer or by the
    path.
    """
    if measurement == "acc_b":
        force_b = log.samples("acc_b")
        if force_b is None or sparse(log["acc_b"].time):
            return None
        return Samples(force_b.time, force_b.values[:, 2:3])
    path = next((n for n in ("vel_w", "pos_w") if n in log), None)
    attitude = log.samples("quat_wb")
    if path is None or attitude is None:
        return None
    time, acc = accelerations(log[path].samples(), log[path].unit)
    if len(time) < 50:
        return None
    turn = attitude.attitudes(time)
    return Samples(time, rotate_back(turn, acc + [0.0, 0.0, GRAVITY])[:, 2:3])


def _correlations(log: FlightLog, command: Samples) -> Iterator[tuple[str, np.ndarray, float]]:
    """Yield, for each measurement of the force that varies, its name, the correlation with the
    thrust in flight at each delay, and the evidence for no relation between both [nats].

    Thrust is proportional to the force only for a constant mass. So both are relative to their
    means between changes of the load.
    """
    thrust = command.values[:, 0]
    flies = command.time[thrust > 0.6 * _usual(thrust)]
    changes = _load_changes(log)
    for measurement in ("acc_b", "path"):
        force = _measure_force_z(log, measurement)
        if force is None:
            continue
        start = max(flies[0] + 0.5, force.time[0] + 0.3)
        end = min(flies[-1], force.time[-1]) - 0.5
        grid = np.arange(start, end, 0.01)
        load = np.searchsorted(changes, grid - _CHANGING)
        steady = load == np.searchsorted(changes, grid + _CHANGING)
        grid = grid[steady]
        if len(grid) < 200:
            continue
        x = command.mean_over(grid, _SPAN)[:, 0]
        y = np.array([force.mean_over(grid + delay, _SPAN)[:, 0] for delay in _DELAYS])
        splits = np.flatnonzero(np.diff(load[steady])) + 1
        xs = np.split(x, splits)
        ys = np.split(y, splits, axis=1)
        trimmed_x = [_trim(part) for part in xs]
        trimmed_y = [_trim(part) for part in ys]
        curves = [
            _curve(_relative(xs), _relative(ys)),
            _curve(_relative(trimmed_x), _relative(trimmed_y)),
        ]
        if known := list(filter(None, curves)):
            yield measurement, *max(known, key=lambda curve: np.max(curve[0]))


def _relative(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Concatenate parts, each of shape (..., T), each relative to its mean."""
    return np.concatenate([p / np.mean(p, axis=-1, keepdims=True) - 1.0 for p in parts], axis=-1)


def _curve(x: np.ndarray, varies: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Return the correlation of a thrust, shape (T,), with the force at each delay, shape (D, T),
    both relative to their means, and the evidence for no relation between both [nats]; None if one
    does not vary.
    """
    from scipy.ndimage import uniform_filter1d

    if np.std(x) < _VARIES or np.min(np.std(varies, axis=1)) < _VARIES:
        return None
    curve = varies @ x / (len(x) * np.std(x) * np.std(varies, axis=1))
    best = int(np.argmax(np.where(_OF_MOTORS, curve, -1.0)))
    independent = 0.01 * len(x) / (2.0 * _SPAN)
    force = varies[best]
    quick, quick_force = (part - uniform_filter1d(part, _SAGGING) for part in (x, force))
    return curve, 0.5 * independent * np.log(np.var(quick_force - quick) / np.var(quick_force))


def _trim(values: np.ndarray) -> np.ndarray:
    """Return values, shape (..., T), clipped to ``_OUTLIER`` robust deviations about their
    median.
    """
    middle = np.median(values, axis=-1, keepdims=True)
    reach = _OUTLIER * 1.4826 * np.median(np.abs(values - middle), axis=-1, keepdims=True)
    reach[reach == 0.0] = np.inf
    return np.clip(values, middle - reach, middle + reach)


def _weight(mass: float, vehicle: KnownVehicle, channels: str) -> Row:
    """Compare the ratio of thrust to force with the mass of the model."""
    text = f"thrust over force {mass:.4g} kg"
    if not vehicle.mass:
        return Row("thrust", channels, "ok", text, {"mass_kg": mass})
    ratio = mass / vehicle.mass
    text += f", {ratio:.3g} times the model's {vehicle.mass:.4g} kg"
    figures = {"mass_kg": mass, "model_kg": vehicle.mass}
    off = np.log(ratio)
    if abs(off) > MASS_BAD:
        sizes = {f"in {unit}": size for unit, size in UNITS.items()}
        words, miss = nearest(ratio, sizes | {"the model's mass is in g": 1e3})
        if miss > _UNIT:
            words = (
                "no battery's charge does that: mass or thrust map of another vehicle, or in"
                " another unit"
            )
        return Row("units", channels, "bad", f"{text}: {words}", figures)
    if abs(off) <= MASS_WARN:
        return Row("thrust", channels, "ok", text, figures)
    text += ": the thrust map is of another vehicle, battery or channel"
    text += ", or a load that the model lacks hangs below" if off > 0.0 else ""
    return Row("thrust", channels, "warn", text, figures)


def _rotors(log: FlightLog) -> Iterator[Row]:
    """Compare the rotors with each other: in hover, all have similar values."""
    for name in ROTORS:
        motors = log.samples(name)
        if motors is None or log[name].values.shape[1:] != (4,):
            continue
        total = np.mean(motors.values, axis=1)
        high = np.percentile(total, 90)
        if high <= (IDLE_SPEED if name == "motor_speed" else IDLE_SHARE):
            continue
        medians = np.median(motors.values[total > 0.5 * high], axis=0)
        for i, rotor in enumerate(NAMES):
            typical = np.median(np.delete(medians, i))
            ratio = medians[i] / typical if typical > 0.0 else 1.0
            if abs(np.log(max(ratio, 1e-3))) >= _UNEVEN:
                text = f"{rotor} reads {ratio:.2f} of the others in flight: {_uneven(ratio)}"
                yield Row("thrust", name, "bad", text, {"rotor": i, "ratio": ratio})


def _uneven(ratio: float) -> str:
    """Return the text on a rotor whose value is ``ratio`` times the others'."""
    if ratio < 0.02:
        return "its sensor is dead, or the rotor stands"
    factor, miss = nearest(ratio, {"half: ": 2.0, "twice: ": 0.5})
    word = factor if miss < 0.15 else ""
    return f"{word}no trim explains it; a sensor (pole pairs, a lost wire), or the rotor"


def _check_turn_direction(log: FlightLog) -> Iterator[Row]:
    """Check order and sign of the motors by the direction in which their differences turn the
    vehicle.
    """
    name = next((n for n in ("motor_speed", "motor_command", "pwm") if n in log), "")
    motors = log.samples(name)
    rate = log.samples("rate_b")
    if motors is None or not is_usable(rate, MOVES) or log[name].values.shape[1:] != (4,):
        return
    time_d, turning = rate.derivative(0.03)
    front_left, front_right, rear_left, rear_right = motors.values.T
    roll = front_left + rear_left - front_right - rear_right
    pitch = rear_left + rear_right - front_left - front_right
    if len(time_d) < 50 or max(np.std(roll), np.std(pitch)) <= 0.0:
        return
    for axis, (word, torque) in enumerate((("roll", roll), ("pitch", pitch))):
        driven = Samples(motors.time, torque[:, None])
        relation = relations.relate(driven, Samples(time_d, turning[:, axis : axis + 1]), 0.2)
        if relation is not None and relation.axes_correlation >= 0.2:
            yield _check_turning(word, relation, f"{name}, rate_b")


def _check_turning(word: str, relation: relations.Relation, channels: str) -> Row:
    """Report whether the vehicle turns about an axis in the direction of its motors' torque."""
    figures = {"correlation": relation.correlation, "delay_s": relation.delay}
    clear = relation.axes_correlation > relation.correlation + CLEARLY
    wrong = clear and relation.axes.startswith("-")
    correlation = relation.axes_correlation if wrong else relation.correlation
    text = f"{word} turns {'against' if wrong else 'with'} the motors,"
    text += f" {1e3 * relation.delay:.1f} ms later, correlation {correlation:.2f}"
    if wrong:
        text += ": order of the motors, or a sign"
        return Row("frames", channels, "bad", text, figures)
    if correlation < _FOLLOWS:
        text += ": too loosely to judge their order"
        return Row("frames", channels, "warn", text, figures)
    return Row("frames", channels, "ok", text, figures)

"""Checks of thrust and rotors: the force that a log commands against the force that it measures,
and rotor against rotor.
"""

import numpy as np

from visthrow.logs.check import relations
from visthrow.logs.check.physics import CLEARLY, GRAVITY, MOVES, accelerations, usable
from visthrow.logs.check.rows import NOTHING, Known, Row
from visthrow.logs.flightlog import FlightLog

INPUTS = (
    "command",
    "thrust_command",
    "throttle",
    "motor_speed",
    "motor_command",
    "motor_output",
    "pwm",
)
ROTORS = ("motor_speed", "motor_command", "motor_output", "pwm")
NAMES = ("front left", "front right", "rear left", "rear right")

UNITS = {
    "N": 1.0,
    "g of thrust": 9.80665e-3,
    "mN": 1e-3,
    "kg of thrust": 9.80665,
}  # units of a thrust, in newtons
_UNIT = 0.25  # of the logarithm of a ratio from a unit's
_SPAN = 0.1  # over which both forces are averaged: vibration goes [s]
_VARIES = 0.003  # of the mean, that a force must vary by before it says whether it follows
# correlation; forces of 13 real flights follow their own thrust by 0.53 to 0.94, that of another by
# 0.38 (median 0.15)
_FOLLOWS = 0.4
# nats by which no thrust at all must explain the force better, before thrust counts as another
# flight's
_AGAINST = 8.0
_DELAYS = np.arange(-0.2, 0.4001, 0.01)  # that are tried [s]
_LATEST, _MOTORS = 0.16, 0.07  # motors and their filters take 0 to 0.12 s, usually 0.07 [s]
_CLEARER = 0.04  # of correlation, by which a delay that no motor has must be better
_MASS_WARN, MASS_BAD = (
    0.15,
    1.0,
)  # of the logarithm of thrust over weight: a battery's charge; another unit or map
IDLE_SPEED, IDLE_SHARE = 100.0, 0.12  # a vehicle whose rotors stay below has not flown [rad/s], [1]
# of the logarithm of a rotor over the others: an arm's weight or a cut blade makes 0.25 of a speed
_UNEVEN = 0.4


def look(log: FlightLog, known: Known = NOTHING) -> list[Row]:
    """Return the findings about thrust and rotors in one flight."""
    return [*_force(log, known), *_rotors(log), *_turning(log)]


def thrust_of(log: FlightLog, known: Known = NOTHING) -> tuple[str, np.ndarray, np.ndarray] | None:
    """Return what a log says of its collective thrust.

    Returns channel, times [s] and thrust, shape (N, 1), in newtons where channel or map say so;
    None where it says nothing."""
    name = known.thrust_input or next((name for name in INPUTS if name in log), "")
    if name not in log or np.sum(log[name].valid) < 50:
        return None
    time, values = log[name].samples()
    if name == "command":
        values = values[:, :1]
    if known.thrust_map is not None and name == known.thrust_input:
        values = sum(c * values**i for i, c in enumerate(known.thrust_map))
    elif name == "motor_speed":
        values = values**2
    return name, time, np.sum(values, axis=1, keepdims=True)


def follows(log: FlightLog, name: str) -> float | None:
    """Return how well the measured force follows an input, as a correlation; None where unknown."""
    told = thrust_of(log, Known(thrust_input=name))
    if told is None or np.median(told[2]) <= 0.0:
        return None
    found = [c for felt in ("acc_b", "path") if (c := _correlations(log, *told[1:], felt))]
    motors = (_DELAYS > -0.005) & (_DELAYS < _LATEST)
    return max((float(np.max(curve[motors])) for curve, _ in found), default=None)


def mass_of(log: FlightLog, known: Known = NOTHING) -> float | None:
    """Return the mass that the thrust carries by the accelerometer, in flight [kg]; None where the
    log does not tell.
    """
    told = thrust_of(log, known)
    newtons = told is not None and (
        known.thrust_map is not None or told[0] in ("command", "thrust_command")
    )
    if not newtons or "acc_b" not in log or np.sum(log["acc_b"].valid) < 50:
        return None
    _, time, thrust = told
    acc = relations.on_grid(*log["acc_b"].samples(), time)[:, 2]
    flies = thrust[:, 0] > 0.5 * np.median(thrust)
    if "attached" in log and np.any(
        carries := log["attached"].hold(time) > 0.5
    ):  # without its payload it is another mass
        flies &= carries
    mass = (
        float(np.mean(thrust[flies]) / np.mean(acc[flies]))
        if np.any(flies) and np.mean(acc[flies]) > 0.0
        else 0.0
    )
    return mass if mass > 0.0 else None


def _force(log: FlightLog, known: Known) -> list[Row]:
    """Hold the thrust against the force along body z, by the accelerometer and by the path:
    vibration spoils the one, a draught none.
    """
    told = thrust_of(log, known)
    if told is None or np.median(told[2]) <= 0.0:
        return []
    name, time, asked = told
    mass = mass_of(log, known)
    rows = [_weight(mass, known, f"{name}, acc_b")] if mass is not None else []
    found = [
        (felt, *c)
        for felt in ("acc_b", "path")
        if (c := _correlations(log, time, asked, felt)) is not None
    ]
    if not found:
        return rows
    felt, curve, against = max(found, key=lambda of: np.max(of[1]))
    motors = (_DELAYS > -0.005) & (_DELAYS < _LATEST)
    own, best = float(np.max(curve[motors])), float(np.max(curve))
    delay = float(_DELAYS[np.argmax(np.where(motors, curve, -1.0))])
    figures = {"correlation": own, "delay_s": delay, "nats_against": against, "felt_by": felt}
    text, topic, verdict = (
        f"the force follows the thrust {1e3 * delay:.0f} ms later, correlation {own:.2f}",
        "delay",
        "ok",
    )
    if best > max(_FOLLOWS, own + _CLEARER):
        delay = float(_DELAYS[np.argmax(curve)])
        way = "late" if delay < _MOTORS else "early"
        verdict, figures["delay_s"] = "bad", delay
        text = (
            f"the force follows the thrust by {1e3 * delay:+.0f} ms (correlation {best:.2f}, not"
            f" {own:.2f}), motors by 0 to 120 ms: "
        )
        text += (
            f"the stream of the thrust is about {1e3 * abs(delay - _MOTORS):.0f} ms {way}; add"
            f" {delay - _MOTORS:+.2f} s to its time"
        )
    elif own < _FOLLOWS:
        topic, verdict = "frames", "bad" if against > _AGAINST else "warn"
        text = (
            f"the force does not follow the thrust (best correlation {own:.2f}; none at all"
            f" explains it {against:.0f} nats better): "
        )
        text += "thrust of another flight, another channel" + (
            "" if verdict == "bad" else ", or noise"
        )
    return [*rows, Row(topic, f"{name}, {felt}", verdict, text, figures)]


def _along_z(log: FlightLog, felt: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Times [s] and specific force along body z [m/s^2], shape (N, 1), by the accelerometer or by
    the path.
    """
    if felt == "acc_b":
        time, force_b = (
            log["acc_b"].samples() if "acc_b" in log else (np.empty(0), np.empty((0, 3)))
        )
        return time, force_b[:, 2:3]
    path = next((n for n in ("vel_w", "pos_w") if n in log), None)
    if path is None or "quat_wb" not in log:
        return None
    time, acc = accelerations(*log[path].samples(), log[path].unit)
    if len(time) < 50 or len(log["quat_wb"].samples()[0]) < 50:
        return None
    turn = relations.attitude_at(*log["quat_wb"].samples(), time)
    return time, turn.inv().apply(acc + [0.0, 0.0, GRAVITY])[:, 2:3]


def _correlations(
    log: FlightLog, time: np.ndarray, asked: np.ndarray, felt: str
) -> tuple[np.ndarray, float] | None:
    """Correlation of force and thrust in flight at each delay, and the nats by which no thrust
    explains the force better.

    None where one of them is not known or does not vary.
    """
    force = _along_z(log, felt)
    if force is None or len(force[0]) < 50:
        return None
    flies = time[asked[:, 0] > 0.6 * np.median(asked[asked > 0.2 * np.max(asked)])]
    start, end = max(flies[0] + 0.5, force[0][0] + 0.3), min(flies[-1] - 0.5, force[0][-1] - 0.5)
    grid = np.arange(start, end, 0.01)
    if len(grid) < 200:
        return None
    x = relations.mean_over(time, asked, grid, _SPAN)[:, 0]
    y = np.array([relations.mean_over(*force, grid + delay, _SPAN)[:, 0] for delay in _DELAYS])
    x, varies = x / np.mean(x) - 1.0, y / np.mean(y, axis=1, keepdims=True) - 1.0
    if np.std(x) < _VARIES or np.min(np.std(varies, axis=1)) < _VARIES:
        return None
    curve = varies @ x / (len(x) * np.std(x) * np.std(varies, axis=1))
    at = int(np.argmax(np.where((_DELAYS > -0.005) & (_DELAYS < _LATEST), curve, -1.0)))
    independent = float(np.ptp(grid)) / (2.0 * _SPAN)
    return curve, float(0.5 * independent * np.log(np.var(varies[at] - x) / np.var(varies[at])))


def _weight(mass: float, known: Known, both: str) -> Row:
    """Thrust over force against the mass that the model knows."""
    if not known.mass:
        return Row("thrust", both, "ok", f"thrust over force {mass:.4g} kg", {"mass_kg": mass})
    off, ratio = float(np.log(mass / known.mass)), mass / known.mass
    text = f"thrust over force {mass:.4g} kg, {ratio:.3g} times the model's {known.mass:.4g} kg"
    if abs(off) > MASS_BAD:
        sizes = {f"in {unit}": size for unit, size in UNITS.items()} | {
            "the model's mass is in g": 1e3
        }
        words = min(sizes, key=lambda words: abs(np.log(ratio * sizes[words])))
        if abs(np.log(ratio * sizes[words])) > _UNIT:
            words = (
                "no battery's charge does that: mass or thrust map of another vehicle, or in"
                " another unit"
            )
        return Row(
            "units", both, "bad", f"{text}: {words}", {"mass_kg": mass, "model_kg": known.mass}
        )
    verdict = "warn" if abs(off) > _MASS_WARN else "ok"
    text += (
        ": the thrust map is of another vehicle, battery or channel" if verdict == "warn" else ""
    )
    return Row("thrust", both, verdict, text, {"mass_kg": mass, "model_kg": known.mass})


def _rotors(log: FlightLog) -> list[Row]:
    """Each rotor against the others: a vehicle that hovers turns all of them alike."""
    rows = []
    for name in ROTORS:
        if name not in log or log[name].values.shape[1:] != (4,):
            continue
        _, values = log[name].samples()
        total = np.mean(values, axis=1)
        flies = total > 0.5 * np.percentile(total, 90)
        if len(values) < 50 or np.percentile(total, 90) <= (
            IDLE_SPEED if name == "motor_speed" else IDLE_SHARE
        ):
            continue
        each = np.median(values[flies], axis=0)
        for i, rotor in enumerate(NAMES):
            others = float(np.median(np.delete(each, i)))
            ratio = float(each[i] / others) if others > 0.0 else 1.0
            if abs(np.log(max(ratio, 1e-3))) < _UNEVEN:
                continue
            text = f"{rotor} reads {ratio:.2f} of the others in flight: "
            if ratio < 0.02:
                text += "its sensor is dead, or the rotor stands"
            else:
                near = next(
                    (
                        w
                        for f, w in ((0.5, "half"), (2.0, "twice"))
                        if abs(np.log(ratio / f)) < 0.15
                    ),
                    "",
                )
                text += (
                    f"{near + ': ' if near else ''}no trim explains it; a sensor (pole pairs, a"
                    " lost wire), or the rotor"
                )
            rows.append(Row("thrust", name, "bad", text, {"rotor": i, "ratio": ratio}))
    return rows


def _turning(log: FlightLog) -> list[Row]:
    """Which way the vehicle turns when motors differ: order of the motors, and sign."""
    name = next((n for n in ("motor_speed", "motor_command", "pwm") if n in log), None)
    if name is None or "rate_b" not in log or log[name].values.shape[1:] != (4,):
        return []
    (time_m, motors), (time_w, rate) = log[name].samples(), log["rate_b"].samples()
    if not usable(time_w, rate, MOVES) or len(time_m) < 50:
        return []
    time_d, turning = relations.derivative(time_w, rate, 0.03)
    front_left, front_right, rear_left, rear_right = motors.T
    torque = np.column_stack(
        [
            front_left + rear_left - front_right - rear_right,
            rear_left + rear_right - front_left - front_right,
        ]
    )
    if len(time_d) < 50 or np.max(np.std(torque, axis=0)) <= 0.0:
        return []
    rows = []
    for axis, word in enumerate(("roll", "pitch")):
        found = relations.relate(
            time_m, torque[:, axis : axis + 1], time_d, turning[:, axis : axis + 1], 0.2
        )
        if found is None or found.axes_correlation < 0.2:
            continue
        both, figures = (
            f"{name}, rate_b",
            {
                "correlation": found.correlation,
                "delay_s": found.delay,
            },
        )
        wrong = found.axes.startswith("-") and found.axes_correlation > found.correlation + CLEARLY
        text = (
            f"{word} turns {'against' if wrong else 'with'} the motors, {1e3 * found.delay:.1f} ms"
            " later"
        )
        text += f", correlation {found.axes_correlation if wrong else found.correlation:.2f}"
        text += ": order of the motors, or a sign" if wrong else ""
        rows.append(Row("frames", both, "bad" if wrong else "ok", text, figures))
    return rows

"""Excitation of a log's motion, and the questions that the log can therefore answer."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np

from visthrow.common.rotations import tilt_deg
from visthrow.common.toml_text import tables_beside
from visthrow.logs.check.physics import ATTITUDES
from visthrow.logs.check.rows import Row
from visthrow.logs.check.thrust_checks import IDLE_SHARE, IDLE_SPEED
from visthrow.logs.flightlog import FlightLog
from visthrow.logs.samples import Samples

POSITIONS = ("pos_w", "est_pos_w", "mocap_pos_w")
MOTORS = ("motor_command", "motor_speed", "pwm")
THRUSTS = ("command", "thrust_command", "motor_command", "motor_speed", "pwm")

# range of positions [m] below which a vehicle has not flown, if its motors idled or are unknown
STILL_SPEED = 0.01


@dataclass(frozen=True)
class Question:
    """A question that logs can answer, with the channels and the excitation that it needs."""

    name: str
    needs: tuple[tuple[str, ...], ...]  # groups of channels, of each of which any one is needed
    excited: str  # key of the figure of :func:`excitation` that is needed
    least: float  # smallest value of that figure


def _questions() -> tuple[Question, ...]:
    rows = tables_beside(__file__)
    groups = {"thrusts": THRUSTS, "positions": POSITIONS, "attitudes": ATTITUDES, "motors": MOTORS}
    questions = []
    for name, row in rows.items():
        needs = []
        for need in row["needs"]:
            channels = [groups.get(word, (word,)) for word in need.split()]
            needs.append(tuple(chain.from_iterable(channels)))
        questions.append(Question(name, tuple(needs), row["excited"], row["least"]))
    return tuple(questions)


QUESTIONS = _questions()


def look(log: FlightLog) -> Iterator[Row]:
    """Yield rows on the excitation and on each question that the log may answer."""
    figures = excitation(log)
    yield Row("excited", "", "ok", _words(figures), figures)
    if figures.get("still"):
        why = "the autopilot was never armed and in the air"
        why = why if "grounded" in figures else "the vehicle never left its place"
        text = f"{why}: nothing about its flight can be answered"
        yield Row("excited", "", "bad", text, {"still": 1})
    elif figures.get("idle"):
        text = "no sign of flight: the throttle stays at zero, or the motors hardly above idle"
        yield Row("excited", "", "bad", text, {"idle": 1})
    for question in QUESTIONS:
        # skip questions on quantities that the log does not hold at all
        if any(name in log for name in question.needs[0]):
            yield _answer(question, log, figures)


def _words(figures: dict) -> str:
    units = {
        "seconds": "s",
        "seconds_flown": "s flown",
        "seconds_hover": "s of hover",
        "speed_p95_m_s": "m/s (95 %)",
        "yaw_range_deg": "deg of yaw",
        "swing_deg": "deg of swing",
        "releases": "releases",
        "height_range_m": "m of height",
        "thrust_range": "of thrust (95 to 5 %, relative)",
        "voltage_range": "V of battery",
    }
    return ", ".join(f"{figures[key]:.3g} {word}" for key, word in units.items() if key in figures)


def _answer(question: Question, log: FlightLog, figures: dict) -> Row:
    missing = [
        " or ".join(group) for group in question.needs if not any(name in log for name in group)
    ]
    reached = figures.get(question.excited, 0.0)
    if missing:
        reason = f"no {', no '.join(missing)}"
    elif figures.get("still") or figures.get("idle"):
        reason = "the vehicle did not fly"
    elif question.excited not in figures or reached < question.least:
        measured = f"{reached:.3g}" if question.excited in figures else "nothing"
        reason = f"{question.excited} is {measured}, at least {question.least:g} is needed"
    else:
        return Row("answers", question.name, "ok", "can be answered")
    return Row("answers", question.name, "warn", f"cannot be answered: {reason}")


def _find_first(
    log: FlightLog, names: tuple[str, ...], fewest: int = 21
) -> tuple[str, Samples] | tuple[None, None]:
    """Return name and samples of the first of several channels that has at least ``fewest``
    samples; (None, None) if none has.
    """
    for name in names:
        samples = log.samples(name, fewest)
        if samples is not None:
            return name, samples
    return None, None


def excitation(log: FlightLog) -> dict[str, float]:
    """Return figures of a log's excitation, units in their names; figures without a channel are
    absent.
    """
    spans = [np.ptp(channel.time) for channel in log.channels.values() if len(channel.time) > 1]
    figures = {"seconds": max(spans, default=0.0)}
    flown = _find_flight(log, figures)
    _motion(log, figures, flown)
    _thrust(log, figures, flown)
    _payload(log, figures)
    _note_standstill(log, figures)
    return figures


def _find_flight(log: FlightLog, figures: dict) -> tuple[float, float]:
    """Return the first and last time in the air [s], by height and by the channel ``flying``.

    Returns (-inf, inf) where neither shows it, and (inf, -inf) where ``flying`` is never set."""
    _, path = _find_first(log, POSITIONS)
    if path is None:
        return -np.inf, np.inf
    time = path.time
    height = path.values[:, 2]
    above = height - np.percentile(height, 1)
    up = above > 0.15 * np.max(above) if np.max(above) > 0.3 else np.ones(len(above), bool)
    if "flying" in log and len(log["flying"].time):
        up &= log["flying"].hold(time)
        if not np.any(log["flying"].values):
            figures["grounded"] = figures["still"] = 1.0
            figures["seconds_flown"] = 0.0
            return np.inf, -np.inf
    figures["seconds_flown"] = np.mean(up) * np.ptp(time)
    figures["height_range_m"] = np.ptp(height)
    figures["seconds_low"] = np.mean(up & (height < 0.3)) * np.ptp(time)
    return (time[up][0], time[up][-1]) if np.any(up) else (-np.inf, np.inf)


def _motion(log: FlightLog, figures: dict, flown: tuple[float, float]) -> None:
    _, path = _find_first(log, POSITIONS, 51)
    if path is not None:
        time, vel = path.derivative(0.1)
        flies = (time >= flown[0]) & (time <= flown[1])
        speed = np.linalg.norm(vel[flies], axis=1)
        if len(speed):
            figures["speed_p95_m_s"] = np.percentile(speed, 95)
            figures["seconds_hover"] = np.mean(speed < 0.15) * np.ptp(time[flies])
    _, attitude = _find_first(log, ATTITUDES)
    if attitude is not None:
        x, y, z, w = attitude.values.T
        yaw = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
        figures["yaw_range_deg"] = np.degrees(_range(yaw, 2))
    rate = log.samples("rate_b", 21)
    if rate is not None:
        figures["rate_p95_rad_s"] = np.percentile(np.linalg.norm(rate.values, axis=1), 95)


def _range(values: np.ndarray, part: float) -> np.ndarray:
    """Return the range of each column without ``part`` per cent at either end."""
    low, high = np.percentile(values, [part, 100 - part], axis=0)
    return high - low


def _thrust(log: FlightLog, figures: dict, flown: tuple[float, float]) -> None:
    name, driver = _find_first(log, THRUSTS)
    if driver is not None:
        values = driver.values[(driver.time >= flown[0]) & (driver.time <= flown[1])]
        thrust = values[:, 0] if name in ("command", "thrust_command") else np.mean(values, axis=1)
        thrust = thrust**2 if name == "motor_speed" else thrust
        if len(thrust):
            figures["thrust_range"] = _range(thrust, 5) / max(np.median(thrust), 1e-9)
    voltage = log.samples("battery_voltage", 1)
    if voltage is not None:
        figures["voltage_range"] = _range(voltage.values[:, 0], 5)


def _payload(log: FlightLog, figures: dict) -> None:
    payload = log.samples("payload_pos_w")
    if payload is None:
        return
    vel = payload.derivative(0.1).values
    if len(vel):
        figures["payload_speed_p95_m_s"] = np.percentile(np.linalg.norm(vel, axis=1), 95)
    vehicle = log.samples("pos_w", 51)
    if vehicle is not None:
        rope = vehicle.at(payload.time) - payload.values
        figures["swing_deg"] = np.percentile(tilt_deg(rope), 95)
    if "release_command" in log:
        pressed = log["release_command"].values.astype(float).ravel() > 0.0
        figures["releases"] = float(np.sum(np.diff(pressed.astype(int)) > 0))


def _note_standstill(log: FlightLog, figures: dict) -> None:
    _, place = _find_first(log, POSITIONS)
    name, thrust = _find_first(log, ("motor_command", "pwm", "throttle", "motor_speed"), 1)
    idle = "throttle" in log and np.ptp(log["throttle"].values) == 0.0
    if thrust is not None:
        lowest = IDLE_SPEED if name == "motor_speed" else IDLE_SHARE
        idle |= np.percentile(thrust.values, 95) < lowest
    if place is None:
        if idle:
            figures["idle"] = 1.0
    elif np.max(_range(place.values, 2)) < STILL_SPEED and (idle or thrust is None):
        figures["still"] = 1.0

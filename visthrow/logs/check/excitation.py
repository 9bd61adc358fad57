"""What a log excites, and what it can therefore answer."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np

from visthrow.common.toml_text import tables_beside
from visthrow.logs.check import relations
from visthrow.logs.check.rows import Row
from visthrow.logs.check.thrust_checks import IDLE_SHARE, IDLE_SPEED
from visthrow.logs.flightlog import FlightLog

POSITIONS = ("pos_w", "est_pos_w", "mocap_pos_w")
ATTITUDES = ("quat_wb", "est_quat_wb", "mocap_quat_wb")
MOTORS = ("motor_command", "motor_speed", "pwm")
THRUSTS = ("command", "thrust_command", "motor_command", "motor_speed", "pwm")

# a vehicle whose position keeps within this [m] for the whole log has not flown, if its motors
# stood or nothing tells
STILL_SPEED = 0.01


@dataclass(frozen=True)
class Question:
    """Something that logs can answer, and what it takes."""

    name: str
    needs: tuple[tuple[str, ...], ...]  # each: any one of these channels
    excited: str  # figure of the excitation that must reach a size
    least: float


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
    """Yield what is excited, and which questions the log can answer."""
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
        # not things of which the log holds nothing at all
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
    if missing:
        return Row(
            "answers", question.name, "warn", f"cannot be answered: no {', no '.join(missing)}"
        )
    if figures.get("still") or figures.get("idle"):
        return Row("answers", question.name, "warn", "cannot be answered: the vehicle did not fly")
    reached = figures.get(question.excited)
    if reached is None or reached < question.least:
        measured = "nothing" if reached is None else f"{reached:.3g}"
        text = (
            f"cannot be answered: {question.excited} is {measured}, at least {question.least:g} is"
            " needed"
        )
        return Row("answers", question.name, "warn", text)
    return Row("answers", question.name, "ok", "can be answered")


def _first(
    log: FlightLog, names: tuple[str, ...], fewest: int = 20
) -> tuple[str, np.ndarray, np.ndarray] | None:
    """Name and samples of the first of several channels that holds more than so many."""
    name = next((n for n in names if n in log and np.sum(log[n].valid) > fewest), None)
    return None if name is None else (name, *log[name].samples())


def excitation(log: FlightLog) -> dict[str, float]:
    """Figures of what a log excites; what no channel tells is left out."""
    spans = [
        float(np.ptp(channel.time)) for channel in log.channels.values() if len(channel.time) > 1
    ]
    figures = {"seconds": max(spans, default=0.0)}
    flown = _flown(log, figures)
    _motion(log, figures, flown)
    _thrust(log, figures, flown)
    _payload(log, figures)
    _standing(log, figures)
    return figures


def _flown(log: FlightLog, figures: dict) -> tuple[float, float]:
    """First and last time in the air, by height or by thrust."""
    signal = _first(log, POSITIONS)
    if signal is None:
        return -np.inf, np.inf
    _, time, pos = signal
    above = pos[:, 2] - np.percentile(pos[:, 2], 1)
    up = above > 0.15 * np.max(above) if np.max(above) > 0.3 else np.ones(len(above), bool)
    if "flying" in log and len(log["flying"].time):
        up &= log["flying"].hold(time)
        if not np.any(log["flying"].values):
            figures["grounded"] = figures["still"] = 1.0
            figures["seconds_flown"] = 0.0
            return np.inf, -np.inf
    figures["seconds_flown"] = float(np.mean(up) * np.ptp(time))
    figures["height_range_m"] = float(np.ptp(pos[:, 2]))
    figures["seconds_low"] = float(np.mean(up & (pos[:, 2] < 0.3)) * np.ptp(time))
    return (float(time[up][0]), float(time[up][-1])) if np.any(up) else (-np.inf, np.inf)


def _motion(log: FlightLog, figures: dict, flown: tuple[float, float]) -> None:
    if signal := _first(log, POSITIONS, 50):
        time, vel = relations.derivative(*signal[1:], 0.1)
        flies = (time >= flown[0]) & (time <= flown[1])
        speed = np.linalg.norm(vel[flies], axis=1)
        if len(speed):
            figures["speed_p95_m_s"] = float(np.percentile(speed, 95))
            figures["seconds_hover"] = float(np.mean(speed < 0.15) * np.ptp(time[flies]))
    if signal := _first(log, ATTITUDES):
        x, y, z, w = signal[2].T
        yaw = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
        figures["yaw_range_deg"] = float(np.degrees(np.percentile(yaw, 98) - np.percentile(yaw, 2)))
    if signal := _first(log, ("rate_b",)):
        figures["rate_p95_rad_s"] = float(np.percentile(np.linalg.norm(signal[2], axis=1), 95))


def _thrust(log: FlightLog, figures: dict, flown: tuple[float, float]) -> None:
    if signal := _first(log, THRUSTS):
        name, time, values = signal
        values = values[(time >= flown[0]) & (time <= flown[1])]
        thrust = values[:, 0] if name in ("command", "thrust_command") else np.mean(values, axis=1)
        thrust = thrust**2 if name == "motor_speed" else thrust
        if len(thrust):
            low, middle, high = np.percentile(thrust, [5, 50, 95])
            figures["thrust_range"] = float((high - low) / max(middle, 1e-9))
    if signal := _first(log, ("battery_voltage",), 0):
        figures["voltage_range"] = float(np.percentile(signal[2], 95) - np.percentile(signal[2], 5))


def _payload(log: FlightLog, figures: dict) -> None:
    signal = _first(log, ("payload_pos_w",), 49)
    if signal is None:
        return
    _, time, pos = signal
    _, vel = relations.derivative(time, pos, 0.1)
    if len(vel):
        figures["payload_speed_p95_m_s"] = float(np.percentile(np.linalg.norm(vel, axis=1), 95))
    if vehicle := _first(log, ("pos_w",), 50):
        gap = pos - relations.on_grid(*vehicle[1:], time)
        angle = np.degrees(np.arctan2(np.linalg.norm(gap[:, :2], axis=1), -gap[:, 2]))
        figures["swing_deg"] = float(np.percentile(angle, 95))
    if "release_command" in log:
        pressed = log["release_command"].values.astype(float).ravel() > 0.0
        figures["releases"] = float(np.sum(np.diff(pressed.astype(int)) > 0))


def _standing(log: FlightLog, figures: dict) -> None:
    place = _first(log, POSITIONS)
    thrust = _first(log, ("motor_command", "pwm", "throttle", "motor_speed"), 0)
    idle = "throttle" in log and np.ptp(log["throttle"].values) == 0.0
    if thrust is not None:
        name, _, values = thrust
        idle |= float(np.percentile(values, 95)) < (
            IDLE_SPEED if name == "motor_speed" else IDLE_SHARE
        )
    if place is not None:
        width = np.max(np.percentile(place[2], 98, axis=0) - np.percentile(place[2], 2, axis=0))
        if width < STILL_SPEED and (idle or thrust is None):
            figures["still"] = 1.0
    elif idle:
        figures["idle"] = 1.0

"""Logs that are wrong: a verdict without a name, or an error that says what; kinds of
:mod:`bench.diagnose.cases`.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from bench.diagnose.altered import change_channels, later, scramble_poses
from bench.diagnose.cases import command_for, environment, logs_of
from bench.diagnose.sealed import WITHOUT_TESTS
from bench.worlds.world import Recipe
from visthrow.diagnose.reporting.explain_cli import REFUSED
from visthrow.logs.flightlog import Channel, FlightLog

Logs = list[FlightLog]
HOURS = 2.0
GRAVITY = 9.81  # [m/s^2]
MASS = 0.21  # of configs/vehicle/paper.toml [kg]
DRAG = 0.06  # of the rotors, from the same file [kg/s]
WANDER = 0.15
"""Of a hover, to either side [m]."""
VOLTAGE = 15.2  # at which that vehicle's thrust is as commanded [V]
FULL_THRUST = 14.0
"""What the configured controller calls full: four times ``max_thrust`` of configs/vehicle [N]."""


def change_all(change: Callable[[FlightLog], FlightLog]) -> Callable[[Logs], Logs]:
    """The same change to all logs."""
    return lambda logs: [change(log) for log in logs]


def values(**changes) -> Callable[[Logs], Logs]:
    """Channels' values changed in all logs."""
    return change_all(lambda log: change_channels(log, changes))


def cut(log: FlightLog, count: int) -> FlightLog:
    """The first samples of every channel."""
    return FlightLog(
        {
            n: replace(c, time=c.time[:count], values=c.values[:count], valid=c.valid[:count])
            for n, c in log.channels.items()
        },
        {},
    )


def exchange_bodies(log: FlightLog) -> FlightLog:
    """Vehicle and payload taken for each other."""
    channels = dict(log.channels)
    channels["pos_w"], channels["payload_pos_w"] = channels["payload_pos_w"], channels["pos_w"]
    return FlightLog(channels, {})


def delay_commands(log: FlightLog) -> FlightLog:
    """Commands stamped half a second late."""
    moved = later(FlightLog({n: log[n] for n in ("command", "release_command")}, {}), 0.5)
    return FlightLog(dict(log.channels) | moved.channels, {})


def freeze_tracking(log: FlightLog) -> FlightLog:
    """A tracking system that stops in the middle of the flight."""

    def hold(x: np.ndarray) -> np.ndarray:
        half = len(x) // 2
        return np.concatenate((x[:half], np.repeat(x[half : half + 1], len(x) - half, axis=0)))

    return change_channels(log, {"pos_w": hold, "quat_wb": hold, "payload_pos_w": hold})


def stand_still(seconds: float, thrust: float, height: float, rate: float = 100.0) -> FlightLog:
    """A vehicle at rest for a given time: noise about one position, one command."""
    rng = np.random.default_rng(1)
    t = np.arange(0.0, seconds, 1.0 / rate)
    sent = np.arange(0.0, seconds, 0.02)
    turn = 5e-4 * rng.standard_normal((len(t), 3))
    command = np.column_stack((np.full(len(sent), thrust), np.zeros((len(sent), 3))))
    place = np.array([0.0, 0.0, height])
    return FlightLog(
        {
            "pos_w": Channel(t, place + 5e-4 * rng.standard_normal((len(t), 3)), "m", "world"),
            "quat_wb": Channel(t, np.column_stack((turn, np.ones(len(t)))), "1", "world"),
            "command": Channel(sent, command, "N, rad/s", "body"),
        },
        {},
    )


def wander(seconds: float, rate: float = 100.0) -> FlightLog:
    """A slowly wandering hover of given length: paths, attitudes and commands of a vehicle without
    blade flapping, rate lag or battery drain.
    """
    rng = np.random.default_rng(1)
    t = np.arange(0.0, seconds, 1.0 / rate)
    sent = np.arange(0.0, seconds, 0.02)
    speed = np.array([0.31, 0.47])
    phase = np.array([0.3, 1.1])  # of the wander along x and y [rad/s], [rad]

    def lean(time: np.ndarray, rate: bool = False) -> np.ndarray:
        """Lean along x and y that the wander and the rotors' drag take, or its rate."""
        angle = speed * time[:, None] + phase + (0.5 * np.pi if rate else 0.0)
        push = (
            WANDER
            * speed
            * (DRAG * np.cos(angle) - MASS * speed * np.sin(angle))
            / (MASS * GRAVITY)
        )
        return speed * push if rate else push

    x, y = lean(t).T
    turn = 0.5 * np.column_stack((-y, x, np.zeros(len(t)))) + 2.5e-4 * rng.standard_normal(
        (len(t), 3)
    )
    path = np.column_stack((WANDER * np.sin(speed * t[:, None] + phase), np.full(len(t), 1.5)))
    rate_x, rate_y = lean(sent, rate=True).T
    thrust = MASS * GRAVITY * (1.0 + 0.5 * np.sum(lean(sent) ** 2, axis=1))
    return FlightLog(
        {
            "pos_w": Channel(t, path + 5e-4 * rng.standard_normal((len(t), 3)), "m", "world"),
            "quat_wb": Channel(t, np.column_stack((turn, np.ones(len(t)))), "1", "world"),
            "command": Channel(
                sent,
                np.column_stack((thrust, -rate_y, rate_x, np.zeros(len(sent)))),
                "N, rad/s",
                "body",
            ),
            "battery_voltage": Channel(t[::100], np.full(len(t[::100]), VOLTAGE), "V"),
        },
        {},
    )


def drop_channel(name: str) -> Callable[[Logs], Logs]:
    """A channel that was not recorded."""
    return change_all(
        lambda log: FlightLog({n: c for n, c in log.channels.items() if n != name}, {})
    )


@dataclass(frozen=True)
class Bad:
    """One way in which logs can be wrong."""

    spoil: Callable[[Logs], Logs]
    cut_to: float = 1.0  # share of each file's bytes that is left
    flown: bool = True  # whether it needs a world's flights
    right: Mapping[str, float] = field(default_factory=dict)  # signs of effects that the logs have

    def run(self, recipe: Recipe, folder: Path) -> dict:
        """Fly a world without effect, damage its logs, diagnose them."""
        logs = self.spoil(logs_of(recipe) if self.flown else [])
        place = Path(tempfile.mkdtemp(dir=folder))
        for i, log in enumerate(logs):
            path = place / f"flight_{i:02d}.npz"
            log.save(path)
            path.write_bytes(path.read_bytes()[: int(self.cut_to * path.stat().st_size)])
        done = subprocess.run(
            [sys.executable, "-c", WITHOUT_TESTS, *command_for(len(logs), recipe)],
            cwd=place,
            capture_output=True,
            text=True,
            timeout=1500.0,
            env=environment(),
            check=False,
        )
        answer = place / "said.json"
        verdict = (
            json.loads(answer.read_text())
            if answer.exists()
            else {"overall": "ERROR", "findings": []}
        )
        return {
            "passed": fair(done, verdict, self.right),
            "said": verdict,
            "output": (done.stdout + done.stderr)[-600:],
        }


def fair(done: subprocess.CompletedProcess, verdict: dict, right: Mapping[str, float]) -> bool:
    """Whether there is no traceback and no wrong name or sign, and either a verdict or an error of
    one sentence.
    """
    theta = verdict.get("theta") or {}
    wrong = [name for name, size in theta.items() if right.get(name, 0.0) * size <= 0.0]
    if "Traceback" in done.stderr or wrong:
        return False
    return (
        done.returncode == 2 and bool(done.stderr.strip())
        if verdict["overall"] == "ERROR"
        else done.returncode in (0, REFUSED)
    )


def double_flights(logs: Logs) -> Logs:
    """Every flight twice."""
    return [*logs, *[later(log, 1000.0) for log in logs]]


def keep_all(logs: Logs) -> Logs:
    """Unchanged."""
    return logs


def command_values(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Logs], Logs]:
    """Commands changed in all logs."""
    return values(command=change)


def idle_on_floor(_: Sequence[FlightLog]) -> Logs:
    """On the floor for half a minute, motors idle."""
    return [stand_still(30.0, 0.3, 0.05)] * 2


def hours(_: Sequence[FlightLog]) -> Logs:
    """One hover of two hours."""
    return [wander(3600.0 * HOURS)]


def hours_still(_: Sequence[FlightLog]) -> Logs:
    """One vehicle that stays in its place to the millimetre for two hours."""
    return [stand_still(3600.0 * HOURS, 2.07, 1.5)]


BAD = {
    "millimetres": Bad(values(pos_w=lambda p: 1e3 * p, payload_pos_w=lambda p: 1e3 * p)),
    "degrees": Bad(command_values(lambda u: u * [1.0, 57.3, 57.3, 57.3])),
    "grams": Bad(command_values(lambda u: u * [101.97, 1.0, 1.0, 1.0])),
    "share_of_thrust": Bad(command_values(lambda u: u * [1.0 / FULL_THRUST, 1.0, 1.0, 1.0])),
    "roll_for_pitch": Bad(command_values(lambda u: u[:, [0, 2, 1, 3]])),
    "pitch_reversed": Bad(command_values(lambda u: u * [1.0, 1.0, -1.0, 1.0])),
    "east_for_north": Bad(
        values(pos_w=lambda p: p[:, [1, 0, 2]], payload_pos_w=lambda p: p[:, [1, 0, 2]])
    ),
    "scalar_first": Bad(values(quat_wb=lambda q: q[:, [3, 0, 1, 2]])),
    "world_to_body": Bad(values(quat_wb=lambda q: q * [-1.0, -1.0, -1.0, 1.0])),
    "bodies_exchanged": Bad(change_all(exchange_bodies)),
    "late_commands": Bad(change_all(delay_commands)),
    "frozen": Bad(change_all(freeze_tracking)),
    "copied": Bad(double_flights),
    "mixed_up": Bad(scramble_poses),
    "three_samples": Bad(change_all(lambda log: cut(log, 3))),
    "no_commands": Bad(drop_channel("command")),
    "no_attitude": Bad(drop_channel("quat_wb")),
    "truncated": Bad(keep_all, cut_to=0.6),
    "empty_files": Bad(keep_all, cut_to=0.0),
    "standing": Bad(idle_on_floor, flown=False),
    # its blades do not flap, and its rates follow the commands at once
    "two_hours": Bad(hours, flown=False, right={"flapping": -1.0, "rate_gain": 1.0}),
    "two_hours_still": Bad(hours_still, flown=False),
}

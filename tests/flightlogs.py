"""Flight logs of columns over one time, in the units of their names, and a smooth flight."""

import numpy as np
from numpy.linalg import norm
from numpy.random import default_rng
from scipy.spatial.transform import Rotation

from visthrow.logs.flightlog import STANDARD_CHANNELS, Channel, FlightLog

UNITS = {name: (spec.unit, spec.frame) for name, spec in STANDARD_CHANNELS.items()} | {
    "acc_b": ("m/s^2", "body"),
    "angle": ("rad", "none"),
    "current": ("A", "none"),
    "est_pos_w": ("m", "world"),
    "gimbal": ("rad", "body"),
    "marker_pos_c": ("m", "camera"),
    "motor_command": ("1", "none"),
    "rate_setpoint_b": ("rad/s", "body"),
    "rotor_speed": ("rad/s", "none"),
    "supply_voltage": ("V", "none"),
    "throttle": ("1", "none"),
    "thrust": ("N", "none"),
    "thrust_command": ("N", "none"),
}
"""Unit and frame of each channel."""

G = 9.81
DELAY = 0.04
"""Lag of a smooth flight's rates behind its commands [s]."""


def log_at(time: np.ndarray, **columns: np.ndarray) -> FlightLog:
    """Return a log of columns that share their time stamps [s]."""
    return FlightLog({n: Channel(time, values, *UNITS[n]) for n, values in columns.items()})


def level_log(time: np.ndarray, pos_w: np.ndarray, **columns: np.ndarray) -> FlightLog:
    """Return a log of a vehicle that stays level, and of further columns."""
    level = np.tile([0.0, 0.0, 0.0, 1.0], (len(time), 1))
    return log_at(time, pos_w=pos_w, quat_wb=level, **columns)


def log_of(columns: dict[str, np.ndarray], **channels: Channel) -> FlightLog:
    """Return a log of columns over their column of time [s], and of further channels."""
    others = {name: values for name, values in columns.items() if name != "time"}
    return with_channels(log_at(columns["time"], **others), **channels)


def with_channels(log: FlightLog, **channels: Channel) -> FlightLog:
    """Return a log with some channels added or in place of its own."""
    return FlightLog(log.channels | channels, log.meta)


def asks(proposal, words: str) -> bool:
    """Tell whether a question of a proposed mapping has these words."""
    return any(words in question for question in proposal.questions)


def upright(thrust: np.ndarray, heading=(1.0, 0.0, 0.0)) -> Rotation:
    """Attitudes with the third axis along a thrust and the first one nearest to ``heading``."""
    up = thrust / norm(thrust, axis=1, keepdims=True)
    side = np.cross(up, heading)
    side /= norm(side, axis=1, keepdims=True)
    return Rotation.from_matrix(np.stack([np.cross(side, up), side, up], axis=2))


def flight(
    seconds: float = 12.0, rate: float = 100.0, seed: int = 0, scale: float = 1.0
) -> dict[str, np.ndarray]:
    """Columns of a flight along a smooth path, attitude along the thrust that it takes; noise of a
    good motion capture.
    """
    rng = default_rng(seed)
    time = np.arange(0.0, seconds, 1.0 / rate)
    tones = [
        (axis, a, w, rng.uniform(0, 6))
        for axis in range(3)
        for a, w in ((0.6, 1.3 + 0.4 * axis), (0.08, 5.1 + axis))
    ]
    pos, vel, acc = (np.zeros((len(time), 3)) for _ in range(3))
    for axis, a, w, phase in tones:
        a, w = a * scale, w * rng.uniform(0.75, 1.25)
        pos[:, axis] += a * np.sin(w * time + phase)
        vel[:, axis] += a * w * np.cos(w * time + phase)
        acc[:, axis] -= a * w * w * np.sin(w * time + phase)
    force = acc + [0, 0, G]
    yaw = np.sin(rng.uniform(0.5, 0.9) * time + rng.uniform(0, 6))
    heading = np.column_stack([np.cos(yaw), np.sin(yaw), 0 * yaw])
    turn = upright(force, heading)
    rates = np.zeros((len(time), 3))
    rates[1:-1] = (turn[:-2].inv() * turn[2:]).as_rotvec() * rate / 2.0
    rates[0], rates[-1] = rates[1], rates[-2]
    ahead = np.column_stack([np.interp(time + DELAY, time, column) for column in rates.T])
    thrust = 0.2 * norm(force, axis=1)
    quat = (turn * Rotation.from_rotvec(rng.normal(0, 1e-3, (len(time), 3)))).as_quat()
    return {
        "time": time,
        "pos_w": pos + [0, 0, 3.0] + rng.normal(0, 3e-4, pos.shape),
        "vel_w": vel + rng.normal(0, 5e-3, vel.shape),
        "quat_wb": quat,
        "rate_b": rates + rng.normal(0, 0.02, rates.shape),
        "acc_b": turn.inv().apply(force) + rng.normal(0, 0.1, force.shape),
        "command": np.column_stack([thrust, ahead]) + rng.normal(0, 1e-3, (len(time), 4)),
    }

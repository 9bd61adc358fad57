"""Transformed logs of the same flights: turned, mirrored, shifted in time, reordered, mixed up."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from visthrow.diagnose.models.model_interface import Model
from visthrow.logs.flightlog import FlightLog

MIRRORED = {"motor_1": "motor_2", "motor_2": "motor_1", "motor_3": "motor_4", "motor_4": "motor_3"}
"""Effects that a left-right mirror exchanges."""
NEGATED = {
    "com_y",
    "mount_y",
    "wind_y",
    "frame_tilt_x",
    "frame_tilt_z",
    "marker_rot_x",
    "marker_rot_z",
    "marker_off_y",
    "payload_marker_y",
    "kick_y",
}
"""Effects whose sign a left-right mirror changes: sideways vectors, and turns about axes in the
mirror's plane.
"""

Values = Callable[[np.ndarray], np.ndarray]


def change_channels(
    log: FlightLog, changes: dict[str, Values], time: Values = lambda t: t
) -> FlightLog:
    """A log with some channels' values changed, and the clock of all."""
    channels = {}
    for name, c in log.channels.items():
        values = changes[name](np.asarray(c.values, dtype=float)) if name in changes else c.values
        channels[name] = replace(c, time=time(c.time), values=values)
    return FlightLog(channels, dict(log.meta))


def turn_hall(log: FlightLog, angle: float, shift: Sequence[float]) -> FlightLog:
    """The same flight in a hall whose axes are turned about the vertical [rad] and moved [m]."""
    c = np.cos(angle)
    s = np.sin(angle)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    a = np.sin(0.5 * angle)
    b = np.cos(0.5 * angle)

    def quat(q: np.ndarray) -> np.ndarray:
        x, y, z, w = q.T
        return np.column_stack((b * x - a * y, b * y + a * x, b * z + a * w, b * w - a * z))

    place = lambda p: p @ turn.T + np.asarray(shift)  # noqa: E731
    return change_channels(log, {"pos_w": place, "payload_pos_w": place, "quat_wb": quat})


def mirror_flight(log: FlightLog) -> FlightLog:
    """The same flight mirrored left to right: y of positions changes sign, and so do rotations
    about x and z.
    """
    place = lambda p: p * [1.0, -1.0, 1.0]  # noqa: E731
    changes = {
        "pos_w": place,
        "payload_pos_w": place,
        "quat_wb": lambda q: q * [-1.0, 1.0, -1.0, 1.0],
    }
    return change_channels(log, changes | {"command": lambda u: u * [1.0, -1.0, 1.0, -1.0]})


def mirror_theta(theta: dict[str, float]) -> dict[str, float]:
    """The expected diagnosis of mirrored flights."""
    return {
        MIRRORED.get(name, name): -size if name in NEGATED else size for name, size in theta.items()
    }


def later(log: FlightLog, seconds: float) -> FlightLog:
    """All clocks of a log set forward."""
    return change_channels(log, {}, lambda t: t + seconds)


def scramble_poses(logs: Sequence[FlightLog]) -> list[FlightLog]:
    """Commands of one flight with the poses of the next of about the same length."""
    groups: dict[int, list[int]] = {}
    for i, log in enumerate(logs):
        groups.setdefault(len(log["command"].time), []).append(i)
    out = list(logs)
    for group in groups.values():
        for i, j in zip(group, group[1:] + group[:1]):
            channels = dict(logs[i].channels) | {
                name: logs[j][name] for name in ("command", "release_command")
            }
            out[i] = FlightLog(channels, dict(logs[i].meta))
    return out


class Flipped(Model):
    """A model whose residuals change sign in every other flight: the noise stays, a common cause
    does not.
    """

    def __init__(self, model, seed: int) -> None:
        """Draw the flights' signs, as many of each as there can be."""
        self.model = model
        self.effects = model.effects
        self.channels = model.channels
        windows = model.windows({})
        flights = sorted({w.flight for w in windows})
        signs = np.resize([1.0, -1.0], len(flights))
        self._sign = dict(zip(flights, np.random.default_rng(seed).permutation(signs)))
        self._base = [w.residual for w in windows]

    def _shift(self, window, base: np.ndarray) -> np.ndarray:
        return (self._sign[window.flight] - 1.0) * base

    def windows(self, theta):
        """See :class:`visthrow.diagnose.models.model_interface.Model`."""
        self._last = self.model.windows(theta)
        return [
            replace(w, residual=w.residual + self._shift(w, b))
            for w, b in zip(self._last, self._base)
        ]

    def residuals(self, theta, about):
        """See :class:`visthrow.diagnose.models.model_interface.Model`."""
        return [
            r + self._shift(w, b)
            for w, r, b in zip(self._last, self.model.residuals(theta, about), self._base)
        ]

"""A plant of a few lines that falls, climbs and turns as commanded, a little late; the payload
hangs straight below it.

For what concerns weight, thrust and signs: no simulator is needed for it.
"""

import numpy as np

from tests.level import LevelPlant
from visthrow.common.rotations import multiply, rotate_one
from visthrow.onboard.hover import GRAVITY

LAG = 0.06
"""Time from a command to 63 % of its effect [s]."""

HANG = 0.383
"""Distance of the payload below the vehicle [m]."""


class PointPlant(LevelPlant):
    """See `hil.rehearsal.fake.WirePlant`; every mass is ``times`` the training's, and yaw follows
    with a time constant of its own [s].
    """

    def __init__(self, times: float = 1.0, yaw_lag: float = LAG) -> None:
        super().__init__()
        self._lags = np.array([LAG, LAG, LAG, yaw_lag])
        self.mass = tuple(times * mass for mass in LevelPlant.mass)
        self._pos, self._vel, self._quat = self.home_w.copy(), np.zeros(3), (0.0, 0.0, 0.0, 1.0)
        self._acts = np.array([self.mass[0] * GRAVITY, 0.0, 0.0, 0.0])

    def step(self, command: np.ndarray, release: bool, after: float = 0.0) -> None:
        """See `WirePlant`."""
        super().step(command, release, after)
        dt = self.period
        self._acts = self._acts + dt / self._lags * (np.array(command) - self._acts)
        up = np.array(rotate_one(self._quat, (0.0, 0.0, 1.0)))
        hangs = bool(super().state["attached"])
        force = self._acts[0] / self.mass[0 if hangs else 1] * up
        self._vel = self._vel + dt * (force - [0.0, 0.0, GRAVITY])
        self._pos = self._pos + dt * self._vel
        turned = np.array(multiply(self._quat, (*(0.5 * dt * self._acts[1:]), 1.0)))
        self._quat = tuple(turned / np.linalg.norm(turned))

    @property
    def state(self) -> dict[str, np.ndarray]:
        """See `WirePlant`."""
        still = super().state
        ball = self._pos - [0.0, 0.0, HANG] if still["attached"] else still["payload_pos_w"]
        return {
            **still,
            "pos_w": self._pos,
            "quat_wb": np.array(self._quat),
            "vel_w": self._vel,
            "rate_b": self._acts[1:],
            "payload_pos_w": ball,
        }

"""A plant of a few lines: it stays in the air under any command, turns a little as commanded, and
drops the payload at its feet.

For what concerns protocol, faults and time alone: no simulator is needed for it.
"""

from collections import deque
from typing import Any

import numpy as np

from visthrow.onboard.hover import GRAVITY

MOST_LEAN = 0.1
"""Of the vehicle [rad]."""

MOST_KEPT = 10_000
"""Commands that are remembered."""


class LevelPlant:
    """See `hil.rehearsal.fake.WirePlant`.

    Attributes:
        released: when the release came [s]. commands: all that it received, of a long flight the
            last ones.
    """

    period, home_w, mass, max_thrust = 0.01, np.array([0.0, 0.0, 1.333]), (0.272, 0.21), 14.0

    def __init__(self, lag: float = 0.11) -> None:
        """Start at time 0.

        Args:
            lag: from the release to separation [s].
        """
        self.time, self.lag = 0.0, lag
        self.released: float | None = None
        self.commands: deque[tuple[float, ...]] = deque(maxlen=MOST_KEPT)
        self.lean = np.zeros(3)

    def step(self, command: np.ndarray, release: bool, after: float = 0.0) -> None:
        """See `WirePlant`."""
        self.commands.append(tuple(command))
        if release and self.released is None:
            self.released = self.time + after
        turned = self.lean + self.period * np.array(command)[1:]
        self.lean = np.clip(turned, -MOST_LEAN, MOST_LEAN)
        self.time += self.period

    @property
    def state(self) -> dict[str, np.ndarray]:
        """See `WirePlant`."""
        hangs = self.released is None or self.time < self.released + self.lag
        fall = 0.0 if hangs else 0.5 * GRAVITY * (self.time - self.released - self.lag) ** 2
        ball = np.array([0.0, 0.0, max(self.home_w[2] - 0.383 - fall, 0.04)])
        quat = np.array([*(0.5 * self.lean), 1.0])
        return {
            "pos_w": self.home_w,
            "quat_wb": quat / np.linalg.norm(quat),
            "vel_w": np.zeros(3),
            "rate_b": np.zeros(3),
            "payload_pos_w": ball,
            "attached": np.array(hangs),
        }

    @property
    def landing(self) -> dict[str, Any]:
        """See `WirePlant`; what falls at its feet is not reported."""
        apart = None if self.released is None else self.released + self.lag
        return {"landing_w": None, "landing_time": None, "separation_time": apart}


def make(policy: str, seed: int) -> LevelPlant:
    """The plant, for any policy and seed; see `hil.rehearsal.process.load_plant`."""
    return LevelPlant()

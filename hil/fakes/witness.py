"""What must never arrive at a vehicle, watched from the vehicle's side."""

import math
from dataclasses import dataclass, field

import numpy as np

ROOM = 1.01  # over a limit: whole microseconds of a stick, float32 on the wire

MOST_KEPT = 100


@dataclass
class Witness:
    """Notes every breach.

    Attributes:
        limits: largest thrust [N] and body rates [rad/s] that may be asked for.
        fence: corners of the box that the payload may be released in [m], world frame.
        breaches: what happened, with its time; empty after a good run.
        commands, releases: how many came.
        worst: largest sizes that came, of thrust [N] and rates [rad/s].
    """

    limits: tuple[float, float, float, float]
    fence: tuple[tuple[float, float, float], tuple[float, float, float]] = ((-3.0, -3.0, -0.05), (3.0, 3.0, 3.0))
    breaches: list[str] = field(default_factory=list)
    commands: int = 0
    releases: int = 0
    worst: list[float] = field(default_factory=lambda: [0.0] * 4)
    _answered: bool = False

    def command(self, time: float, command: tuple[float, ...]) -> None:
        """Note a set-point: thrust [N], body rates [rad/s]."""
        self.commands += 1
        if not all(map(math.isfinite, command)):
            self._note(time, f"command {command} is not finite")
            return
        self.worst = [max(w, abs(c)) for w, c in zip(self.worst, command)]
        if command[0] < 0.0 or any(abs(c) > ROOM * most for c, most in zip(command, self.limits)):
            self._note(time, f"command {command} beyond {self.limits}")

    def release(self, time: float, armed: bool, payload_w: np.ndarray) -> None:
        """Note a command to open the mechanism."""
        self.releases += 1
        low, high = self.fence
        if self._answered:
            self._note(time, "released again after the answer")
        if not armed:
            self._note(time, "released while disarmed")
        if not all(a <= x <= b for a, x, b in zip(low, payload_w, high)):
            self._note(time, f"released with the payload at {np.round(payload_w, 2).tolist()}, outside of its fence")

    def answered(self) -> None:
        """Note that the release was acknowledged: none may follow."""
        self._answered = True

    def _note(self, time: float, text: str) -> None:
        if len(self.breaches) < MOST_KEPT:
            self.breaches.append(f"{time:.3f} s: {text}")

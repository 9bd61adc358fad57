"""Commands that wait: for a vehicle that acts sooner than the one that the policy was trained with.

A policy has learnt what its commands do after the trained delay. Poses can be carried forward to a slower vehicle's time; for a faster one
each command waits for the difference. A release has its own lag and is told when it is due.
"""

from collections import deque
from typing import Any

from hil.backends.base import ROUNDING, Backend


class Held:
    """A back-end whose commands go out a fixed time later; everything else is its own."""

    def __init__(self, backend: Backend, hold: float) -> None:
        """Hold the commands of a back-end back by a time [s]."""
        self._backend, self._hold, self._taken = backend, hold, True
        self._waiting: deque[tuple[float, tuple[float, ...]]] = deque()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def send(self, command: tuple[float, ...], now: float) -> bool:
        """Let a command wait; whether the last one that went out was taken."""
        self._waiting.append((now + self._hold, command))
        return self._taken

    def service(self, now: float) -> None:
        while self._waiting and self._waiting[0][0] <= now + ROUNDING:
            self._taken = self._backend.send(self._waiting.popleft()[1], now)
        self._backend.service(now)

    def due(self) -> float | None:
        times = [time for time in (self._backend.due(), self._waiting[0][0] if self._waiting else None) if time is not None]
        return min(times, default=None)

    def finish(self, now: float) -> None:
        """End; nothing goes out after it."""
        self._waiting.clear()
        self._backend.finish(now)

"""Clocks, ticks, and the offset of a peer's clock."""

import math
import select
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


class Clock:
    """A clock that never goes backwards."""

    def now(self) -> float:
        """Return the time [s]."""
        raise NotImplementedError

    def wait_for(self, files: Sequence[Any], when: float) -> None:
        """Wait until a file (any object with ``fileno``) can be read, or until a time [s]."""
        raise NotImplementedError

    def sleep_until(self, when: float) -> None:
        """Wait until a time [s]; return at once if it has passed."""
        self.wait_for((), when)


class MonotonicClock(Clock):
    """The machine's monotonic clock times ``speed``: at 0.5, one of its seconds takes two."""

    def __init__(self, speed: float = 1.0):
        """Set the speed; raises `ValueError` for 0 or less."""
        if not speed > 0.0:
            raise ValueError(f"clock speed {speed}; expected above 0")
        self._speed = speed

    def now(self) -> float:
        return time.monotonic() * self._speed

    def wait_for(self, files: Sequence[Any], when: float) -> None:
        remaining = (when - self.now()) / self._speed
        if remaining > 0.0:
            select.select(files, [], [], remaining)


@dataclass
class ManualClock(Clock):
    """A clock that only moves when it is set or waited for: for tests and replay."""

    time: float = 0.0  # [s]

    def now(self) -> float:
        return self.time

    def wait_for(self, files: Sequence[Any], when: float) -> None:
        self.time = max(self.time, when)


@dataclass
class Ticker:
    """Ticks at fixed times, start + n period; a tick that is more than a period late skips those
    that it missed.

    Attributes:
        grid: offset of a clock; ticks are at multiples of the period on that clock [s]. None: no
            such grid.
        index: number of the current tick, including missed ticks. missed: ticks that were skipped.
        late: lateness of the current tick, after skipping missed ones [s]. worst: largest lateness
            of any tick [s].
    """

    clock: Clock
    period: float
    grid: float | None = None
    index: int = -1
    missed: int = 0
    late: float = 0.0
    worst: float = 0.0
    _start: float | None = None

    def due(self) -> float:
        """Return the time of the next tick [s]."""
        if self._start is None:
            self._start = self.clock.now()
            if self.grid is not None:
                ticks = math.ceil((self._start + self.grid) / self.period)
                self._start = ticks * self.period - self.grid
        return self._start + (self.index + 1) * self.period

    def take(self) -> float:
        """Begin the tick that is due; return the current time [s]."""
        due = self.due()
        time = self.clock.now()
        lag = max(0.0, time - due)
        skipped = int(lag / self.period)
        self.late = lag - skipped * self.period
        self.index += 1 + skipped
        self.missed += skipped
        self.worst = max(self.worst, lag)
        return time


class TimeSync:
    """Estimates the offset of a peer's clock by TIMESYNC, from the exchange with the shortest round
    trip; ``steps`` counts steps of either clock.

    The peer answers ``tc1`` (its time) to ``ts1`` (ours). The true offset lies within half the
    round trip of ``tc1 - (sent + received) / 2``, so the shortest exchange is the best one.
    Exchanges that contradict it by more than the round trips and some drift explain are ignored;
    after several in a row a clock was set, and the estimate starts again."""

    DRIFT = 1e-3  # of the clocks within the window: 200 parts in a million over 5 s [s]
    STEP_AFTER = 3  # contradicting exchanges in a row that make a step

    def __init__(self) -> None:
        self._exchanges: deque[tuple[float, float]] = deque(maxlen=50)
        self._odd = 0
        self.steps = 0

    @staticmethod
    def stamp(host_time: float) -> int:
        """Return a time [s] in TIMESYNC's unit [ns]."""
        return int(host_time * 1e9)

    def take(self, tc1: int, ts1: int, host_time: float) -> None:
        """Process the answer to a request, received at a time [s]; ``tc1``: the peer's time,
        ``ts1``: ours in the request [ns].
        """
        sent = ts1 / 1e9
        trip, offset = host_time - sent, tc1 / 1e9 - 0.5 * (sent + host_time)
        if (
            self._exchanges
            and abs(offset - self.offset) > 0.5 * (trip + self.round_trip) + self.DRIFT
        ):
            self._odd += 1
            if self._odd < self.STEP_AFTER:
                return
            self._exchanges.clear()
            self.steps += 1
        self._odd = 0
        self._exchanges.append((trip, offset))

    @property
    def offset(self) -> float | None:
        """Peer's clock minus ours [s]; None before the first answer."""
        return min(self._exchanges)[1] if self._exchanges else None

    @property
    def round_trip(self) -> float | None:
        """Shortest round trip [s]."""
        return min(self._exchanges)[0] if self._exchanges else None

"""Set-points that begin to act at any time, flown by a plant in periods of its own."""

from collections import deque

import numpy as np

from hil.fakes.mocap import SLACK


class SetPoints:
    """Those that came, and from when on they act."""

    def __init__(self) -> None:
        """Start with none."""
        self._acting: np.ndarray | None = None
        self._coming: deque[tuple[float, np.ndarray]] = deque()

    def add(self, when: float, target: np.ndarray) -> None:
        """Take a set-point, thrust [N] and body rates [rad/s], that acts from a time on [s], later than those before."""
        self._coming.append((when, target))

    def forget(self) -> None:
        """Nothing that came so far counts any more."""
        self._acting = None
        self._coming.clear()

    def flown(self, begin: float, period: float) -> np.ndarray | None:
        """What acts in the period from a time on [s]: the mean, where it changes within it; None before the first one."""
        mean, since = np.zeros(4), begin
        while self._coming and self._coming[0][0] < begin + period - SLACK:
            when, target = self._coming.popleft()
            if self._acting is not None:
                mean += (max(when, begin) - since) / period * self._acting
                since = max(when, begin)
            self._acting = target
        return None if self._acting is None else mean + (begin + period - since) / period * self._acting

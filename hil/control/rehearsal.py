"""The tick, rehearsed shortly before it is due: on a copy of all that changes, at a back-end that sends nothing.

Between two ticks the machine does something else for 18 ms, and what a tick needs has left its caches by then: the same calls take
three times as long. A rehearsal fetches it: estimate, observation, network, guard and encoding run as they will in the tick, on the
poses that have come so far. Its outcome is thrown away.
"""

import copy
import dataclasses
import traceback
from collections.abc import Callable, Iterator
from typing import Any

from hil.control.decision import Words
from hil.control.runner import Runner
from hil.links.clock import Clock

BEGIN = 5e-3
"""Before the tick that is due [s]: a cold copy and a cold tick take 3 ms on a slow core."""

SPARE = 2.5e-4
"""Between the end of the last rehearsal and the tick [s]: more than two rehearsals differ by."""

MOST = 20
"""Rehearsals of one tick, more than fit: they go on until it is due, as what was rehearsed 2 ms ago is cold again."""

FORGET = 0.9
"""Share of the longest rehearsal so far that is expected of the next one: one that was held up is forgotten within a second."""


class Rehearsal:
    """Rehearses one runner's ticks.

    Attributes:
        count: rehearsals so far. failed: why there are no more, or None.
    """

    def __init__(self, runner: Runner) -> None:
        """Find out what of a runner never changes, and need not be copied."""
        self.count, self.failed = 0, None
        self._runner = runner
        self._longest = [0.0, 0.0]  # of a copy, of a tick [s]
        self._shared = {
            **{id(part): part for part in _frozen(runner.params)},
            **{id(track.frames): track.frames for track in runner.tracks.values()},
            **runner.backend.stand_ins(),
        }

    def twin(self) -> Runner:
        """A copy of the runner as it is, that can be ticked without the runner's noticing."""
        twin = copy.copy(self._runner)
        twin.watcher = None
        memo: dict[int, Any] = dict(self._shared)
        for name, part in vars(twin).items():
            setattr(twin, name, copy.deepcopy(part, memo))
        return twin

    def steps(self, clock: Clock, due: float) -> Iterator[float]:
        """Rehearse the tick that is due [s] as often as fits before it.

        Yields:
            The time [s], again and again until the tick is due: poses are to be taken in. A core that sleeps for a millisecond
            has cold caches again.
        """
        if self.failed is not None:
            return
        begin = clock.now()
        if begin + self._longest[0] + self._longest[1] + SPARE > due:
            self._longest = [FORGET * longest for longest in self._longest]
            return
        twin = self._kept(self.twin)
        if twin is None:
            return
        self._longest[0] = max(clock.now() - begin, FORGET * self._longest[0])
        left = MOST
        while (begin := clock.now()) < due:
            yield begin
            if left and self.failed is None and begin + self._longest[1] + SPARE <= due:
                self._kept(self.once, twin, due)
                left -= 1
                self._longest[1] = max(clock.now() - begin, FORGET * self._longest[1])
            elif clock.now() <= begin:
                return  # a clock that stands still until it is told to go on

    def _kept(self, act: Callable[..., Any], *given: Any) -> Any:
        """Do something; where it goes wrong there are no more rehearsals, and the runner flies on."""
        try:
            return act(*given)
        except Exception:
            self.failed = traceback.format_exc()
            return None

    def once(self, twin: Runner, due: float) -> None:
        """Tick a copy as the runner will be at a time [s]."""
        twin.pilot = copy.copy(self._runner.pilot)  # as often as it is rehearsed it is the same step
        twin.rehearse(due, twin.backend.status(due), Words())
        self.count += 1


def _frozen(params: Any) -> Iterator[Any]:
    """A configuration and all configurations in it."""
    if dataclasses.is_dataclass(params):
        yield params
        for value in vars(params).values():
            yield from _frozen(value)
    elif isinstance(params, dict):
        yield params
        for value in params.values():
            yield from _frozen(value)

"""Rehearsed ticks: the same commands to the bit, nothing of the runner changed, nothing sent, and never in the tick's way."""

import threading
import types
from collections import deque
from enum import Enum

import numpy as np
import pytest
import torch

from hil.control.loop import AutoOperator, fly
from hil.control.rehearsal import BEGIN, SPARE, Rehearsal
from hil.fakes.level import LevelPlant
from hil.links.clock import ManualClock
from hil.links.device import MutePort
from hil.links.mavlink_link import Link
from tests.hil_flight import simple_policy
from tests.loopback.wire import MemoryPort, peers
from visthrow.onboard.actions import hover_action
from visthrow.onboard.traced import Traced

QUICK = ("states.check_hold=0.2", "states.armed_least=0.1", "states.quiet=0.1", "states.land=1.0", "goal_w=[0.0, 0.0, 0.0]")
ACTION = (hover_action(9.81 * 0.272, 14.0)[0], 0.0, 0.0, 0.0, 1.0)


def print_of(value, seen=None):
    """All that is reachable from a value, as plain tuples; ports and links by their counters."""
    seen = {} if seen is None else seen
    if value is None or isinstance(value, (bool, int, float, str, bytes, Enum, Exception)):
        return repr(value)
    if isinstance(value, torch.Tensor):
        return (tuple(value.shape), value.numpy().tobytes())
    if isinstance(value, np.ndarray):
        return (value.shape, value.tobytes())
    if isinstance(value, types.MethodType):
        return value.__func__.__qualname__
    if isinstance(value, (types.FunctionType, types.BuiltinFunctionType, type, MemoryPort, MutePort)):
        return type(value).__qualname__
    if id(value) in seen:
        return "again"
    seen[id(value)] = value
    if isinstance(value, dict):
        return tuple((print_of(k, seen), print_of(v, seen)) for k, v in value.items())
    if isinstance(value, (list, tuple, deque)):
        return tuple(print_of(v, seen) for v in value)
    if isinstance(value, (set, frozenset)):
        return tuple(sorted(map(repr, value)))
    if isinstance(value, Link):
        return (value.sent, value.dropped, value.received)
    return (type(value).__qualname__, print_of(getattr(value, "__dict__", {}), seen))


class Watched(Rehearsal):
    """Compares the runner before and after each rehearsal."""

    def __init__(self, runner) -> None:
        super().__init__(runner)
        self.states = set()

    def once(self, twin, due) -> None:
        before = self._shown()
        super().once(twin, due)
        assert self._shown() == before, self._runner.machine.state
        assert not twin.errors
        self.states.add(str(self._runner.machine.state.value))

    def _shown(self):
        parts = dict(vars(self._runner))
        pilot = vars(parts.pop("pilot"))
        # What every call of the policy writes over is no state, and the recorded operations keep counts.
        return print_of((parts, {k: v for k, v in pilot.items() if k != "_views" and not isinstance(v, Traced)}))


class Without(Rehearsal):
    def steps(self, clock, due):
        return iter(())


def flown(kind: str, rehearsed: type[Rehearsal]):
    """A throw in lock step: rehearsal, every datagram and frame that was sent with its time, the fake."""
    runner, source, clock, fake = peers(LevelPlant(), kind=kind, loaded=simple_policy(ACTION), overrides=QUICK)
    port = runner.backend._port if kind == "betaflight" else runner.backend._link.port
    sent, write = [], port.write
    port.write = lambda data: (sent.append((clock.now(), bytes(data))), write(data))[1]
    rehearsal = rehearsed(runner)
    summary = fly(runner, source, clock, AutoOperator(), None, 14.0, rehearsal=rehearsal)
    return rehearsal, sent, fake, summary


@pytest.mark.parametrize("kind", ["ardupilot", "px4", "betaflight"])
def test_what_is_sent_is_the_same_to_the_bit_and_the_runner_notices_nothing(kind, monkeypatch):
    monkeypatch.setattr("hil.control.rehearsal.MOST", 1)
    rehearsal, sent, fake, summary = flown(kind, Watched)
    assert rehearsal.failed is None
    assert rehearsal.count > 60
    assert {"idle", "check", "ready", "armed", "throw", "recover", "land"} <= rehearsal.states
    assert (summary["latches"], fake.witness.releases) == (1, 1)
    _, alone, _, _ = flown(kind, Without)
    assert sent == alone


def test_a_rehearsal_that_the_runner_would_notice_is_noticed():
    """The comparison above can fail: a runner whose copy shares its guard."""
    runner, _, clock, _ = peers(LevelPlant(), loaded=simple_policy(ACTION))
    rehearsal = Watched(runner)
    twin = rehearsal.twin()
    twin.machine = runner.machine
    with pytest.raises(AssertionError):
        rehearsal.once(twin, clock.now())


class Slow(ManualClock):
    """Each look at it takes a while."""

    def now(self) -> float:
        self.time += 1e-5
        return self.time


def test_no_rehearsal_begins_that_would_not_end_in_time(monkeypatch):
    runner, _, _, _ = peers(LevelPlant(), loaded=simple_policy(ACTION))
    clock, rehearsal, ends = Slow(), Rehearsal(runner), []

    def once(twin, due):
        clock.time += 1e-3
        ends.append(clock.time)

    monkeypatch.setattr(rehearsal, "once", once)
    for due in (0.02, 0.04, 0.06):
        clock.time = due - BEGIN
        looks = list(rehearsal.steps(clock, due))
        assert looks[-1] < due <= clock.time, "poses are taken in until it is due"
        assert ends[-1] < due - SPARE
        assert clock.time < due + 1e-4
    assert len(ends) == 3 * 4, "four of 1 ms fit into 5 ms"
    clock.time = 0.0799
    assert list(rehearsal.steps(clock, 0.08)) == []


def test_a_release_of_its_own_time_goes_before_a_rehearsal():
    """The mechanism is told when what is left of the lag has passed: between two ticks, here 3 ms before one."""
    overrides = (*QUICK, "ardupilot.mechanism_lag=0.033")
    times = []
    for rehearsed in (Rehearsal, Without):
        runner, source, clock, fake = peers(LevelPlant(), loaded=simple_policy(ACTION), overrides=overrides)
        told, due = [], runner.backend.release_record.due
        runner.backend.release_record.due = lambda now, due=due, told=told: due(now) and not told.append(now)
        rehearsal = rehearsed(runner)
        rehearsal.once = lambda twin, due, fake=fake: fake.step()  # takes its time
        fly(runner, source, clock, AutoOperator(), None, 2.5, rehearsal=rehearsal)
        times.append((runner.latch.count, told))
    assert times[0] == times[1]
    assert times[0][0] == 1


def test_a_runner_that_cannot_be_copied_flies_all_the_same():
    runner, source, clock, _ = peers(LevelPlant(), loaded=simple_policy(ACTION), overrides=QUICK)
    runner.guard.lock = threading.Lock()
    rehearsal = Rehearsal(runner)
    summary = fly(runner, source, clock, AutoOperator(), None, 0.5, rehearsal=rehearsal)
    assert "cannot pickle" in summary["rehearsal_failed"]
    assert (summary["rehearsals"], summary["errors"]) == (0, [])
    del runner.guard.lock
    rehearsal = Rehearsal(runner)
    rehearsal._runner = "none"
    summary = fly(runner, source, clock, AutoOperator(), None, 0.5, rehearsal=rehearsal)
    assert "has no" in summary["rehearsal_failed"]
    assert summary["ticks"] > 20

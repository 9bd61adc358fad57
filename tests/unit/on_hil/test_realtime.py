"""Real-time priority and locked memory: requested only where configured; refusals are reported."""

import ctypes
import os

from hil.control.realtime import RealtimeParams, keep, prepare


def test_nothing_is_requested_by_default(monkeypatch):
    monkeypatch.setattr(os, "sched_setscheduler", None)
    monkeypatch.setattr(ctypes, "CDLL", None)
    assert prepare(RealtimeParams()) == keep(RealtimeParams()) == []


def test_a_refusal_is_reported_with_its_reason(monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    class Library:
        def __init__(self, *_, **__):
            ctypes.set_errno(12)

        def mlockall(self, flags: int) -> int:
            assert flags == 3
            return -1

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(ctypes, "CDLL", Library)
    memory, priority = prepare(RealtimeParams(priority=50, lock_memory=True))
    assert memory == f"memory is not locked: {os.strerror(12)}"
    assert "no real-time priority: [Errno 1] Operation not permitted" in priority

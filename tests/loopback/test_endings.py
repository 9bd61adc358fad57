"""Every way for a run to end, in hover and in throw, with each autopilot's fake: it lands or does
what its table says, nothing is released, and the summary is there. Lock step; `bench.faults` does
the same with processes.
"""

import os
import signal

from pytest import mark

from hil.control.loop import Loop
from hil.operator_terminal import ENDING, Terminal
from tests.hil_flight import NEVER
from tests.level import LevelPlant
from tests.loopback.wire import AUTOPILOTS, QUICK, peers

ABORT = "states.abort=0.6"
STATES = {"armed": ("states.armed_least=9.0",), "throw": ()}
"""In hover, and in a throw that the policy never ends."""

OVER = 2.4
"""Time limit of a run that ends in flight [s]."""

LANDS = {"ardupilot": "mode 9", "px4": "mode 4.6"}
"""Request at the end of a run; Betaflight has no landing mode: the runner flies a descent."""


class Ending:
    """A way to end a run a few ticks into a state: a signal, a part of the loop that raises, the
    end of the time.
    """

    def __init__(self, way: str, state: str, parts, monkeypatch):
        self.runner, source, self.clock, self.fake = parts
        self.way, self.state, self.done_at, self.ticks, self.heights = way, state, None, 0, {}
        monkeypatch.setattr("sys.stdin", None)
        self.saved = {number: signal.getsignal(number) for number in ENDING}
        operator = Terminal(True, lambda: True, lambda text: None)
        tick, poll = self.runner.tick, source.poll

        def ticked(now, *args):
            decision = tick(now, *args)
            self.ticks += decision.state == state
            if self.ticks == 5 and self.done_at is None:
                self.done_at = now
                self.act()
            return decision

        def polled(now):
            if self.way == "source raises" and self.done_at is not None:
                raise OSError("the network card has gone")
            return poll(now)

        self.runner.tick, source.poll = ticked, polled
        try:
            most = OVER if way == "time over" else float("inf")
            self.summary = Loop(self.runner, source, self.clock, operator, None, self.tell).fly(
                most
            )
        finally:
            for number, handler in self.saved.items():
                signal.signal(number, handler)

    def tell(self, decision):
        self.heights.setdefault(decision.state, self.fake.plant.state["pos_w"][2])
        if self.way == "output raises" and decision.state == self.state:
            raise BrokenPipeError("nobody reads")

    def act(self):
        if self.way.startswith("SIG"):
            os.kill(os.getpid(), getattr(signal, self.way))

    @property
    def after(self):
        """The vehicle's events from then on, with the time since."""
        return [
            (round(at - self.done_at, 2), text)
            for at, text in self.fake.events
            if at >= self.done_at - 1e-6
        ]


def with_fake(kind: str, state: str):
    """Runner, source, clock and fake."""
    overrides = (
        *QUICK,
        ABORT,
        *STATES[state],
        *(() if kind == "betaflight" else (f"{kind}.take=true",)),
    )
    return peers(LevelPlant(), kind=kind, loaded=NEVER, overrides=overrides)


REASONS = {
    "SIGINT": "the operator said abort (Ctrl-C)",
    "SIGTERM": "the process received SIGTERM",
    "SIGHUP": "the process received SIGHUP",
    "SIGQUIT": "the process received SIGQUIT",
    "time over": "the time of the run is over",
    "source raises": "OSError: the network card has gone",
}


RUNS = [("SIGINT", state, kind) for state in STATES for kind in AUTOPILOTS]
RUNS += [(way, "throw", AUTOPILOTS[i % 3]) for i, way in enumerate(REASONS) if way != "SIGINT"]
"""Each autopilot in each state, and each way once: the ways do not depend on the autopilot."""


@mark.parametrize(("way", "state", "kind"), RUNS)
def test_it_ends_by_landing(way, state, kind, monkeypatch):
    run = Ending(way, state, with_fake(kind, state), monkeypatch)
    assert (run.summary["aborted"], run.summary["reason"], run.summary["state"]) == (
        True,
        REASONS[way],
        "done",
    )
    assert (run.fake.witness.breaches, run.fake.witness.releases) == ([], 0)
    if kind == "betaflight":
        assert run.fake.override, "it is the runner that brings it down"
        if way != "source raises":
            height = run.runner.hovering.place_w[2]
            assert height < 1.333 - 0.3 * 0.4, "a descent of 0.4 m/s, for 0.6 s"
    else:
        assert LANDS[kind] in [text for _, text in run.after]
        if way != "time over":
            assert next(at for at, text in run.after if text == LANDS[kind]) <= 0.06


def twice(monkeypatch):
    """A second Ctrl-C as soon as the first one has taken effect."""
    original = Terminal.words

    def words(terminal, state):
        typed = original(terminal, state)
        if typed.abort and state == "abort":
            os.kill(os.getpid(), signal.SIGINT)
        return typed

    monkeypatch.setattr(Terminal, "words", words)


def test_a_second_ctrl_c_ends_it_at_once_and_it_lands_all_the_same(monkeypatch):
    """The first one requested the landing; the summary is written."""
    twice(monkeypatch)
    run = Ending("SIGINT", "throw", with_fake("px4", "throw"), monkeypatch)
    assert run.summary["aborted"]
    assert run.summary["ticks"] > 5
    assert run.runner.errors == []
    for _ in range(20):
        run.fake.step()
    assert LANDS["px4"] in [text for _, text in run.after]


def test_output_that_raises_ends_a_throw_by_landing(monkeypatch):
    run = Ending("output raises", "throw", with_fake("ardupilot", "throw"), monkeypatch)
    assert (run.summary["aborted"], run.summary["reason"]) == (
        True,
        "BrokenPipeError: nobody reads",
    )
    assert LANDS["ardupilot"] in [text for _, text in run.fake.events]

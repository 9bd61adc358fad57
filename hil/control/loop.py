"""The loop of a run."""

import gc
import math
import time
from collections.abc import Callable
from typing import Any, Protocol

from hil.backends.base import Backend
from hil.control.decision import Decision, Words
from hil.control.realtime import collected
from hil.control.rehearsal import BEGIN, Rehearsal
from hil.control.runner import Runner
from hil.control.states import State
from hil.links.clock import Clock, Ticker
from hil.poses.pose import Pose
from hil.recording.latency import Stages
from hil.recording.record import Recorder
from hil.sources import Source
from hil.sources.images import Eyes

AHEAD, AHEAD_SPREAD = 1e-3, 5e-3
"""Before a tick the poses that have come are taken in [s], so that the tick finds the last one or two alone; earlier by a share of
the second number that goes round from tick to tick, so that the link is looked at, and peers are asked for their time, at any
point of their periods."""

GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)

COLLECT_ALL = 50
"""Ticks between two looks of the garbage collector at all that was made since the start; the others see the last tick's."""


class Operator(Protocol):
    """Who arms."""

    def words(self, state: str) -> Words:
        """What was said since the last tick; ``state`` is the runner's. Never waits."""


class AutoOperator:
    """Arms whenever the run is ready: for tests and for simulated vehicles, never for real ones."""

    def words(self, state: str) -> Words:
        """See `Operator`."""
        return Words(arm=state == State.READY)


def fly(
    runner: Runner, source: Source, clock: Clock, operator: Operator, recorder: Recorder | None = None,
    most: float = float("inf"), tell: Callable[[Decision], None] | None = None, stages: Stages | None = None,
    eyes: Eyes | None = None, rehearsal: Rehearsal | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Run until the state machine is done, the recorded poses have ended, or for ``most`` seconds.

    Args:
        runner: with its back-end. source: of poses. clock: of the ticks. operator: who arms.
        recorder: of the run's folder; None records nothing.
        most: [s].
        tell: called with the first decision of each state.
        stages: filled with the times of each stage.
        eyes: a camera, where keypoints are a detector's.
        rehearsal: of this runner's ticks; None for none.

    Returns:
        The runner's summary with ticks, misses (those that a tick of ours caused by taking too long, and all), and the
        times of each stage.
    """
    ticker, backend, stages = Ticker(clock, runner.pilot.period), runner.backend, stages or Stages()
    ahead = AHEAD if rehearsal is None else BEGIN
    begin, throws, told, ended, ours, ticks = clock.now(), [], None, -math.inf, 0, 0
    with collected():
        while runner.machine.state is not State.DONE and clock.now() - begin < most and not source.ended:
            _wait(clock, ticker.due() - ahead - AHEAD_SPREAD * (ticks * GOLDEN % 1.0), backend, source)
            early = _approach(runner, source, clock, ticker.due(), rehearsal)
            due, missed = ticker.due(), ticker.missed
            now, start = ticker.take(), time.perf_counter()
            ours += (ticker.missed - missed) * (ended > due)
            late = source.poll(now)
            polled = time.perf_counter()
            status, words = backend.status(now), operator.words(runner.machine.state.value)
            recording = recorder is None or recorder.failed is None
            asked = time.perf_counter()
            if eyes is not None:
                eyes.tell(runner.hint(now))
                runner.look(eyes.poll(now))
            decision = runner.tick(now, late, status, words, recording)
            poses = early + late
            times = {"late": ticker.late, "poll": polled - start, **stages.poses(poses, now), **runner.spent}
            if "total" in times:
                times["total"] += asked - start
            backend.service(now)
            stages.add(times)
            if decision.release:
                throws.append(now)
            if tell is not None and decision.state != told:
                told = decision.state
                tell(decision)
            if recorder is not None:
                recorder.tick(ticker.index, poses, status, words, recording, decision, times)
            ticks += 1
            gc.collect(1 if ticks % COLLECT_ALL == 0 else 0)
            ended = clock.now()
    record = getattr(backend, "release_record", None)  # a dry run has none
    for delay in record.answers if record is not None else ():
        stages.add({"ack": delay})
    if runner.machine.state is State.DONE and not runner.machine.aborted:
        backend.finish(clock.now())
    return {
        **runner.summary(), "ticks": ticks, "missed": ticker.missed, "missed_ours": ours,
        "worst_late_s": ticker.worst, "latency": stages.summary(), "latch_times": throws,
        **({} if rehearsal is None else {"rehearsals": rehearsal.count, "rehearsal_failed": rehearsal.failed}),
    }  # fmt: skip


def _approach(runner: Runner, source: Source, clock: Clock, due: float, rehearsal: Rehearsal | None) -> list[Pose]:
    """Wait until a tick is due [s], and rehearse it; returns the poses that were taken in before it."""
    poses = source.poll(clock.now())
    runner.take(poses)
    own = runner.backend.due()
    if rehearsal is not None and (own is None or own >= due):  # what the back-end has to do to the millisecond goes first
        for now in rehearsal.steps(clock, due):
            came = source.poll(now)
            runner.take(came)
            poses += came
    _wait(clock, due, runner.backend, source)
    return poses


def _wait(clock: Clock, until: float, backend: Backend, source: Source) -> None:
    """Wait until a time [s]; in between do what the back-end has to do at a time of its own."""
    while True:
        due = backend.due()
        if due is None or due >= until:
            break
        source.wait(clock, due)
        backend.service(clock.now())
        if backend.due() == due:
            break
    source.wait(clock, until)

"""The loop of a run, and its replay."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from hil.backends.base import Backend, DryRun, Status
from hil.clock import Clock, Ticker
from hil.pose import GOAL, PAYLOAD
from hil.record import Recorder, load_run, percentiles
from hil.runner import Decision, Runner, Words
from hil.sources import Source
from hil.states import State

STAGES = ("late", "poll", "decide")
"""How late a tick began, how long it took to take in poses, and from there to the command sent."""


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
    most: float = float("inf"), tell: Callable[[Decision], None] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Run until the state machine is done, the recorded poses have ended, or for ``most`` seconds.

    Args:
        runner: with its back-end. source: of poses. clock: of the ticks. operator: who arms.
        recorder: of the run's folder; None records nothing.
        most: [s].
        tell: called with the first decision of each state.

    Returns:
        The runner's summary with ticks, misses and the times of each stage.
    """
    ticker, backend = Ticker(clock, runner.pilot.period), runner.backend
    stages: dict[str, list[float]] = {name: [] for name in STAGES}
    begin, throws, told = clock.now(), [], None
    while runner.machine.state is not State.DONE and clock.now() - begin < most and not source.ended:
        _wait(clock, ticker, backend, source)
        now, start = ticker.take(), time.perf_counter()
        poses = source.poll(now)
        polled = time.perf_counter()
        status, words = backend.status(now), operator.words(runner.machine.state.value)
        recording = recorder is None or recorder.failed is None
        decision = runner.tick(now, poses, status, words, recording)
        backend.service(now)
        times = {"late": ticker.late, "poll": polled - start, "decide": time.perf_counter() - polled}
        for name, value in times.items():
            stages[name].append(value)
        if decision.release:
            throws.append(now)
        if tell is not None and decision.state != told:
            told = decision.state
            tell(decision)
        if recorder is not None:
            recorder.tick(ticker.index, poses, status, words, recording, decision, times)
    return {
        **runner.summary(), "ticks": len(stages["late"]), "missed": ticker.missed, "worst_late_s": ticker.worst,
        "latency": {name: percentiles(values) for name, values in stages.items()}, "latch_times": throws,
    }  # fmt: skip


def _wait(clock: Clock, ticker: Ticker, backend: Backend, source: Source) -> None:
    """Wait for the next tick; in between do what the back-end has to do at a time of its own."""
    while True:
        due = backend.due()
        if due is None or due >= ticker.due():
            break
        source.wait(clock, due)
        backend.service(clock.now())
        if backend.due() == due:
            break
    source.wait(clock, ticker.due())


COMPARED = ("state", "command", "action", "observation", "keypoints", "valid", "release")
"""What a replay must give again, bit for bit."""


def replay(folder: str | Path) -> dict[str, Any]:
    """Run the recorded poses, statuses and words of a run through the runner again.

    Returns:
        Number of ticks and actions compared, and the differences: tick, name, recorded value, value now.

    Raises:
        RunError: no folder of a run, or a damaged one.
    """
    params, policy, ticks, poses = load_run(folder)
    runner = Runner(params, policy, DryRun())
    differences: list[tuple[int, str, Any, Any]] = []
    actions = 0
    for line in ticks:
        connected, note, release = line["status"]
        decision = runner.tick(
            line["time"], poses.get(line["n"], []), Status(connected, note, release), Words(*line["words"]),
            line["recording"],
        )  # fmt: skip
        actions += decision.action is not None
        for name in COMPARED:
            was, now = line[name], getattr(decision, name)
            now = list(now) if isinstance(now, tuple) else now
            if was != now:
                differences.append((line["n"], name, was, now))
    return {
        "ticks": len(ticks),
        "actions": actions,
        "bodies": sorted({pose.body for group in poses.values() for pose in group} & {PAYLOAD, GOAL, "vehicle"}),
        "differences": differences,
    }

"""The main loop of a run: poses in, one tick, recording."""

import gc
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any, Protocol

from hil.control.calibrating import Calibrating, CalibrationSolver
from hil.control.realtime import pause_garbage_collection
from hil.control.recording.latency import Stages
from hil.control.recording.record import RunRecorder
from hil.control.state_machine import OperatorInput, State, TickRecord
from hil.control.tick.runner import Runner
from hil.links.backends.base import Backend, DryRun
from hil.links.clock import Clock, Ticker
from hil.links.team_link import TeamLink
from hil.poses.pose import Pose
from hil.poses.sources.images import Eyes
from hil.poses.sources.pose_source import Source

LEAD = 1e-3
LEAD_SPREAD = 5e-3
"""Poses that have arrived are processed this long before the tick [s], so that only the last one or
two are left to the tick. The second number is the range of an additional lead, which differs from
tick to tick: so the link is read, and peers are asked for their time, at varying phases of their
periods.
"""

REHEARSAL = 5e-3
"""Time reserved for the first rehearsal [s]. Later, the longest recent rehearsal is reserved."""

FORGETTING = 0.98  # factor by which the reserved time shrinks from rehearsal to rehearsal
MARGIN = 5e-4  # between rehearsal and tick, for poses that arrived meanwhile [s]

GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)

SAY_AGAIN = 3.0  # least time between reports of one reason that differ only in numbers [s]

NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")

# ticks between collections of all garbage since the start; in other ticks only recent objects are
# collected
COLLECT_ALL = 50


class Operator(Protocol):
    """The source of the operator's commands."""

    def words(self, state: str) -> OperatorInput:
        """Return the commands since the last tick without waiting; ``state``: of the runner."""


@dataclass
class LandAfterCalibration:
    """An operator that lands the vehicle once the camera is calibrated, and never arms a throw."""

    operator: Operator  # whose other commands are passed on
    calibrating: Calibrating

    def words(self, state: str) -> OperatorInput:
        words = self.operator.words(state)
        calibrated = self.calibrating.calibration is not None
        return replace(words, arm=False, land=words.land or calibrated)


@dataclass
class Loop:
    """The main loop: wait for the tick, process poses, decide and act, record."""

    runner: Runner  # with its back-end
    source: Source  # of poses
    clock: Clock  # of the ticks
    operator: Operator  # who arms
    recorder: RunRecorder | None = None  # of the run's folder
    # called with the first decision of each state and of each reason to wait
    tell: Callable[[TickRecord], None] | None = None
    stages: Stages = field(default_factory=Stages)  # collects the times of each stage
    eyes: Eyes | None = None  # the camera, if a detector finds the keypoints
    solver: CalibrationSolver | None = None  # of its calibration
    team: TeamLink | None = None  # to the runners of vehicles that throw with it
    ours: int = 0  # missed ticks, because a tick of the runner took too long
    count: int = 0
    throws: list[float] = field(default_factory=list)  # times of the releases [s]
    _ended: float = -math.inf
    _rehearsal: float = REHEARSAL  # reserved for one [s]
    _state: str = ""
    _waits: str = ""
    # reasons to wait without their numbers -> when they were reported [s]
    _announced: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        grid = None if self.team is None else self.team.offset
        self.ticker = Ticker(self.clock, self.runner.pilot.period, grid)

    def fly(self, limit: float = math.inf) -> dict[str, Any]:
        """Run until the state machine is done, the recorded poses end, or a time limit [s] is over;
        return the summary.

        A vehicle under the runner's control is never abandoned: if the time is over in flight or an
        exception is raised, the run is aborted and continues until it has ended. A second Ctrl-C
        ends it at once, after one more request to land."""
        runner = self.runner
        clock = self.clock
        begin = self.clock.now()
        with pause_garbage_collection():
            while runner.machine.state is not State.DONE and not self.source.ended:
                finished = clock.now() - begin >= limit
                if finished and (runner.backend.name == DryRun.name or not runner.in_flight):
                    break
                try:
                    self.turn(finished)
                except KeyboardInterrupt as error:
                    runner.fail(clock.now(), error)
                    break
                except Exception as error:  # around the runner: it ends in abort all the same
                    runner.fail(clock.now(), error)
                    clock.sleep_until(clock.now() + runner.pilot.period)
        return self.summary()

    def turn(self, finished: bool) -> None:
        """Do one tick; ``finished``: the run's time is over, so a flying vehicle has to land."""
        runner = self.runner
        source = self.source
        clock = self.clock
        ticker = self.ticker
        backend = self.runner.backend
        source.hold(runner.in_flight)
        lead = LEAD + LEAD_SPREAD * (self.count * GOLDEN % 1.0)
        if runner.policy_flies:
            lead += self._rehearsal
        _wait(clock, ticker.due() - lead, backend, source)
        early = self._take_poses()
        if runner.policy_flies:
            self._rehearse()
            early += self._take_poses()
        _wait(clock, ticker.due(), backend, source)
        due = ticker.due()
        missed = ticker.missed
        time = ticker.take()
        start = perf_counter()
        self.ours += (ticker.missed - missed) * (self._ended > due)
        late = source.poll(time)
        polled = perf_counter()
        status = backend.status(time)
        words = self.operator.words(runner.machine.state.value)
        if finished:
            words = replace(words, abort=True, why=words.why or "the time of the run is over")
        recording = self.recorder is None or self.recorder.failed is None
        end = perf_counter()
        if self.eyes is not None:
            self.eyes.hint = runner.estimator.hint(time)
            runner.estimator.take_detections(self.eyes.poll(time))
        if self.solver is not None and (result := self.solver.poll()) is not None:
            runner.commander.calibration = result
        decision = self._tick(time, late, status, words, recording)
        if self.solver is not None and (hovered := runner.calibrating.due()) is not None:
            self.solver.submit(hovered)
        times = {
            "late": ticker.late,
            "poll": polled - start,
            **self.stages.poses(early + late, time),
            **runner.spent,
        }
        if "total" in times:
            times["total"] += end - start
        backend.service(time)
        self.stages.add(times)
        if decision.release:
            self.throws.append(time)
        self._tell(decision)
        if self.recorder is not None:
            self.recorder.tick(
                ticker.index, early + late, status, words, recording, decision, times
            )
        self.count += 1
        gc.collect(1 if self.count % COLLECT_ALL == 0 else 0)
        self._ended = clock.now()

    def _take_poses(self) -> list[Pose]:
        """Process the poses that have arrived before the tick, and return them."""
        poses = self.source.poll(self.clock.now())
        self.runner.take_poses(poses)
        return poses

    def _rehearse(self) -> None:
        """Rehearse the next tick just before it is due, if there is time for it.

        Time is measured by the run's clock. In lock step this clock stands still, so that ticks do
        not depend on the computer's speed.
        """
        clock = self.clock
        due = self.ticker.due()
        _wait(clock, due - self._rehearsal - MARGIN, self.runner.backend, self.source)
        start = clock.now()
        if start + self._rehearsal > due:
            return
        self.runner.pilot.rehearse()
        self._rehearsal = max(clock.now() - start, FORGETTING * self._rehearsal)

    def _tick(self, time: float, *inputs: Any) -> TickRecord:
        """Do one tick with what the team agreed on, and tell the team what this vehicle is ready
        for.
        """
        if self.team is None:
            return self.runner.tick(time, *inputs)
        self.runner.agreed = self.team.agree(time)
        decision = self.runner.tick(time, *inputs)
        self.team.say(decision.ready)
        return decision

    def _tell(self, decision: TickRecord) -> None:
        """Report a change of state or a new reason to wait at once; a reason of which only the
        numbers changed, every few seconds.
        """
        waits = decision.waits
        time = decision.time
        kind = NUMBER.sub("", waits)
        if decision.state != self._state:
            self._state = decision.state
            self._announced = {}
        elif decision.calibration is not None:
            pass
        elif (
            not waits
            or waits == self._waits
            or time - self._announced.get(kind, -math.inf) < SAY_AGAIN
        ):
            return
        self._announced[kind] = time
        self._waits = waits
        if self.tell is not None:
            self.tell(decision)

    def summary(self) -> dict[str, Any]:
        """Return the runner's summary with the ticks, the missed ticks (all of them, and those
        missed because a tick took too long), and the times of each stage.
        """
        runner = self.runner
        backend = self.runner.backend
        ticker = self.ticker
        record = getattr(backend, "release_record", None)  # a dry run has none
        for delay in record.answers if record is not None else ():
            self.stages.add({"ack": delay})
        if runner.machine.state is State.DONE and not runner.machine.aborted:
            backend.finish(self.clock.now())
        return {
            **runner.summary(),
            "ticks": self.count,
            "missed": ticker.missed,
            "missed_ours": self.ours,
            "worst_late_s": ticker.worst,
            "latency": self.stages.summary(),
            "latch_times": self.throws,
        }


def _wait(clock: Clock, until: float, backend: Backend, source: Source) -> None:
    """Wait until a time [s]; meanwhile serve the back-end whenever it is due."""
    while True:
        due = backend.due()
        if due is None or due >= until:
            break
        source.wait(clock, due)
        backend.service(clock.now())
        if backend.due() == due:
            break
    source.wait(clock, until)

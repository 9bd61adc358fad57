"""The runner, which turns poses into a command at each tick in three steps: estimate, decide, act.

It never raises: an exception puts it into the abort state.

A tick depends only on its time, the poses and detections since the last tick, the back-end's status
and the operator's commands. All of them are recorded, so that a replay repeats every decision bit
for bit."""

import traceback
from dataclasses import asdict
from time import perf_counter
from typing import Any

from hil.control.state_machine import Inputs, OperatorInput, State, TickRecord
from hil.control.tick.commander import Commander
from hil.control.tick.decider import Decider
from hil.control.tick.flight_parts import FlightParts
from hil.control.tick.state_estimator import StateEstimator
from hil.links.backends.base import Backend, Status
from hil.params import HilParams
from hil.poses.gate import ABORT
from hil.poses.pose import Pose
from visthrow.onboard.policy import Policy

MOST_ERRORS = 100  # tracebacks kept


class Runner(FlightParts):
    """Flies one vehicle.

    Attributes:
        estimator, decider, commander: the three steps.
        errors: tracebacks of caught exceptions, without duplicates.
    """

    def __init__(
        self, params: HilParams, policy: Policy, backend: Backend, mechanism_lag: float = 0.0
    ):
        """Build all parts; ``mechanism_lag``: from the mechanism's command to separation [s].

        Raises MismatchError, PolicyError: the camera is not the one that the policy was trained
        with, or the policy is incomplete; RunError: the mechanism is slower than the policy was
        trained for."""
        super().__init__(params, policy, backend, mechanism_lag)
        self.estimator = StateEstimator(self)
        self.decider = Decider(self)
        self.commander = Commander(self)
        self.errors: list[str] = []
        self._early_error: Exception | None = None

    def take_poses(self, poses: list[Pose]) -> None:
        """Process poses ahead of their tick, which then has less to do and decides the same. An
        exception is raised again in the tick.
        """
        if self._early_error is not None:
            return
        try:
            self.estimator.take_poses(poses)
            for track in self.tracks.values():
                track.settle()
        except Exception as error:  # as in tick
            self._early_error = error

    @property
    def policy_flies(self) -> bool:
        """Whether the policy decides the next tick."""
        return self.machine.state is State.THROW or self.params.observe

    def tick(
        self,
        time: float,
        poses: list[Pose],
        status: Status,
        words: OperatorInput,
        recording: bool = True,
    ) -> TickRecord:
        """Decide one tick and send its command.

        Args:
            time: on the runner's clock [s].
            poses: raw, since the last tick.
            status: of the back-end at this tick.
            words: of the operator.
            recording: whether everything was recorded so far.
        """
        begin = perf_counter()
        self.spent = {}
        try:
            self._raise_early_error()
            self.estimator.take_poses(poses)
            estimate = self.estimator.estimate(time)
            record = self.decider.decide(estimate, status, words, recording)
            self.commander.enter(estimate, record.state)
            self.estimator.show_detection(estimate, record)
            self.spent["estimate"] = perf_counter() - begin
            self.commander.act(estimate, status, record, begin)
        except Exception as error:  # in flight nothing raises past the runner
            return self.fail(time, error)
        return record

    def _raise_early_error(self) -> None:
        if self._early_error is not None:
            error = self._early_error
            self._early_error = None
            raise error

    def fail(self, time: float, error: BaseException) -> TickRecord:
        """Abort the run because of an exception: stop the release and ask the autopilot to land."""
        reason = "Ctrl-C twice"
        if isinstance(error, Exception):
            reason = f"{type(error).__name__}: {error}"
            trace = "".join(traceback.format_exception(error))
            if trace not in self.errors and len(self.errors) < MOST_ERRORS:
                self.errors.append(trace)
        self.machine.step(time, Inputs(ABORT, ABORT, failure=reason))
        self.backend.stop_release()
        if self.machine.flown:
            self.backend.abort(time)
        return TickRecord(time, self.machine.state.value, self.machine.reason, note="exception")

    @property
    def in_flight(self) -> bool:
        """Whether the runner has taken the vehicle and the run is not over."""
        return self.machine.flown and self.machine.state is not State.DONE

    def summary(self) -> dict[str, Any]:
        """Return counts of the run so far."""
        machine = self.machine
        latch = self.latch
        guard = self.commander.guard
        calibration = None if self.calibrating is None else self.calibrating.calibration
        bodies = {
            body: {
                "accepted": track.accepted,
                "refused": track.gate.refused,
                "filter_lag": track.filter.lag,
            }
            for body, track in self.tracks.items()
        }
        return {
            "state": machine.state.value,
            "reason": machine.reason,
            "aborted": machine.aborted,
            "throws": machine.throws,
            "cancelled": machine.cancelled,
            "latches": latch.count,
            "stuck": latch.stuck,
            "held_back": self.aim.refused,
            "landings": [asdict(landing) for landing in latch.landings],
            "guard": {
                "clipped": guard.clipped,
                "slewed": guard.slewed,
                "refused": guard.refused,
            },
            "bodies": bodies,
            "left_fence": machine.left_fence,
            "calibration": None if calibration is None else calibration.values(),
            "errors": self.errors,
        }

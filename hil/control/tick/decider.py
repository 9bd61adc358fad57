"""Decide: the second step of a tick, from the estimate to the state of the run."""

from collections import deque

from hil.control.safety import failed_checks, fence_violation
from hil.control.state_machine import Inputs, OperatorInput, State, TickRecord
from hil.control.tick.body_estimate import Estimate
from hil.control.tick.flight_parts import FlightParts
from hil.links.backends.base import FAILED, FOLLOW, PENDING, Status
from hil.links.backends.base import HOLD as HOLDING
from hil.links.team_link import NOTHING
from hil.poses.gate import HOLD
from hil.poses.pose import GOAL
from visthrow.onboard.hover import GRAVITY

PATIENCE = 10  # ticks of a throw without agreement that are tolerated: messages may be lost
GROUND = 0.12  # height of the vehicle that counts as landed [m]
# number of reports that an average of the autopilot's hover thrust needs, and most that are kept;
# share of the weight below which the vehicle stands on the ground
FEWEST_REPORTS = 25
MOST_REPORTS = 50
GROUND_SHARE = 0.3


class Decider:
    """Advances the state machine.

    Attributes:
        inputs: of the machine at the last tick; None before the first.
    """

    def __init__(self, parts: FlightParts):
        """Start before the first tick."""
        self.parts = parts
        self.inputs: Inputs | None = None
        self._alone = 0  # ticks without agreement of the team
        self._shares: deque[float] = deque(maxlen=MOST_REPORTS)  # autopilot's thrust over weight

    def decide(
        self, estimate: Estimate, status: Status, words: OperatorInput, recording: bool
    ) -> TickRecord:
        """Return the record of a tick with its state and reason."""
        machine = self.parts.machine
        self.inputs = inputs = self._inputs(estimate, status, words, recording)
        state = machine.step(estimate.time, inputs)
        waits = machine.waits(inputs)
        return TickRecord(
            estimate.time, state.value, machine.reason, waits=waits, agreed=self.parts.agreed
        )

    def _inputs(
        self, estimate: Estimate, status: Status, words: OperatorInput, recording: bool
    ) -> Inputs:
        parts = self.parts
        time = estimate.time
        state = parts.machine.state
        latch = parts.latch
        vehicle = estimate.vehicle
        failure = status.fault
        fence = None
        calm = False
        self._alone = self._alone + 1 if parts.agreed == NOTHING else 0
        if status.release == FAILED and state in (State.THROW, State.RECOVER):
            failure = "the release was refused or not answered"
        checks = self._failed_checks(estimate, status)
        if vehicle is not None:
            # A release that is not acknowledged yet may still happen.
            if state in (State.ARMED, State.RECOVER) and status.release != PENDING:
                calm = parts.is_calm(estimate, status.mode == HOLDING)
            # A landing crosses the fence's floor on purpose.
            if state is not State.LAND:
                hanging = estimate.payload if latch.at is None else None
                fence = fence_violation(parts.params.fence, vehicle, hanging)
        return Inputs(
            estimate.vehicle_level,
            estimate.payload_level,
            connected=status.connected,
            failed_checks=tuple(checks),
            fence=fence,
            calm=calm,
            separated=latch.has_separated(time),
            released=latch.at is not None,
            lost=latch.at is None and not parts.carries_payload(estimate),
            astray=parts.aim.has_given_up(time),
            agreed=parts.agreed,
            alone=self._alone > PATIENCE,
            grounded=vehicle is not None and vehicle.pos[2] < GROUND,
            failure=failure,
            arm=words.arm,
            land=words.land,
            abort=words.abort,
            recording=recording,
            following=status.mode == FOLLOW,
            note=status.note,
            why=words.why,
            streams=tuple(self._stream_problems(time)),
            disagrees=None if parts.response is None else parts.response.problem,
        )

    def _failed_checks(self, estimate: Estimate, status: Status) -> list[str]:
        """Return texts of the failed pre-throw checks."""
        parts = self.parts
        params = self.parts.params
        state = self.parts.machine.state
        # After a throw the payload may have been attached again; only the operator's next command
        # to arm resets the latch.
        thrown = state is State.THROW or (parts.latch.at is not None and state is not State.READY)
        if thrown or not estimate.is_complete:
            return ["a body has no pose yet"]
        checks = failed_checks(
            params.check,
            params.fence,
            estimate.vehicle,
            estimate.payload,
            estimate.goal_w,
            params.home_w,
            parts.hang,
        )
        if estimate.goal_level >= HOLD:
            checks.append("the goal's pose is stale")
        self._note_thrust(status)
        checks += self.thrust_problems()
        if parts.detections is not None and state in (State.READY, State.ARMED):
            checks += parts.detections.problems(estimate.time)
            if parts.calibrating is not None:
                checks += parts.calibrating.problems()
        return checks

    def _note_thrust(self, status: Status) -> None:
        """Record the thrust in the autopilot's own hover, until the take-over."""
        if status.thrust is None or self.parts.machine.flown:
            self._shares.clear()
        else:
            self._shares.append(status.thrust / (self.parts.mass * GRAVITY))

    def thrust_problems(self) -> list[str]:
        """Return texts on a hover thrust that differs from the weight, in the autopilot's own hover
        before the take-over and in the runner's after it. A wrong calibration, another vehicle or a
        low battery causes that.
        """
        parts = self.parts
        flown = self.parts.machine.flown
        problems = []
        ratio = parts.hovering.share()
        tolerance = parts.thrust_tolerance
        if len(self._shares) >= FEWEST_REPORTS:
            ratio = sum(self._shares) / len(self._shares)
        wrong = ratio is not None and abs(ratio - 1.0) > tolerance
        if wrong and (flown or ratio > GROUND_SHARE):
            hover = "hovering takes" if flown else "its own hover takes"
            problems.append(
                f"{hover} {ratio:.2f} times the weight, within {tolerance:g} of 1 expected:"
                " calibrate the thrust, or weigh the vehicle"
            )
        if flown and parts.response is not None and parts.response.running:
            problems.append("its response to body rates is being checked")
        return problems

    def _stream_problems(self, time: float) -> list[str]:
        """Return the problems of the pose streams; none after the take-over."""
        if self.parts.machine.state not in (State.IDLE, State.CHECK):
            return []
        return [
            f"{body}: {text}"
            for body, track in self.parts.tracks.items()
            if body != GOAL
            for text in track.stream.problems(time)
        ]

    def problems(self) -> list[str]:
        """Return the problems that forbid the take-over, as of the last tick."""
        inputs = self.inputs
        tracks = self.parts.tracks
        if inputs is None:
            return ["no tick has run yet"]
        missing = [f"no good pose of the {n}" for n, t in tracks.items() if not t.accepted]
        if missing:
            return [*missing, *inputs.streams]
        return [*inputs.list_missing(), *inputs.streams, *inputs.failed_checks]

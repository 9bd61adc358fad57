"""State machine of a run: the reaction to the operator, stale poses, fences, time-outs and a silent
autopilot. It has no side effects.

    idle -> check -> ready -> armed -> throw -> recover -> ready (more throws) or land -> done
    any -> abort -> done

``idle`` waits for poses and the autopilot, ``check`` for the checks to hold for a while. From
``ready`` on the runner commands: its hover controller holds the vehicle. Each throw needs its own
command of the operator, which arms the *throw*. The vehicle's motors are armed by its back-end, in
`hil.links.backends`."""

from dataclasses import dataclass
from enum import StrEnum

from hil.links.backends.base import Command
from hil.links.team_link import NOTHING, THROW
from hil.poses.gate import ABORT, HOLD
from visthrow.config.bounds import Bounded, Positive


class State(StrEnum):
    """The state of a run."""

    IDLE = "idle"
    CHECK = "check"
    READY = "ready"
    ARMED = "armed"  # the operator armed a throw; the vehicle flies
    THROW = "throw"
    RECOVER = "recover"
    LAND = "land"
    ABORT = "abort"
    DONE = "done"


# states in which the runner commands the vehicle
FLYING = (State.READY, State.ARMED, State.THROW, State.RECOVER, State.LAND)


@dataclass(frozen=True)
class StateParams(Bounded):
    """Time-outs and durations [s]."""

    idle: Positive  # for poses and autopilot to appear; then abort
    check: Positive  # for the checks to pass; then abort
    check_hold: Positive  # for which all checks must hold
    ready: Positive  # for the operator; then land
    armed: Positive  # for the swing to calm down; then back to ready, not armed
    armed_least: Positive  # in armed before the throw
    quiet: Positive  # for which vehicle and payload must be calm
    throw: Positive  # for the policy to release; then recover with the payload
    recover: Positive  # for the hover to calm down again; then land
    land: Positive  # for the descent; then done
    abort: Positive  # after which an aborted run ends


@dataclass(frozen=True)
class Inputs:
    """The inputs of one tick. Levels are those of `hil.poses.gate`."""

    vehicle: int
    payload: int
    connected: bool = True  # the autopilot answers, in the right mode, armed
    failed_checks: tuple[str, ...] = ()
    fence: str | None = None  # which fence is violated
    calm: bool = False  # vehicle at home, vehicle and payload slow
    separated: bool = False  # in this throw the trained lag since the latch is over
    released: bool = False  # the latch has tripped in this throw
    lost: bool = False  # the payload has detached without a release
    astray: bool = False  # releases were refused, and none was accepted in time
    agreed: int | None = None  # what the team agreed on for this tick; None without a team
    alone: bool = False  # the team has not agreed on anything for a while
    grounded: bool = False  # the vehicle has landed
    failure: str | None = None  # of policy, guard, release or runner
    arm: bool = False  # the operator's commands
    land: bool = False
    abort: bool = False
    recording: bool = True  # everything was recorded so far
    following: bool = True  # the autopilot follows commands
    note: str = ""  # of the autopilot: its problem, or what it waits for
    why: str = ""  # reason of an abort that the operator did not type
    streams: tuple[str, ...] = ()  # problems of the pose streams before the take-over
    disagrees: str | None = None  # how the first hover contradicts the policy's vehicle

    def list_missing(self) -> list[str]:
        """Return what is missing before the checks begin."""
        texts = []
        if self.vehicle >= HOLD:
            texts.append("no fresh pose of the vehicle")
        if self.payload >= HOLD:
            texts.append("no fresh pose of the payload")
        if not self.connected:
            texts.append("autopilot not ready" + (f" ({self.note})" if self.note else ""))
        return texts

    def poses_are_stale(self) -> bool:
        """Return whether the pose of vehicle or payload is stale."""
        return max(self.vehicle, self.payload) >= HOLD


@dataclass
class Machine:
    """The state, and the time and reason of its last change."""

    params: StateParams  # time-outs and durations
    max_throws: int  # after which it lands
    patient: bool = False  # whether idle and check have no time-out: poses are only observed
    # whether commands go to a vehicle. If not, no fence applies before a throw is armed, because
    # somebody else flies.
    sends: bool = True
    state: State = State.IDLE  # of this tick
    reason: str = "start"  # of the last change
    since: float | None = None  # time of the last change [s]
    throws: int = 0  # begun
    cancelled: int = 0  # throws that ended without a release
    flown: bool = False  # whether this run has ever commanded the vehicle
    aborted: bool = False  # whether an abort ended the run
    # how the vehicle left its fence after a throw; the run then ends by a landing, not by an abort
    left_fence: str | None = None
    handed_back: bool = False  # whether the autopilot's hold mode or the pilot has control again
    ready_to_throw: bool = False  # whether only the team's agreement is missing
    _lasting_since: float | None = None  # start of the condition that must last [s]

    def step(self, time: float, inputs: Inputs) -> State:
        """Advance by one tick; return the state to act in."""
        if self.since is None:
            self.since = time
        urgent = self._abort_reason(inputs)
        if self.state is State.ABORT:
            # A vehicle that the runner never commanded needs no descent.
            if not self.flown or time - self.since > self.params.abort:
                self._go(time, State.DONE, self.reason)
        elif self.state is not State.DONE:
            if inputs.disagrees is not None and self.state in (State.READY, State.ARMED):
                self.handed_back = True
                self._go(time, State.ABORT, f"handed back: {inputs.disagrees}")
            elif urgent is not None:
                self._go(time, State.ABORT, urgent)
            else:
                _STEPS[self.state](self, time, inputs)
        return self.state

    def _abort_reason(self, inputs: Inputs) -> str | None:
        if inputs.abort:
            return inputs.why or "the operator said abort"
        if inputs.failure is not None:
            return inputs.failure
        if self.state not in FLYING:
            return None
        if inputs.vehicle >= ABORT:
            return "no new pose of the vehicle"
        spectating = self.state is State.READY and not self.sends
        recovering = self.state is State.RECOVER and inputs.released
        if inputs.fence is not None and not spectating and not recovering:
            return f"fence: {inputs.fence}"
        if not inputs.connected:
            note = f": {inputs.note}" if inputs.note else ""
            return f"the autopilot is silent, disarmed or in another mode{note}"
        return None

    def _go(self, time: float, state: State, reason: str) -> None:
        if self.state is State.THROW and state is not State.THROW and reason != "separated":
            self.cancelled += 1
        self.state = state
        self.reason = reason
        self.since = time
        self._lasting_since = None
        self.ready_to_throw = False
        self.throws += state is State.THROW
        self.flown |= state in FLYING
        self.aborted |= state is State.ABORT

    def _go_land(self, time: float, inputs: Inputs, reason: str = "") -> None:
        self._go(time, State.LAND, "the operator said land" if inputs.land else reason)

    def waits(self, inputs: Inputs) -> str:
        """Return a text on what the state waits for; empty if it only waits for time to pass."""
        texts: list[str] = []
        if self.state in (State.IDLE, State.CHECK):
            texts += [*inputs.list_missing(), *inputs.streams]
        if self.state in (State.CHECK, State.READY, State.ARMED):
            texts += inputs.failed_checks
        if self.state in (State.READY, State.ARMED):
            if inputs.payload >= HOLD:
                texts.append("no fresh pose of the payload")
            if not inputs.recording:
                texts.append("the recording failed")
            if not inputs.following:
                note = f" ({inputs.note})" if inputs.note else ""
                texts.append(f"the autopilot does not follow yet{note}")
        if self.state in (State.ARMED, State.RECOVER) and not inputs.calm:
            texts.append("not calm yet")
        if self.ready_to_throw and inputs.agreed == NOTHING:
            texts.append("the team's word")
        if self.state is State.READY and not texts and not inputs.arm:
            texts.append("the operator's word: arm")
        return "; ".join(texts)

    def _has_lasted(self, time: float, holds: bool, duration: float) -> bool:
        """Return whether a condition has held for a time [s]."""
        if not holds:
            self._lasting_since = None
            return False
        if self._lasting_since is None:
            self._lasting_since = time
        return time - self._lasting_since >= duration - 1e-9

    def measure_hold(self, time: float) -> float:
        """Return how long the condition that must last has held [s]."""
        return 0.0 if self._lasting_since is None else time - self._lasting_since

    def _is_late(self, time: float) -> bool:
        return time - self.since > getattr(self.params, self.state.value)

    def _idle(self, time: float, inputs: Inputs) -> None:
        if not inputs.list_missing():
            self._go(time, State.CHECK, "poses and autopilot are there")
        elif self._is_late(time) and not self.patient:
            self._go(
                time, State.ABORT, f"{', '.join(inputs.list_missing())}, for {self.params.idle:g} s"
            )

    def _check(self, time: float, inputs: Inputs) -> None:
        good = not (inputs.list_missing() or inputs.failed_checks or inputs.streams)
        if self._has_lasted(time, good, self.params.check_hold):
            self._go(time, State.READY, "checks passed")
        elif self._is_late(time) and not self.patient:
            reason = self.waits(inputs) or "poses or autopilot come and go"
            self._go(time, State.ABORT, f"checks: {reason}")

    def _ready(self, time: float, inputs: Inputs) -> None:
        if inputs.land or self._is_late(time):
            self._go_land(time, inputs, "nobody armed a throw")
        elif not (inputs.arm and inputs.following and inputs.recording):
            return
        elif not inputs.failed_checks and inputs.payload < HOLD:
            self._go(time, State.ARMED, "the operator armed this throw")

    def _armed(self, time: float, inputs: Inputs) -> None:
        if inputs.land:
            self._go_land(time, inputs)
            return
        if inputs.poses_are_stale() or not (inputs.recording and inputs.following):
            reason = "disarmed: stale poses, not followed, or the recording failed"
            self._go(time, State.READY, reason)
            return
        calm = self._has_lasted(time, inputs.calm and not inputs.failed_checks, self.params.quiet)
        self.ready_to_throw = calm and time - self.since >= self.params.armed_least
        if inputs.agreed == THROW or (self.ready_to_throw and inputs.agreed is None):
            self._go(time, State.THROW, "calm")
        elif self._is_late(time):
            reason = self.waits(inputs) or "the swing did not calm down"
            self._go(time, State.READY, f"disarmed: {reason}")

    def _throw(self, time: float, inputs: Inputs) -> None:
        reasons = {
            "separated": inputs.separated,
            # a latched release cannot be taken back: fly on until the separation
            "": inputs.released,
            "stale poses": inputs.poses_are_stale(),
            "the payload has come off by itself": inputs.lost,
            "the policy released where it would miss": inputs.astray,
            "the team does not throw": inputs.alone,
            "the policy did not release in time": self._is_late(time),
        }
        reason = next((text for text, holds in reasons.items() if holds), "")
        if reason:
            self._go(time, State.RECOVER, reason)

    def _recover(self, time: float, inputs: Inputs) -> None:
        if inputs.fence is not None:  # the payload is off and the vehicle brakes: no more throws
            self.left_fence = inputs.fence
            self._go(time, State.LAND, f"after the throw, fence: {inputs.fence}")
        # A stale pose does not move, even if the vehicle does.
        elif self._has_lasted(time, inputs.calm and inputs.vehicle < HOLD, self.params.quiet):
            state = State.READY if self.throws < self.max_throws else State.LAND
            self._go(time, state, "hovering again")
        elif inputs.land or self._is_late(time):
            self._go_land(time, inputs, "not calm again in time")

    def _land(self, time: float, inputs: Inputs) -> None:
        if inputs.grounded or self._is_late(time):
            self._go(time, State.DONE, "landed" if inputs.grounded else "landing took too long")


_STEPS = {
    State.IDLE: Machine._idle,
    State.CHECK: Machine._check,
    State.READY: Machine._ready,
    State.ARMED: Machine._armed,
    State.THROW: Machine._throw,
    State.RECOVER: Machine._recover,
    State.LAND: Machine._land,
}
"""Step function of each state. Method names assembled at each tick would fill Python's attribute
cache.
"""


@dataclass(frozen=True)
class OperatorInput:
    """The operator's commands since the last tick."""

    arm: bool = False
    land: bool = False
    abort: bool = False
    why: str = ""  # reason of an abort by a signal or by the end of the run's time


@dataclass
class TickRecord:
    """The inputs and decisions of one tick, in plain values as they are recorded."""

    time: float
    state: str
    reason: str
    command: Command | None = None  # as sent [N, rad/s]
    action: list[float] | None = None  # of the policy, normalised
    observation: list[float] | None = None
    keypoints: list | None = None
    valid: list | None = None
    release: bool = False  # the policy's release was executed
    note: str = ""
    waits: str = ""  # what the state waits for
    ready: int = 0  # what the vehicle is ready for, as sent to the team; see `hil.links.team_link`
    agreed: int | None = None  # what the team agreed on for this tick; None without a team
    # from the camera's newest frame since the last tick; see `hil.poses.detection.Detection`
    detection: list | None = None
    # result that arrived with this tick, or why there is none; see `visthrow.onboard.calibration`
    calibration: dict | str | None = None

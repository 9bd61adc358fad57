"""State machine of a run: what stale poses, fences, time-outs and a silent autopilot lead to; pure
logic.

    idle -> check -> ready -> armed -> throw -> recover -> ready (more throws) or land -> done
    any -> abort -> done

``idle`` waits for poses and the autopilot, ``check`` for the checks to hold for a while. From
``ready`` on the runner commands: its hover controller holds the vehicle. Each throw needs its own
word of the operator."""

from dataclasses import dataclass
from enum import StrEnum

from hil.poses.gate import ABORT, HOLD
from visthrow.config.bounds import Bounded, Positive


class State(StrEnum):
    """The state of a run."""

    IDLE = "idle"
    CHECK = "check"
    READY = "ready"
    ARMED = "armed"
    THROW = "throw"
    RECOVER = "recover"
    LAND = "land"
    ABORT = "abort"
    DONE = "done"


FLYING = (
    State.READY,
    State.ARMED,
    State.THROW,
    State.RECOVER,
    State.LAND,
)  # states in which the runner commands the vehicle


@dataclass(frozen=True)
class StateParams(Bounded):
    """Time-outs and durations [s]."""

    idle: Positive  # for poses and autopilot to appear; then abort
    check: Positive  # for the checks to pass; then abort
    check_hold: Positive  # for which all checks must hold
    ready: Positive  # for the operator; then land
    armed: Positive  # for the swing to become quiet; then back to ready, not armed
    armed_least: Positive  # in armed before the throw
    quiet: Positive  # for which vehicle and payload must be quiet
    throw: Positive  # for the policy to release; then recover with the payload
    recover: Positive  # for the hover to become quiet again; then land
    land: Positive  # for the descent; then done
    abort: Positive  # after which an aborted run ends


@dataclass(frozen=True)
class Inputs:
    """The inputs of one tick. Levels are those of `hil.poses.gate`."""

    vehicle: int
    payload: int
    connected: bool = True  # the autopilot is there, in the mode and armed as it must be
    failed_checks: tuple[str, ...] = ()
    fence: str | None = None  # which fence is broken
    still: bool = False  # vehicle at home and vehicle and payload slow
    separated: bool = False  # latch plus trained lag has passed in this throw
    released: bool = False  # the latch has tripped in this throw
    lost: bool = False  # the payload has come off by itself
    astray: bool = False  # releases that were asked for were held back, and nothing better came
    grounded: bool = False  # the descent has arrived
    failure: str | None = None  # of policy, guard, release or of the runner itself
    arm: bool = False  # the operator's words
    land: bool = False
    abort: bool = False
    recording: bool = True  # all could be recorded so far
    following: bool = True  # the autopilot follows commands
    note: str = ""  # of the autopilot: what is wrong, or what it waits for
    why: str = ""  # of the abort, where it was no word
    streams: tuple[str, ...] = ()  # what is wrong with how the poses come, before the take-over
    disagrees: str | None = None  # how the first hover is not the policy's vehicle's

    def missing(self) -> list[str]:
        """Return what has to be there before anything is checked, and is not."""
        texts = [
            f"no fresh pose of the {n}"
            for n, level in (("vehicle", self.vehicle), ("payload", self.payload))
            if level >= HOLD
        ]
        return (
            texts
            if self.connected
            else [*texts, "autopilot not ready" + (f" ({self.note})" if self.note else "")]
        )


class Machine:
    """The state, since when, and why.

    Attributes:
        state: now. reason: of the last change. since: time of it [s].
        throws: throws begun. cancelled: throws that ended without a release.
        flown: whether this run has ever commanded the vehicle. aborted: whether it was ended by an
            abort.
        handed_back: whether the vehicle went back to the autopilot's own hold, or to the pilot.
        left_fence: how the vehicle left its fence after a throw; that ends the run by a landing,
            and is no abort.
    """

    def __init__(
        self, params: StateParams, throws: int, patient: bool = False, sends: bool = True
    ) -> None:
        """Begin in idle.

        Args:
            params: times. throws: after which it lands.
            patient: idle and check may last for ever, as where poses are only looked at.
            sends: whether commands go to a vehicle. Where they do not, no fence ends what others
                fly before a throw is armed.
        """
        self.params, self.most, self.patient, self.sends = params, throws, patient, sends
        self.state, self.reason = State.IDLE, "start"
        self.since: float | None = None
        self.throws = self.cancelled = 0
        self.flown = self.aborted = False
        self.left_fence: str | None = None
        self.handed_back = False
        self._held: float | None = None  # since when what must last has lasted

    def step(self, now: float, seen: Inputs) -> State:
        """Move on by one tick; returns the state to act in."""
        if self.since is None:
            self.since = now
        urgent = self._urgent(seen)
        if self.state is State.ABORT:
            # What was never ours needs no descent.
            if not self.flown or now - self.since > self.params.abort:
                self._go(now, State.DONE, self.reason)
        elif self.state is not State.DONE:
            if seen.disagrees is not None and self.state in (State.READY, State.ARMED):
                self.handed_back = True
                self._go(now, State.ABORT, f"handed back: {seen.disagrees}")
            elif urgent is not None:
                self._go(now, State.ABORT, urgent)
            else:
                _STEPS[self.state](self, now, seen)
        return self.state

    def _urgent(self, seen: Inputs) -> str | None:
        if seen.abort:
            return seen.why or "the operator said abort"
        if seen.failure is not None:
            return seen.failure
        if self.state not in FLYING:
            return None
        if seen.vehicle >= ABORT:
            return "no new pose of the vehicle"
        spectating = self.state is State.READY and not self.sends
        if (
            seen.fence is not None
            and not spectating
            and not (self.state is State.RECOVER and seen.released)
        ):
            return f"fence: {seen.fence}"
        if not seen.connected:
            return "the autopilot is silent, disarmed or in another mode" + (
                f": {seen.note}" if seen.note else ""
            )
        return None

    def _go(self, now: float, state: State, reason: str) -> None:
        if self.state is State.THROW and state is not State.THROW and reason != "separated":
            self.cancelled += 1
        self.state, self.reason, self.since, self._held = state, reason, now, None
        self.throws += state is State.THROW
        self.flown |= state in FLYING
        self.aborted |= state is State.ABORT

    def waits(self, seen: Inputs) -> str:
        """Return why it does not go on, in words; empty where nothing is in the way but time."""
        texts: list[str] = []
        if self.state in (State.IDLE, State.CHECK, State.READY, State.ARMED):
            if self.state in (State.IDLE, State.CHECK):
                texts = [*seen.missing(), *seen.streams]
            texts += seen.failed_checks if self.state is not State.IDLE else ()
        if self.state in (State.READY, State.ARMED):
            texts += [] if seen.payload < HOLD else ["no fresh pose of the payload"]
            texts += [] if seen.recording else ["the recording failed"]
            texts += (
                []
                if seen.following
                else ["it does not follow yet" + (f" ({seen.note})" if seen.note else "")]
            )
        if self.state in (State.ARMED, State.RECOVER) and not seen.still:
            texts.append("not quiet yet")
        if self.state is State.READY and not texts and not seen.arm:
            texts.append("the operator's word: arm")
        return "; ".join(texts)

    def _lasted(self, now: float, holds: bool, time: float) -> bool:
        if not holds:
            self._held = None
            return False
        if self._held is None:
            self._held = now
        return now - self._held >= time - 1e-9

    def held(self, now: float) -> float:
        """Return for how long what must last has lasted [s]."""
        return 0.0 if self._held is None else now - self._held

    def _late(self, now: float) -> bool:
        return now - self.since > getattr(self.params, self.state.value)

    def _idle(self, now: float, seen: Inputs) -> None:
        if max(seen.vehicle, seen.payload) < HOLD and seen.connected:
            self._go(now, State.CHECK, "poses and autopilot are there")
        elif self._late(now) and not self.patient:
            self._go(now, State.ABORT, f"{', '.join(seen.missing())}, for {self.params.idle:g} s")

    def _check(self, now: float, seen: Inputs) -> None:
        good = not (seen.missing() or seen.failed_checks or seen.streams)
        if self._lasted(now, good, self.params.check_hold):
            self._go(now, State.READY, "checks passed")
        elif self._late(now) and not self.patient:
            self._go(
                now, State.ABORT, f"checks: {self.waits(seen) or 'poses or autopilot come and go'}"
            )

    def _ready(self, now: float, seen: Inputs) -> None:
        if seen.land or self._late(now):
            self._go(
                now, State.LAND, "the operator said land" if seen.land else "nobody armed a throw"
            )
        elif (
            seen.arm
            and seen.following
            and seen.recording
            and not seen.failed_checks
            and seen.payload < HOLD
        ):
            self._go(now, State.ARMED, "the operator armed this throw")

    def _armed(self, now: float, seen: Inputs) -> None:
        long = now - self.since >= self.params.armed_least
        if seen.land:
            self._go(now, State.LAND, "the operator said land")
        elif max(seen.vehicle, seen.payload) >= HOLD or not (seen.recording and seen.following):
            self._go(
                now, State.READY, "disarmed: stale poses, not followed, or the recording failed"
            )
        elif self._lasted(now, seen.still and not seen.failed_checks, self.params.quiet) and long:
            self._go(now, State.THROW, "quiet")
        elif self._late(now):
            self._go(
                now,
                State.READY,
                f"disarmed: {self.waits(seen) or 'the swing did not become quiet'}",
            )

    def _throw(self, now: float, seen: Inputs) -> None:
        if seen.separated:
            self._go(now, State.RECOVER, "separated")
        elif seen.released:
            return  # what is latched cannot be taken back: fly on until it is off
        elif max(seen.vehicle, seen.payload) >= HOLD:
            self._go(now, State.RECOVER, "stale poses")
        elif seen.lost:
            self._go(now, State.RECOVER, "the payload has come off by itself")
        elif seen.astray:
            self._go(now, State.RECOVER, "the policy released where it would miss")
        elif self._late(now):
            self._go(now, State.RECOVER, "the policy did not release in time")

    def _recover(self, now: float, seen: Inputs) -> None:
        # An old pose is always quiet: what stands still there is the motion capture.
        if (
            seen.fence is not None
        ):  # it brakes as hard as it can, and what was to be done is done: no more throws
            self.left_fence = seen.fence
            self._go(now, State.LAND, f"after the throw, fence: {seen.fence}")
        elif self._lasted(now, seen.still and seen.vehicle < HOLD, self.params.quiet):
            again = self.throws < self.most
            self._go(now, State.READY if again else State.LAND, "hovering again")
        elif seen.land or self._late(now):
            self._go(
                now,
                State.LAND,
                "the operator said land" if seen.land else "not quiet again in time",
            )

    def _land(self, now: float, seen: Inputs) -> None:
        if seen.grounded or self._late(now):
            self._go(now, State.DONE, "landed" if seen.grounded else "landing took too long")


_STEPS = {
    State.IDLE: Machine._idle,
    State.CHECK: Machine._check,
    State.READY: Machine._ready,
    State.ARMED: Machine._armed,
    State.THROW: Machine._throw,
    State.RECOVER: Machine._recover,
    State.LAND: Machine._land,
}
"""By state.

A name put together at each tick would stay in Python's cache of attributes, a new one for each.
"""


@dataclass(frozen=True)
class OperatorInput:
    """Return the operator's commands since the last tick."""

    arm: bool = False
    land: bool = False
    abort: bool = False
    why: str = ""  # of the abort, where it was no word: a signal, the end of the run's time


@dataclass
class Decision:
    """All that one tick saw and decided; plain values, as they are recorded."""

    time: float
    state: str
    reason: str
    command: tuple[float, ...] | None = None  # as sent [N, rad/s]
    action: list[float] | None = None  # of the policy, normalised
    observation: list[float] | None = None
    keypoints: list | None = None
    valid: list | None = None
    release: bool = False  # the policy asked for it and it was done
    note: str = ""
    waits: str = ""  # why it does not go on
    seen: list | None = (
        None  # of a camera's newest frame since the last tick; see `hil.poses.detection.Detection`
    )
    rivals: list[str] | None = None  # for whom two senders speak, in words
    calibration: dict | str | None = (
        None  # that came with this tick, or why there is none; see `visthrow.onboard.calibration`
    )

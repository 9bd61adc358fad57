"""The runner: each tick from poses to a command.

Nothing raises past it; what goes wrong ends in the abort state.

A tick depends on its time, the poses that came, the back-end's status and the operator's words, and
on nothing else; these are recorded, so that a replay decides alike to the last bit."""

import copy
import math
import traceback
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from time import perf_counter
from typing import Any

import numpy as np

from hil.control.aim import Aim
from hil.control.calibrating import Calibrating
from hil.control.hovering import Hovering
from hil.control.latch import Latch
from hil.control.response import Response
from hil.control.safety import Guard, failed_checks, fence_broken, outside
from hil.control.states import FLYING, Decision, Inputs, Machine, OperatorInput, State
from hil.links.backends.base import FAILED, FOLLOW, LAND, PENDING, Backend, Status
from hil.links.backends.base import HOLD as HELD
from hil.params import HilParams
from hil.poses.detection import Detection, Detections
from hil.poses.gate import HOLD, Tether
from hil.poses.pose import GOAL, PAYLOAD, VEHICLE, Pose, Vector
from hil.poses.sources.images import Hint
from hil.poses.track import BodyState, Track
from visthrow.onboard.calibration import Calibration
from visthrow.onboard.hover import GRAVITY
from visthrow.onboard.pilot import Pilot, PilotOutput
from visthrow.onboard.policy import Policy

STILL_OFFSET, STILL_SPEED = 0.05, 0.25
"""Vehicle off its hover point [m], vehicle and payload speed over 0.2 s [m/s] that count as quiet:
half of what the policies were trained to start from.
"""

# before the vehicle is ours, a body that was refused or gone for this long is taken wherever it is
# [s]
REACQUIRE = 1.0

HAND_OVER_SPEED, HAND_OVER_TILT = 1.0, math.radians(20.0)
"""Below these the autopilot's own hold takes over after a throw: braking out of 60 deg is done on
poses [m/s, rad].
"""

GROUND = 0.12  # height of the vehicle that counts as landed [m]
# an aborted run without poses levels the vehicle for this long and then falls silent: the
# autopilot's failsafes act [s]
LEVEL_TIME = 0.5

# calls of the policy before it is to fly: the first records its operations, the others find code
# and data at hand
WARM_CALLS = 3
MOST_ERRORS = 100  # tracebacks that are kept
# ticks over which the thrust is taken that an autopilot hovers with by itself, and share of the
# weight below which it stands on the ground
HOVERED, STANDS = 25, 0.3


@dataclass(frozen=True)
class Seen:
    """States of the bodies at a tick, world frame; None without a good pose yet."""

    vehicle: BodyState | None
    payload: BodyState | None
    goal_w: Vector | None  # [m]

    @property
    def known(self) -> bool:
        """Whether all are there."""
        return self.vehicle is not None and self.payload is not None and self.goal_w is not None


def calm(vehicle: BodyState) -> bool:
    """Return whether a vehicle is slow and level enough to be handed over."""
    x, y, _, _ = vehicle.quat or (0.0, 0.0, 0.0, 1.0)
    return math.hypot(*vehicle.vel) < HAND_OVER_SPEED and 1.0 - 2.0 * (x * x + y * y) > math.cos(
        HAND_OVER_TILT
    )


class Runner:
    """Flies one vehicle.

    Attributes:
        machine: the state. pilot: the policy. guard: with its counts.
        calibrating: of the camera in the hover; None where none is asked for.
        tracks: by body. latch: of the release, with the landings so far.
        hovering: on poses, where no policy flies. errors: tracebacks of what was caught, each once.
        mass: of vehicle, rope and payload [kg]. alone: of the vehicle [kg].
        mount_b: where the rope hangs on the vehicle [m]. seen_goal_w: target as of the last tick
            [m].
        spent: time that parts of the last tick took [s]; those that it did not do are missing.
        inputs: what the last tick knew; None before it.
        watcher: called with each pose's body and track once it was taken; None for nobody.
    """

    def __init__(
        self, params: HilParams, policy: Policy, backend: Backend, mechanism_lag: float = 0.0
    ) -> None:
        """Build all parts; the mechanism's lag is from its command to separation [s].

        Raises MismatchError, PolicyError: the camera is not the one that the policy was trained
        with, or the policy is incomplete; RunError: the mechanism is slower than the policy was
        trained for."""
        self.params, self.backend = params, backend
        self.pilot = Pilot(policy, params.camera)
        contract = policy.contract
        rope, body, action = contract["rope"], contract["vehicle"]["body"], contract["action"]
        self.alone, self.mass = (
            body["mass"],
            body["mass"] + rope["rope_mass"] + rope["payload_mass"],
        )
        self.hang = -rope["mount"][2] + rope["length"] + rope["payload_offset"]
        height, later = (
            params.landing_height,
            (params.delay.command if params.delay.compensate else 0.0),
        )
        self.latch = Latch(
            self.pilot.lag, mechanism_lag, self.hang, params.check.rope_tolerance, height, later
        )
        self._reach = (
            math.hypot(*rope["mount"])
            + rope["length"]
            + rope["payload_offset"]
            + params.check.rope_tolerance
        )
        self.guard = Guard(
            params.guard, float(action["max_thrust"]), tuple(map(float, action["max_rate"]))
        )
        self.tracks = {
            name: Track(frames, params.gate, params.estimate, name == VEHICLE)
            for name, frames in params.frames.items()
        }
        self.machine = Machine(
            params.states, params.throws, params.observe, params.backend != "dry-run"
        )
        heading = math.radians(params.check.heading_deg)
        self.hovering = Hovering(
            params.home_w, heading, float(action["max_thrust"]), self.pilot.period
        )
        tolerance = (
            math.inf
            if params.backend == "dry-run"
            else getattr(params, params.backend).thrust.tolerance
        )
        self.response = Response(self.pilot.period, self.mass, tolerance, params.check.probe)
        self._thrusts: deque[float] = deque(maxlen=2 * HOVERED)  # of the autopilot's own hover
        self._tolerance = tolerance
        self._aged = 0.5 * sum(contract["observation"]["latency"])
        self.aim = Aim(params.aim, self._aged + self.latch.lag, height, rope)
        self._acted = State.IDLE
        self._stop_at = math.inf  # when no release of this throw is sent any more [s]
        self.errors: list[str] = []
        self.mount_b: Vector = tuple(map(float, rope["mount"]))
        self.seen_goal_w: Vector | None = None
        self.spent: dict[str, float] = {}
        self._untaken: Exception | None = None
        self.watcher: Callable[[str, Track], None] | None = None
        self.detections = (
            Detections(self.pilot.camera, params.images.hold)
            if params.keypoints == "detector"
            else None
        )
        self._detection: Detection | None = None
        wants = params.calibration is not None and self.detections is not None
        self.calibrating = (
            Calibrating(params.calibration, lambda: self.seen_goal_w) if wants else None
        )
        self._calibration: Calibration | str | None = None
        self._rivals: list[str] = []
        self.inputs: Inputs | None = None

    def tick(
        self,
        now: float,
        poses: list[Pose],
        status: Status,
        words: OperatorInput,
        recording: bool = True,
    ) -> Decision:
        """Decide one tick and send its command.

        Args:
            now: on the runner's clock [s]. poses: raw, that have come since the last tick. status:
                of the back-end, at this tick.
            words: of the operator. recording: whether all was recorded so far.
        """
        self.spent = {}
        try:
            return self._tick(now, poses, status, words, recording)
        except Exception as error:  # in flight nothing raises past the runner
            return self.fail(now, error)

    def fail(self, now: float, error: BaseException) -> Decision:
        """End the run because of an exception: abort, and no further release.

        The autopilot is asked to land, tick by tick.
        """
        trace = "".join(traceback.format_exception(error))
        if (
            isinstance(error, Exception)
            and trace not in self.errors
            and len(self.errors) < MOST_ERRORS
        ):
            self.errors.append(trace)
        what = (
            "Ctrl-C twice"
            if isinstance(error, KeyboardInterrupt)
            else f"{type(error).__name__}: {error}"
        )
        self.machine.step(now, Inputs(3, 3, failure=what))
        self.backend.stop_release()
        if self.machine.flown:
            self.backend.abort(now)
        return Decision(now, self.machine.state.value, self.machine.reason, note="exception")

    @property
    def in_flight(self) -> bool:
        """Whether the vehicle is ours and the run is not over."""
        return self.machine.flown and self.machine.state is not State.DONE

    def warm_up(self, vehicle: BodyState | None = None) -> None:
        """Call the policy a few times on a copy, so that the first calls of a throw find code and
        data at hand.
        """
        pilot, pos = (
            copy.copy(self.pilot),
            np.array([self.params.home_w if vehicle is None else vehicle.pos]),
        )
        zero, goal_w = np.zeros((1, 3)), np.array(self.params.goal_w)
        for _ in range(WARM_CALLS):
            pilot.act(
                pos,
                np.array([[0.0, 0.0, 0.0, 1.0]]),
                zero,
                zero,
                pos - [0.0, 0.0, self.hang],
                goal_w,
            )

    def hear(self, rivals: list[str]) -> None:
        """Take in, before a tick, for whom two senders speak; see `hil.links.roster.Roster`."""
        self._rivals = rivals

    def look(self, detections: list[Detection]) -> None:
        """Take in what a camera saw since the last tick; of several frames the newest counts."""
        if detections:
            self._detection = detections[-1]

    def hint(self, now: float) -> Hint | None:
        """Return what a detector is told before it looks: vehicle and, while the payload hangs, how
        far off it can be.
        """
        vehicle = self.tracks[VEHICLE].state(now)
        if vehicle is None or vehicle.quat is None or self.tracks[VEHICLE].gate.level(now) >= HOLD:
            return None
        hangs = self.latch.at is None
        return Hint(
            vehicle.pos, vehicle.quat, (0.5 * self.hang, 1.4 * self.hang) if hangs else None
        )

    def take(self, poses: list[Pose]) -> None:
        """Take in poses before the tick that they belong to, so that it has less to do, and decides
        as with all of them: what goes wrong here comes up there.
        """
        try:
            if self._untaken is None:
                self._take(poses)
                for track in self.tracks.values():
                    track.settle()
        except Exception as error:  # as in tick
            self._untaken = error

    def _take(self, poses: list[Pose]) -> None:
        for pose in poses:
            track = self.tracks.get(pose.body)
            took = track is not None and track.update(pose, self._tether(pose)) is None
            if took and self.watcher is not None:
                self.watcher(pose.body, track)
            if took and pose.body == PAYLOAD:
                self.latch.follow(
                    pose.arrival - pose.transit(self.params.delay.source), track.gate.last.pos
                )

    def _tick(
        self, now: float, poses: list[Pose], status: Status, words: OperatorInput, recording: bool
    ) -> Decision:
        begin = perf_counter()
        estimate = self._estimate(now, poses)
        decision, state = self._decide(now, estimate, status, words, recording)
        self.spent["estimate"] = perf_counter() - begin
        command = self._command(now, state, estimate, decision)
        if self.calibrating is not None:
            command = self._calibrated(now, state, estimate, status, command, decision)
        command = self._probed(state, status, command)
        self._ask(now, state, estimate.vehicle, status)
        if (
            self.params.observe
            and decision.action is None
            and estimate.known
            and estimate.vehicle.quat
        ):
            self._show(estimate, decision)
        decision.command = self._guarded(
            now, command if self._ours(state, status) else None, decision
        )
        self._send(now, state, decision, status, estimate, begin)
        return decision

    def _estimate(self, now: float, poses: list[Pose]) -> Seen:
        """Take poses in; where the bodies are now."""
        if self._untaken is not None:
            error, self._untaken = self._untaken, None
            raise error
        self._take(poses)
        self.latch.overdue(now)
        if self.machine.state in (State.IDLE, State.CHECK):
            for track in self.tracks.values():
                # On the ground a body may be carried about out of sight; in flight what has jumped
                # stays refused.
                if REACQUIRE < track.gate.age(now) < math.inf:
                    track.restart()
        bodies = {name: self._state(track, now) for name, track in self.tracks.items()}
        self.seen_goal_w = self._goal(bodies)
        return Seen(bodies[VEHICLE], bodies[PAYLOAD], self.seen_goal_w)

    def _decide(
        self, now: float, seen: Seen, status: Status, words: OperatorInput, recording: bool
    ) -> tuple[Decision, State]:
        """Move the state machine on, and do what a change of state brings with it."""
        self.inputs = inputs = self._inputs(now, seen, status, words, recording)
        state = self.machine.step(now, inputs)
        # The last tick may itself have ended in another state than it acted in: a command refused,
        # an exception.
        before, self._acted = self._acted, state
        if state is not before:
            self._entered(now, before, state, seen.vehicle)
        if now >= self._stop_at or state is State.ABORT:
            self.backend.stop_release()
            self._stop_at = math.inf
        decision = Decision(now, state.value, self.machine.reason, waits=self.machine.waits(inputs))
        if inputs.streams:
            decision.rivals = self._rivals or None
        detection, self._detection = self._detection, None
        if self.detections is not None and detection is not None:
            decision.seen = detection.values()
        if (
            self.detections is not None
            and seen.vehicle is not None
            and seen.vehicle.quat is not None
        ):
            self.detections.along(now, seen.vehicle.pos, seen.vehicle.quat)
            if detection is not None:
                self.detections.take(detection, seen.vehicle.quat, self._shown_age(now))
        return decision, state

    def _ours(self, state: State, status: Status) -> bool:
        """Return whether commands are sent: not to what was handed or taken over, hears nothing or
        was never ours.
        """
        if status.mode in (HELD, LAND) and state not in (State.READY, State.ARMED):
            return False
        if self.machine.handed_back:
            return False
        return state is not State.ABORT or (status.connected and self.machine.flown)

    def calibrated(self, result: Calibration | str) -> None:
        """Take in, before a tick, what the sums of a hover's calibration gave."""
        self._calibration = result

    def _calibrated(
        self,
        now: float,
        state: State,
        seen: Seen,
        status: Status,
        wanted: tuple[float, ...] | None,
        decision: Decision,
    ) -> tuple[float, ...] | None:
        """Return the command with the sway of a calibration; what came in this tick is
        taken down.
        """
        calibrating, result = self.calibrating, self._calibration
        if result is not None:
            self._calibration = None
            calibrating.take(result)
            decision.calibration = result if isinstance(result, str) else result.values()
            if isinstance(result, Calibration) and self.detections is not None:
                self.detections.correct(result)
        ours = (
            state is State.READY
            and status.mode == FOLLOW
            and seen.known
            and seen.vehicle.quat is not None
        )
        if not ours or wanted is None:
            calibrating.stop()
            return wanted
        roll, pitch = calibrating.rates(now, self._still(seen.vehicle, seen.payload, False))
        if decision.seen is not None and self.detections.fresh is not None:
            stamp, points, valid = self.detections.fresh
            calibrating.note(
                now, seen.vehicle, wanted[0], points, valid, now - self._shown_age(now) - stamp
            )
        return (wanted[0], wanted[1] + roll, wanted[2] + pitch, wanted[3])

    def _guarded(
        self, now: float, wanted: tuple[float, ...] | None, decision: Decision
    ) -> tuple[float, ...] | None:
        """Return a command within its limits; one that is not finite ends the run."""
        if wanted is None:
            self.guard.reset()
            return None
        command = self.guard.check(wanted)
        if command is None:
            self.machine.step(now, Inputs(3, 3, failure=f"command {wanted} is not finite"))
            decision.state, decision.reason = self.machine.state.value, self.machine.reason
            decision.release = False
            self.backend.stop_release()
        return command

    def _send(
        self, now: float, state: State, decision: Decision, status: Status, seen: Seen, begin: float
    ) -> None:
        """Send the command, then the release, then the request to land."""
        if decision.command is not None:
            ready = perf_counter()
            self.backend.send(decision.command, now)
            self.spent["send"] = perf_counter() - ready
            self.spent["total"] = perf_counter() - begin
        hovers = (
            state in (State.READY, State.ARMED)
            and status.mode == FOLLOW
            and decision.command is not None
        )
        self.hovering.note(decision.command[0] / (self.mass * GRAVITY) if hovers else None)
        real = self.params.backend != "dry-run"
        if hovers and real and seen.vehicle is not None and seen.vehicle.quat is not None:
            self.response.note(decision.command, seen.vehicle)
        else:
            self.response.pause()
        if decision.release:
            self.backend.release(self.latch.trip(now, seen.goal_w))
        if state is State.ABORT and self.machine.flown:
            if self.machine.handed_back:
                self.backend.surrender(now)
            else:
                self.backend.abort(now)

    def _probed(
        self, state: State, status: Status, wanted: tuple[float, ...] | None
    ) -> tuple[float, ...] | None:
        """Return the command with the doublet of the first hover that is ours."""
        ours = state in (State.READY, State.ARMED) and status.mode == FOLLOW
        if not ours or wanted is None or self.params.backend == "dry-run":
            return wanted
        added = (0.0, *self.response.rates())
        return tuple(value + more for value, more in zip(wanted, added))

    def _tether(self, pose: Pose) -> Tether | None:
        """Return the cable's other end for a pose of vehicle or payload while the payload hangs;
        None on the ground and after.
        """
        partner = {VEHICLE: PAYLOAD, PAYLOAD: VEHICLE}.get(pose.body)
        if partner is None or self.latch.at is not None or self.machine.state not in FLYING:
            return None
        pos = self.tracks[partner].expected(pose.arrival)
        fresh = self.tracks[partner].gate.level(pose.arrival) < HOLD
        return None if pos is None else Tether(pos, self._reach if fresh else math.inf)

    def _ask(self, now: float, state: State, vehicle: BodyState | None, status: Status) -> None:
        """Tell the autopilot what it is to do: follow, or hold and land by itself where it can."""
        if state in (State.READY, State.ARMED, State.THROW):
            self.backend.ask(FOLLOW, now)
            if status.mode != FOLLOW:
                self.hovering.reset()
        elif state is State.RECOVER and self.backend.holds:
            stale = vehicle is None or self.tracks[VEHICLE].gate.level(now) >= HOLD
            if stale or calm(vehicle) or status.mode == HELD:
                self.backend.ask(HELD, now)
        elif state is State.LAND and self.backend.holds:
            self.backend.ask(LAND, now)

    def _state(self, track: Track, now: float) -> BodyState | None:
        """Return the state of a body, carried forward to the age that the policy was trained with
        where the config says so.
        """
        delay, age = self.params.delay, self._age(track, now)
        lead = age - self._aged + delay.command if delay.compensate and math.isfinite(age) else 0.0
        return track.state(now, lead)

    def _age(self, track: Track, now: float) -> float:
        """Return the age of a body's last pose [s]."""
        last, source = track.gate.last, self.params.delay.source
        return track.gate.age(now) + (source if last is None else last.transit(source))

    def _shown_age(self, now: float) -> float:
        """Return the age of the vehicle's pose as the policy is shown it [s]: younger ones than it
        was trained with stay so.
        """
        age = self._age(self.tracks[VEHICLE], now)
        return min(age, self._aged) if self.params.delay.compensate else age

    def _goal(self, bodies: dict[str, BodyState | None]) -> Vector | None:
        goal = bodies.get(GOAL)
        return self.params.goal_w if GOAL not in self.tracks else None if goal is None else goal.pos

    def _inputs(
        self, now: float, seen: Seen, status: Status, words: OperatorInput, recording: bool
    ) -> Inputs:
        p, state = self.params, self.machine.state
        vehicle, payload, goal_w = seen.vehicle, seen.payload, seen.goal_w
        hanging = payload if self.latch.at is None else None
        failure = status.fault
        if status.release == FAILED and state in (State.THROW, State.RECOVER):
            failure = "the release was refused or not answered"
        checks = ["a body has no pose yet"]
        # After a throw the payload may have been hung on again; only the operator's next word makes
        # the latch new.
        if (
            seen.known
            and state is not State.THROW
            and (self.latch.at is None or state is State.READY)
        ):
            checks = failed_checks(p.check, p.fence, vehicle, payload, goal_w, p.home_w, self.hang)
            if GOAL in self.tracks and self.tracks[GOAL].gate.level(now) >= HOLD:
                checks.append("the goal's pose is stale")
            self._weigh(status)
            checks += self._thrust_off()
            if self.detections is not None and state in (State.READY, State.ARMED):
                checks += self.detections.problems(now)
                checks += self.calibrating.problems() if self.calibrating is not None else []
        # What has not been answered is not over: the payload may yet come off.
        overrun = (
            vehicle is not None
            and state in (State.ARMED, State.RECOVER)
            and status.release != PENDING
        )
        # While landing the fence's floor is left on purpose.
        fence = (
            fence_broken(p.fence, vehicle, hanging)
            if vehicle is not None and state is not State.LAND
            else None
        )
        return Inputs(
            self.tracks[VEHICLE].gate.level(now),
            self.tracks[PAYLOAD].gate.level(now),
            status.connected,
            tuple(checks),
            fence,
            overrun and self._still(vehicle, payload, status.mode == HELD),
            self.latch.separated(now),
            self.latch.at is not None,
            self.latch.at is None and not self._carries(now, vehicle, payload),
            self.aim.given_up(now),
            vehicle is not None and vehicle.pos[2] < GROUND,
            failure,
            words.arm,
            words.land,
            words.abort,
            recording,
            status.mode == FOLLOW,
            status.note,
            words.why,
            tuple(self._streams(now)) if state in (State.IDLE, State.CHECK) else (),
            self.response.problem,
        )

    def _streams(self, now: float) -> list[str]:
        """Return what is wrong with how the poses come."""
        judged = [
            f"{name}: {text}"
            for name, track in self.tracks.items()
            if name != GOAL
            for text in track.stream.problems(now)
        ]
        return judged + self._rivals

    def _weigh(self, status: Status) -> None:
        """Note the thrust that the autopilot hovers with by itself, until it is taken."""
        if status.thrust is None or self.machine.flown:
            self._thrusts.clear()
        else:
            self._thrusts.append(status.thrust / (self.mass * GRAVITY))

    def _thrust_off(self) -> list[str]:
        """Return whether hovering takes another thrust than the weight, the autopilot's own before
        it is taken, then ours: the calibration is wrong, the vehicle another, or the battery low.
        """
        ours, allowed = self.machine.flown, self._tolerance
        ratio = self.hovering.share()
        if len(self._thrusts) >= HOVERED:
            ratio = sum(self._thrusts) / len(self._thrusts)
        reasons = []
        if ratio is not None and abs(ratio - 1.0) > allowed and (ours or ratio > STANDS):
            who = "hovering takes" if ours else "its own hover takes"
            reasons.append(
                f"{who} {ratio:.2f} times the weight, within {allowed:g} of 1 expected: calibrate"
                " the thrust, or weigh the vehicle"
            )
        if ours and self.response.running and self.params.backend != "dry-run":
            reasons.append("it is being judged how it turns")
        return reasons

    def _still(self, vehicle: BodyState, payload: BodyState | None, held: bool) -> bool:
        """Return whether all is quiet, at the hover point or where the autopilot holds
        the vehicle.
        """
        if not held and math.dist(vehicle.pos, self.params.home_w) > STILL_OFFSET:
            return False
        moving = [VEHICLE] + ([PAYLOAD] if self.latch.at is None and payload is not None else [])
        return all(self.tracks[name].calm_speed() < STILL_SPEED for name in moving)

    def _entered(self, now: float, before: State, state: State, vehicle: BodyState | None) -> None:
        """Do what a change of state brings with it."""
        if before is State.THROW:
            # A fast mechanism may have to be told only after the policy's own time of separation,
            # where commands act late.
            self._stop_at = (
                self.latch.commanded
                if state is State.RECOVER and self.latch.at is not None
                else now
            )
        if state is State.ARMED:
            self.latch.rearm()
            self.backend.rearm()
            self.warm_up(vehicle)
        if state is State.THROW:
            self.pilot.start()
            self.latch.begin(now)
            self.aim.begin()
        if state in (State.READY, State.RECOVER) and before in (State.CHECK, State.THROW):
            self.hovering.hold(self.params.home_w)
        if state in (State.LAND, State.ABORT) and vehicle is not None:
            self.hovering.hold(vehicle.pos)

    def _command(
        self, now: float, state: State, seen: Seen, decision: Decision
    ) -> tuple[float, ...] | None:
        """Return what to send in a state, before the guard; None for nothing."""
        if state not in FLYING and state is not State.ABORT:
            return None
        vehicle = seen.vehicle
        mass = self.mass if self._carries(now, vehicle, seen.payload) else self.alone
        if vehicle is None or vehicle.quat is None or self.tracks[VEHICLE].gate.level(now) >= HOLD:
            if state is State.ABORT and now - self.machine.since > LEVEL_TIME:
                return None
            decision.note = "level: no fresh pose"
            return (mass * GRAVITY, 0.0, 0.0, 0.0)
        if state is State.THROW:
            return self._throw(seen, decision)
        if state in (State.LAND, State.ABORT):
            self.hovering.descend()
        return self.hovering.command(vehicle, mass)

    def _carries(self, now: float, vehicle: BodyState | None, payload: BodyState | None) -> bool:
        """Return whether the payload hangs on the vehicle, by the latch and by its own poses."""
        fresh = payload is not None and self.tracks[PAYLOAD].gate.level(now) < HOLD
        if vehicle is None:
            return self.latch.at is None
        return self.latch.hangs_still(now, vehicle.pos, payload.pos if fresh else None)

    def _throw(self, seen: Seen, decision: Decision) -> tuple[float, ...]:
        out, payload, goal_w = self._show(seen, decision), seen.payload, seen.goal_w
        if out.release[0] and self.latch.at is None:
            fence = self.params.fence
            breach = outside(payload.pos, fence.payload_low, fence.payload_high)
            wrong = (
                f"payload {breach}" if breach else self.aim.astray(decision.time, payload, goal_w)
            )
            decision.release = wrong is None
            if wrong is not None:
                decision.note = f"release refused: {wrong}"
                self.pilot.not_released()
        return tuple(map(float, out.command[0]))

    def _show(self, seen: Seen, decision: Decision) -> PilotOutput:
        """Show the policy what there is to see, and note what it makes of it."""
        vehicle, payload = seen.vehicle, seen.payload
        attached = not self.latch.separated(decision.time)
        views = [
            np.array([v])
            for v in (vehicle.pos, vehicle.quat, vehicle.vel, vehicle.rate, payload.pos)
        ]
        keypoints = None if self.detections is None else self.detections.keypoints(decision.time)
        out: PilotOutput = self.pilot.act(
            *views, np.array(seen.goal_w), attached, keypoints, decision.time
        )
        self.spent["observation"], self.spent["policy"] = self.pilot.spent
        decision.action = out.action[0].tolist()
        decision.observation = out.observation[0].tolist()
        if out.keypoints is not None:
            decision.keypoints, decision.valid = out.keypoints[0].tolist(), out.valid[0].tolist()
        return out

    def problems(self) -> list[str]:
        """Return what speaks against taking the vehicle over, as of the last tick."""
        seen = self.inputs
        if seen is None:
            return ["nothing was looked at"]
        missing = [f"no good pose of the {n}" for n, t in self.tracks.items() if not t.accepted]
        checks = seen.failed_checks if not missing else ()
        return [*(missing or seen.missing()), *seen.streams, *checks]

    def summary(self) -> dict[str, Any]:
        """Return counts of the run so far."""
        machine, found = self.machine, None if self.calibrating is None else self.calibrating.found
        bodies = {
            name: {
                "accepted": track.accepted,
                "refused": track.gate.refused,
                "filter_lag": track.filter.lag,
            }
            for name, track in self.tracks.items()
        }
        return {
            "state": machine.state.value,
            "reason": machine.reason,
            "aborted": machine.aborted,
            "throws": machine.throws,
            "cancelled": machine.cancelled,
            "latches": self.latch.count,
            "stuck": self.latch.stuck,
            "held_back": self.aim.held,
            "landings": [asdict(landing) for landing in self.latch.landings],
            "guard": {k: getattr(self.guard, k) for k in ("clipped", "slewed", "refused")},
            "bodies": bodies,
            "left_fence": machine.left_fence,
            "calibration": None if found is None else found.values(),
            "errors": self.errors,
        }

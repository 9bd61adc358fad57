"""Act: the last step of a tick, from the decided state to commands, the release included."""

import copy
import math
from time import perf_counter

import numpy as np

from hil.control.safety import Guard, box_violation
from hil.control.state_machine import FLYING, Inputs, State, TickRecord
from hil.control.tick.body_estimate import Estimate
from hil.control.tick.dead_reckoning import DeadReckoning
from hil.control.tick.flight_parts import FlightParts
from hil.links.backends.base import FOLLOW, LAND, Command, Status
from hil.links.backends.base import HOLD as HOLDING
from hil.links.team_link import NOTHING, RELEASE, THROW
from hil.poses.body_track import BodyState
from hil.poses.gate import ABORT, HOLD
from visthrow.common.rotations import tilt_and_heading
from visthrow.onboard.calibration import Calibration
from visthrow.onboard.hover import GRAVITY
from visthrow.onboard.pilot import PilotOutput

HAND_OVER_SPEED = 1.0
HAND_OVER_TILT = math.radians(20.0)
"""Speed [m/s] and tilt [rad] below which the autopilot's hold mode takes over after a throw. The
runner brakes from larger tilts, up to 60 deg, on poses.
"""

# a vehicle without poses is levelled for this long; then the autopilot holds it, or no command is
# sent and its failsafes act [s]
LEVEL_TIME = 0.5

# calls of the policy before it flies: the first compiles, the others fill the caches
WARM_CALLS = 3


def is_level(vehicle: BodyState) -> bool:
    """Return whether a vehicle is level enough for the autopilot's hold mode."""
    return vehicle.quat is None or tilt_and_heading(vehicle.quat)[0] < HAND_OVER_TILT


def can_hand_over(vehicle: BodyState) -> bool:
    """Return whether a vehicle is slow and level enough for the autopilot's hold mode."""
    return is_level(vehicle) and math.hypot(*vehicle.vel) < HAND_OVER_SPEED


class Commander:
    """Commands the vehicle, requests the autopilot's modes and releases the payload, by state.

    Attributes:
        guard: of the commands, with its counts.
        calibration: result for the next tick, or why the calibration failed.
    """

    def __init__(self, parts: FlightParts):
        """Start in idle."""
        self.parts = parts
        action = parts.pilot.policy.contract["action"]
        max_rate = tuple(map(float, action["max_rate"]))
        self.guard = Guard(parts.params.guard, float(action["max_thrust"]), max_rate)
        self.calibration: Calibration | str | None = None
        self._state: str = State.IDLE
        self._release_end = math.inf  # after which no release of this throw is sent [s]
        self._reckoning = DeadReckoning()
        self._last_command = (parts.mass * GRAVITY, 0.0, 0.0, 0.0)

    def enter(self, estimate: Estimate, state: str) -> None:
        """Prepare for a new state, and stop a release whose time is over."""
        parts = self.parts
        time = estimate.time
        previous = self._state
        if state != previous:
            self._state = state
            self._change_state(estimate, previous, state)
        if time >= self._release_end or state == State.ABORT:
            parts.backend.stop_release()
            self._release_end = math.inf

    def act(self, estimate: Estimate, status: Status, record: TickRecord, begin: float) -> None:
        """Command the vehicle, and record what was sent; ``begin``: reading of `perf_counter` at
        the tick's start.
        """
        parts = self.parts
        state = record.state
        record.ready = THROW if parts.machine.ready_to_throw else NOTHING
        command = self._choose_command(estimate, status, record)
        if parts.calibrating is not None:
            command = self._add_sway(estimate, status, command, record)
        hovers = state in (State.READY, State.ARMED) and status.mode == FOLLOW
        if hovers and command is not None and parts.response is not None:
            doublet = (0.0, *parts.response.rates())
            command = tuple(value + rate for value, rate in zip(command, doublet))
        self._ask_mode(estimate, state, status)
        observes = parts.params.observe and record.action is None
        if observes and estimate.is_complete and estimate.vehicle.quat:
            self._run_policy(estimate, record)
        record.command = self._guard(command if self._is_ours(state, status) else None, record)
        if record.command is not None:
            ready = perf_counter()
            parts.backend.send(record.command, record.time)
            self._last_command = record.command
            parts.spent["send"] = perf_counter() - ready
            parts.spent["total"] = perf_counter() - begin
        self._note_hover(estimate, record.command if hovers else None, status.rates)
        if record.release:
            parts.backend.release(parts.latch.trip(record.time, estimate.goal_w))
        if state == State.ABORT and parts.machine.flown and not self._must_level(estimate):
            end = parts.backend.surrender if parts.machine.handed_back else parts.backend.abort
            end(record.time)

    def warm_up(self, vehicle: BodyState | None = None) -> None:
        """Call a copy of the policy a few times, because the first calls are slow."""
        pilot = copy.copy(self.parts.pilot)
        params = self.parts.params
        pos = np.array([params.home_w if vehicle is None else vehicle.pos])
        level = np.array([[0.0, 0.0, 0.0, 1.0]])
        zero = np.zeros((1, 3))
        payload_w = pos - [0.0, 0.0, self.parts.hang]
        goal_w = np.array(params.goal_w)
        for _ in range(WARM_CALLS):
            pilot.act(pos, level, zero, zero, payload_w, goal_w)

    def _change_state(self, estimate: Estimate, previous: str, state: str) -> None:
        parts = self.parts
        time = estimate.time
        latch = self.parts.latch
        if previous == State.THROW:
            # If commands act late, a fast mechanism is commanded only after the separation that the
            # policy expects.
            latched = state == State.RECOVER and latch.at is not None
            self._release_end = latch.command_time if latched else time
        if state == State.ARMED:
            latch.rearm()
            parts.backend.rearm()
            self.warm_up(estimate.vehicle)
        if state == State.THROW:
            parts.pilot.start()
            latch.begin(time)
            parts.aim.begin()
        if state in (State.READY, State.RECOVER) and previous in (State.CHECK, State.THROW):
            parts.hovering.hold(parts.params.home_w)
        if state in (State.LAND, State.ABORT) and estimate.vehicle is not None:
            parts.hovering.hold(estimate.vehicle.pos)

    def _choose_command(
        self, estimate: Estimate, status: Status, record: TickRecord
    ) -> Command | None:
        """Return the command of a state, before the guard; None for no command."""
        parts = self.parts
        state = record.state
        if state not in FLYING and state != State.ABORT:
            return None
        mass = parts.mass if parts.carries_payload(estimate) else parts.vehicle_mass
        self._reckoning.update(estimate, status.rates, self._last_command, mass)
        if not estimate.is_flyable:
            if state == State.ABORT and record.time - parts.machine.since > LEVEL_TIME:
                return None
            record.note = "level: no fresh pose"
            if self._reckoning.state is None:
                return (mass * GRAVITY, 0.0, 0.0, 0.0)
            return parts.hovering.command(self._reckoning.state, mass)
        if state == State.THROW:
            return self._throw(estimate, record)
        if state in (State.LAND, State.ABORT):
            parts.hovering.descend()
        return parts.hovering.command(estimate.vehicle, mass)

    def _throw(self, estimate: Estimate, record: TickRecord) -> Command:
        """Return the policy's command, and record whether its release is executed."""
        parts = self.parts
        output = self._run_policy(estimate, record)
        record.ready = THROW if parts.latch.at is None else RELEASE
        if output.release[0] and parts.latch.at is None:
            problem = self._release_problem(estimate)
            if problem is None:
                record.ready, record.release = RELEASE, parts.agreed is None
            else:
                record.note = f"release refused: {problem}"
                parts.pilot.cancel_release()
        if parts.agreed == RELEASE and parts.latch.at is None:
            record.release = True
        return tuple(map(float, output.command[0]))

    def _release_problem(self, estimate: Estimate) -> str | None:
        """Return why the payload must not be released now, or None."""
        fence = self.parts.params.fence
        payload = estimate.payload
        violation = box_violation(payload.pos, fence.payload_low, fence.payload_high)
        if violation is not None:
            return f"payload {violation}"
        return self.parts.aim.miss(estimate.time, payload, estimate.goal_w)

    def _run_policy(self, estimate: Estimate, record: TickRecord) -> PilotOutput:
        """Run the policy on the estimate, and record its input and output."""
        parts = self.parts
        vehicle = estimate.vehicle
        time = record.time
        keypoints = None if parts.detections is None else parts.detections.keypoints(time)
        output: PilotOutput = parts.pilot.act(
            np.array([vehicle.pos]),
            np.array([vehicle.quat]),
            np.array([vehicle.vel]),
            np.array([vehicle.rate]),
            np.array([estimate.payload.pos]),
            np.array(estimate.goal_w),
            not parts.latch.has_separated(time),
            keypoints,
            time,
        )
        parts.spent["observation"], parts.spent["policy"] = parts.pilot.spent
        record.action = output.action[0].tolist()
        record.observation = output.observation[0].tolist()
        if output.keypoints is not None:
            record.keypoints = output.keypoints[0].tolist()
            record.valid = output.valid[0].tolist()
        return output

    def _add_sway(
        self, estimate: Estimate, status: Status, command: Command | None, record: TickRecord
    ) -> Command | None:
        """Return the command with the calibration's sway added, and pass this tick's data to the
        calibration.
        """
        parts = self.parts
        calibrating = self.parts.calibrating
        time = record.time
        result = self.calibration
        self.calibration = None
        if result is not None:
            calibrating.take(result)
            record.calibration = result if isinstance(result, str) else result.values()
            if isinstance(result, Calibration):
                parts.detections.correct(result)
        follows = record.state == State.READY and status.mode == FOLLOW
        if command is None or not (follows and estimate.is_complete and estimate.has_attitude):
            calibrating.stop()
            return command
        thrust, roll, pitch, yaw = command
        calm = parts.is_calm(estimate, holding=False)
        added_roll, added_pitch = calibrating.rates(time, calm, estimate.goal_w)
        if record.detection is not None and parts.detections.fresh is not None:
            stamp, points, valid = parts.detections.fresh
            age = time - estimate.shown_age - stamp
            calibrating.note(time, estimate.vehicle, thrust, points, valid, age)
        return (thrust, roll + added_roll, pitch + added_pitch, yaw)

    def _ask_mode(self, estimate: Estimate, state: str, status: Status) -> None:
        """Ask the autopilot to follow, or to hold and land by itself if it has such modes."""
        parts = self.parts
        backend = self.parts.backend
        time = estimate.time
        if state in (State.READY, State.ARMED, State.THROW):
            backend.ask(FOLLOW, time)
            if status.mode != FOLLOW:
                parts.hovering.reset()
        elif state == State.RECOVER and backend.holds:
            lost = estimate.vehicle is None or estimate.vehicle_level >= HOLD
            ready = not self._must_level(estimate) if lost else can_hand_over(estimate.vehicle)
            if ready or status.mode == HOLDING:
                backend.ask(HOLDING, time)
        elif state == State.LAND and backend.holds:
            backend.ask(LAND, time)

    def _must_level(self, estimate: Estimate) -> bool:
        """Return whether a vehicle without poses is still tilted and must be levelled first,
        because it would sink if the autopilot took it tilted.
        """
        vehicle = self._reckoning.state
        if estimate.is_flyable or vehicle is None or self._reckoning.duration > LEVEL_TIME:
            return False
        return not is_level(vehicle)

    def _is_ours(self, state: str, status: Status) -> bool:
        """Return whether commands are sent: not to a vehicle that was handed over or taken over,
        that is not connected, or that the runner never commanded.
        """
        hovers = state in (State.READY, State.ARMED)
        if self.parts.machine.handed_back or (status.mode in (HOLDING, LAND) and not hovers):
            return False
        return state != State.ABORT or (status.connected and self.parts.machine.flown)

    def _guard(self, command: Command | None, record: TickRecord) -> Command | None:
        """Return the command within its limits; a command that is not finite aborts the run."""
        if command is None:
            self.guard.reset()
            return None
        limited = self.guard.check(command)
        if limited is None:
            machine = self.parts.machine
            failure = f"command {command} is not finite"
            machine.step(record.time, Inputs(ABORT, ABORT, failure=failure))
            record.state = machine.state.value
            record.reason = machine.reason
            record.release = False
            self.parts.backend.stop_release()
        return limited

    def _note_hover(
        self, estimate: Estimate, command: Command | None, rates: tuple[float, ...] | None
    ) -> None:
        """Record a tick for the calibration of hover: the runner's command (None if the vehicle did
        not hover by it), and the body rates that the autopilot reported [rad/s].
        """
        parts = self.parts
        share = None if command is None else command[0] / (parts.mass * GRAVITY)
        parts.hovering.note(share)
        if parts.response is None:
            return
        if command is not None and estimate.has_attitude:
            parts.response.note(command, estimate.vehicle, rates)
        else:
            parts.response.pause(rates)

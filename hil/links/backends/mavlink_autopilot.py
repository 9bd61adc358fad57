"""The part of the back-ends that ArduPilot and PX4 share: heartbeat, modes, set-points, release and
parameters over one MAVLink link.

The pilot decides who flies. A mode that the runner did not request means that the pilot has taken
over: the runner stops commanding and requests nothing any more, not even in an abort."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, Any

from hil.links.backends.audit import Audit, Rule, rules_of
from hil.links.backends.base import (
    FOLLOW,
    HOLD,
    LAND,
    WAIT,
    Autopilot,
    BackendParams,
    Command,
    Release,
)
from hil.links.mavlink_link import Link, attitude_target, command_long, parameter_request
from hil.links.pymav import mav
from hil.links.roster import Announce, MavlinkId, Party
from visthrow.config.bounds import Bound, Positive

ASK_AGAIN = 0.1  # between two requests for a mode or for arming [s]
# longest wait, before another mode is requested, for a new heartbeat, which shows whether the pilot
# has taken over [s]
CONFIRMATION_TIME = 0.1
MOST_TEXTS = 1000  # texts kept

STREAM = (
    (mav.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW, 5_000),
    (mav.MAVLINK_MSG_ID_ATTITUDE_TARGET, 50_000),
    (mav.MAVLINK_MSG_ID_HEARTBEAT, 100_000),
    (mav.MAVLINK_MSG_ID_ATTITUDE, 20_000),
    (mav.MAVLINK_MSG_ID_SYS_STATUS, 500_000),
)
"""Messages requested when the autopilot connects, and their periods [us]: read-back of the
mechanism, thrust share in hover, the mode (a heartbeat at 1 Hz would show it up to a second
late), body rates, and whether it may be armed.
"""

SERVO_NEAR = 50  # tolerance within which an output counts as open [us]

HEARTBEAT = mav.MAVLink_heartbeat_message(  # ours
    mav.MAV_TYPE_ONBOARD_CONTROLLER, mav.MAV_AUTOPILOT_INVALID, 0, 0, mav.MAV_STATE_ACTIVE, 3
)

ARMED = mav.MAV_MODE_FLAG_SAFETY_ARMED
CUSTOM = mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED


@dataclass(frozen=True)
class AutopilotParams(BackendParams):
    """Settings of a vehicle with MAVLink."""

    system: MavlinkId  # MAVLink id of the vehicle
    component: MavlinkId  # of its autopilot
    heartbeat_timeout: Positive  # silence after which the autopilot counts as lost [s]
    # whether the runner takes the vehicle out of its hold mode when all is ready; else the pilot
    # hands it over by a switch
    take: bool
    arm: bool  # by the runner at the take-over: bench and software only; else the pilot arms
    audit: bool  # whether parameters are read when it connects, and a mismatch prevents the flight
    # output of SERVO_OUTPUT_RAW that drives the mechanism, from 1; 0: not read back
    servo_output: Annotated[int, Bound(0, 16)]
    servo_open_us: Annotated[
        int, Bound(500, 2500)
    ]  # value of that output with the mechanism open [us]
    # whether the motion capture's poses are sent to it; else it estimates its position by itself
    poses: bool
    parameters: dict[str, float]  # further required values


class MavlinkAutopilot(Autopilot, ABC):
    """An autopilot on a MAVLink link; subclasses define the modes and the required parameters."""

    autopilot = mav.MAV_AUTOPILOT_GENERIC
    holds = True
    params: AutopilotParams

    def __init__(
        self,
        link: Link,
        params: AutopilotParams,
        write: bool = False,
        tell: Announce = None,
    ):
        """Listen on a link, which the pose source may share; ``write``: whether to correct wrong
        parameters; ``tell``: called with the audit's table.
        """
        super().__init__()
        self.params = params
        self._target = params.system, params.component
        self._link = link
        self._write = write
        self._tell = tell
        self._heartbeat: Any = None
        self._heard = self._beat_at = self._asked_at = self._streamed = -1e9
        self._wanted: str | None = None
        self._next: str | None = None  # mode whose request waits for a heartbeat
        self._wished_at = -1e9
        self._may: set[str | None] = set()  # last confirmed role, and those requested since
        self._reached = False
        self._taken_over = False
        self._ours = False  # whether it has ever followed
        self._was_armed = False  # since the runner took the vehicle
        self._arm_refused = ""
        self._may_arm = True  # by its own checks, if it reports them
        self._kinds: dict[str, int] = {}  # of parameters, as MAV_PARAM_TYPE
        self.release_record = Release(params.release_timeout, params.servo_output > 0)
        self._servo = (  # built once: Python's attribute cache would keep each new string
            f"servo{params.servo_output}_raw"
        )
        self._begin_audit()
        self._exact = False  # whether the share comes from ATTITUDE_TARGET
        link.listen(self._hear)
        link.roster.moved.append(self._came_back)

    def _begin_audit(self) -> None:
        p = self.params
        rules = rules_of(self.name, p, servo_near=SERVO_NEAR, **self._rule_values())
        for name, value in p.parameters.items():
            rules.append(Rule(name, "by the config", (value,), write=True))
        self.audit = Audit(
            rules if p.audit else (),
            self._ask_parameter,
            self._write_parameter if self._write else None,
            self._tell,
        )

    def _came_back(self, party: Party) -> None:
        """Start again with an autopilot at another address: it may be another vehicle with the
        same ids.
        """
        if party.name == "autopilot":
            self._heartbeat = None
            self._streamed = -1e9
            self._begin_audit()

    def _rule_values(self) -> dict[str, Any]:
        """Return further values that rows of ``rules.toml`` name, beside facts and
        configuration.
        """
        return {}

    @abstractmethod
    def _role(self, mode: int) -> str | None:
        """Return FOLLOW, HOLD or LAND for a heartbeat's custom mode; None for other modes."""

    @abstractmethod
    def _mode_numbers(self, mode: str) -> tuple[float, float]:
        """Return the second and third parameter of DO_SET_MODE."""

    @abstractmethod
    def _release_command(self) -> tuple[int, tuple[float, ...]]:
        """Return the command that opens the mechanism, and its parameters."""

    def _decode(self, value: float, kind: int) -> float:
        """Return a parameter's value from the field of PARAM_VALUE."""
        return value

    def _field(self, value: float, kind: int) -> float:
        """Return the field of PARAM_SET for a value; the inverse of :meth:`_decode`."""
        return value

    def _hear(self, message: Any, arrival: float) -> None:
        handle = _HANDLERS.get(message.get_type())
        sender = message.get_srcSystem(), message.get_srcComponent()
        if sender == self._target and handle is not None:
            handle(self, message, arrival)

    def _hear_heartbeat(self, message: Any, arrival: float) -> None:
        self._heartbeat = message
        self._heard = arrival
        self._judge_mode()

    def _hear_acknowledgement(self, message: Any, arrival: float) -> None:
        result = message.result
        if message.command == self._release_command()[0]:
            if result == mav.MAV_RESULT_ACCEPTED:
                self.release_record.answer(True)
            elif result == mav.MAV_RESULT_IN_PROGRESS:
                self.release_record.answer(None)
            elif result != mav.MAV_RESULT_TEMPORARILY_REJECTED:
                self.release_record.answer(False, f"refused with result {result}")
        elif (
            message.command == mav.MAV_CMD_COMPONENT_ARM_DISARM
            and result != mav.MAV_RESULT_ACCEPTED
        ):
            self._arm_refused = f"arming refused with result {result}: {self._last_text()}"

    def _hear_text(self, message: Any, arrival: float) -> None:
        self.texts.append(str(message.text))
        del self.texts[:-MOST_TEXTS]

    def _hear_outputs(self, message: Any, arrival: float) -> None:
        value = getattr(message, self._servo, 0) if self.params.servo_output else 0
        if value:
            self.release_record.output(abs(value - self.params.servo_open_us) <= SERVO_NEAR)

    def _hear_parameter(self, message: Any, arrival: float) -> None:
        self._kinds[message.param_id] = message.param_type
        self.audit.feed(message.param_id, self._decode(message.param_value, message.param_type))

    def _hear_parameter_error(self, message: Any, arrival: float) -> None:
        self.audit.refuse(message.param_id, message.error)

    def _hear_attitude(self, message: Any, arrival: float) -> None:
        rates = (message.rollspeed, -message.pitchspeed, -message.yawspeed)
        self.rates = rates if all(map(math.isfinite, rates)) else None

    def _hear_target(self, message: Any, arrival: float) -> None:
        self.share = message.thrust
        self._exact = True

    def _hear_hud(self, message: Any, arrival: float) -> None:
        if not self._exact:  # in whole percent
            self.share = 0.01 * message.throttle

    def _hear_system(self, message: Any, arrival: float) -> None:
        if 0 < message.voltage_battery < 65535:
            self.voltage = 1e-3 * message.voltage_battery
        failed = message.onboard_control_sensors_present & ~message.onboard_control_sensors_health
        self._may_arm = not failed & mav.MAV_SYS_STATUS_PREARM_CHECK

    def _judge_mode(self) -> None:
        """Update from a heartbeat whether the mode is as requested, or somebody has taken over."""
        role = self._role(self._heartbeat.custom_mode)
        if self._wanted is None:
            return
        self._was_armed |= bool(self._heartbeat.base_mode & ARMED)
        if role == self._wanted:
            self._reached = True
            self._taken_over = False
            self._may = {role}
            self._ours |= role == FOLLOW
        elif self._reached or role not in self._may:
            self._taken_over = True

    def _last_text(self) -> str:
        return self.texts[-1] if self.texts else "no text"

    def _note(self, host_time: float) -> tuple[str, str]:
        beat = self._heartbeat
        if beat is None:
            return "no heartbeat", WAIT
        silent = host_time - self._heard
        if silent > self.params.heartbeat_timeout:
            return f"no heartbeat for {silent:.1f} s", WAIT
        if not self.audit.done:
            return "parameters are being read", WAIT
        role = self._role(beat.custom_mode)
        armed = bool(beat.base_mode & ARMED)
        mode = self._mode_text(beat.custom_mode)
        if self._wanted is None:
            return self._note_before(role, mode, armed)
        if self._taken_over:
            who = "which the runner did not ask for: pilot or failsafe has it"
            return f"in mode {mode}, {who}", WAIT
        return self._note_taken(role, armed)

    def _note_before(self, role: str | None, mode: str, armed: bool) -> tuple[str, str]:
        """Return the note of a vehicle that the runner has not taken."""
        p = self.params
        if not armed and not p.arm:
            return "disarmed", WAIT
        if not armed and not self._may_arm:
            return f"its checks before arming fail: {self._last_text()}", WAIT
        if role == FOLLOW or (p.take and role == HOLD):
            return "", role
        return f"in mode {mode}; expected {self._list_modes()}", WAIT

    def _note_taken(self, role: str | None, armed: bool) -> tuple[str, str]:
        """Return the note of a vehicle that the runner has taken."""
        p = self.params
        if not armed and self._wanted != LAND:  # after landing it disarms itself
            arms = p.arm and not self._was_armed and not self._arm_refused
            return "" if arms else self._arm_refused or "disarmed", WAIT
        spools_up = p.arm and self._exact and not self.share
        if role is None or (spools_up and role == FOLLOW):
            return "", WAIT
        return "", role

    def _flies_itself(self) -> bool:
        beat = self._heartbeat
        return self._wanted is None and beat is not None and bool(beat.base_mode & ARMED)

    def _mode_text(self, mode: int) -> str:
        return str(mode)

    @abstractmethod
    def _list_modes(self) -> str:
        """Return a text of the modes in which the take-over may begin."""

    def send(self, command: Command, host_time: float) -> bool:
        thrust, x, y, z = command
        share = self.params.thrust.share(thrust, self.voltage)
        return self._link.send(attitude_target(host_time, self._target, share, (x, -y, -z)))

    def ask(self, mode: str, host_time: float) -> None:
        """Request a mode, until a heartbeat confirms it."""
        if mode != self._wanted:
            if not self._confirms(mode, host_time):
                return
            first = self._wanted is None and self._heartbeat is not None
            if first:  # the present mode is the pilot's choice
                self._may.add(self._role(self._heartbeat.custom_mode))
            self._may.add(mode)
            self._wanted = mode
            self._reached = False
            self._asked_at = -1e9
            if self._heartbeat is not None:
                self._judge_mode()
        if self._taken_over or host_time - self._asked_at < ASK_AGAIN:
            return
        beat = self._heartbeat
        if beat is None or self._role(beat.custom_mode) != mode:
            self._asked_at = host_time
            self._command(mav.MAV_CMD_DO_SET_MODE, CUSTOM, *self._mode_numbers(mode))
            self._request_heartbeat()
        elif mode == FOLLOW and self.params.arm and not beat.base_mode & ARMED:
            self._asked_at = host_time
            self._command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)

    def _confirms(self, mode: str, host_time: float) -> bool:
        """Return whether another mode may be requested: once a heartbeat has arrived since the
        first call, which would show a take-over by the pilot, or the wait for it has timed out.
        """
        if self._wanted is None:  # no mode was requested before
            return True
        if mode != self._next:
            self._next = mode
            self._wished_at = host_time
            self._request_heartbeat()
        late = host_time - self._wished_at >= CONFIRMATION_TIME
        return late or self._heard > self._wished_at

    def _request_heartbeat(self) -> None:
        self._command(mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_HEARTBEAT)

    def service(self, host_time: float) -> None:
        if host_time - self._beat_at >= 1.0:
            self._beat_at = host_time
            self._link.send(HEARTBEAT)
        if self._heartbeat is not None:
            self.audit.service(host_time)
            if host_time - self._streamed > 10.0 and self._wanted is None:
                self._streamed = host_time
                for number, period in STREAM:
                    self._command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, number, period)
        if self.release_record.due(host_time):
            number, values = self._release_command()
            self._command(number, *values, repetition=self.release_record.sends - 1)

    def abort(self, host_time: float) -> None:
        self.ask(LAND, host_time)

    def _command(self, number: int, *values: float, repetition: int = 0) -> None:
        self._link.send(command_long(self._target, number, *values, repetition=repetition))

    def _ask_parameter(self, name: str) -> None:
        self._link.send(parameter_request(self._target, name))

    def _write_parameter(self, name: str, value: float) -> None:
        kind = self._kinds.get(name, mav.MAV_PARAM_TYPE_REAL32)
        field = self._field(value, kind)
        self._link.send(mav.MAVLink_param_set_message(*self._target, name.encode(), field, kind))


_HANDLERS = {
    "HEARTBEAT": MavlinkAutopilot._hear_heartbeat,
    "COMMAND_ACK": MavlinkAutopilot._hear_acknowledgement,
    "STATUSTEXT": MavlinkAutopilot._hear_text,
    "SERVO_OUTPUT_RAW": MavlinkAutopilot._hear_outputs,
    "PARAM_VALUE": MavlinkAutopilot._hear_parameter,
    "PARAM_ERROR": MavlinkAutopilot._hear_parameter_error,
    "ATTITUDE": MavlinkAutopilot._hear_attitude,
    "ATTITUDE_TARGET": MavlinkAutopilot._hear_target,
    "VFR_HUD": MavlinkAutopilot._hear_hud,
    "SYS_STATUS": MavlinkAutopilot._hear_system,
}
"""Message -> the method that processes it; other messages are ignored."""

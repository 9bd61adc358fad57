"""The common part of the fakes of ArduPilot and PX4: commands and their answers, parameters,
TIMESYNC, heartbeats, streams.
"""

from abc import abstractmethod
from typing import Any

import numpy as np

from hil.links.backends.mavlink_autopilot import ARMED, CUSTOM
from hil.links.facts import values
from hil.links.mavlink_link import IGNORE_ATTITUDE, OUR_COMPONENT, OUR_SYSTEM
from hil.links.pymav import mav
from hil.rehearsal.fake import VEHICLE_ID, Fake

# second parameter of COMPONENT_ARM_DISARM that disarms in flight
FORCE = values("ardupilot")["force"]
OUTPUTS = 16  # of SERVO_OUTPUT_RAW
FLIES = 0.3  # height above which it counts as flying [m]
SERVO = 9  # output of the mechanism, from 1


class FakeMavlink(Fake):
    """A fake autopilot on the poses' link."""

    autopilot = mav.MAV_AUTOPILOT_GENERIC
    modes: tuple[int, ...]  # custom modes that it can be in
    usual_mode = pilots_mode = 0
    defaults: dict[str, float]  # parameters of a vehicle that is set up well
    tells_unknown = False  # by PARAM_ERROR, of a parameter that it does not have; else it is silent

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.mode = self.usual_mode if self.options.mode is None else self.options.mode
        self.parameters = {**self.defaults, **self.options.parameters}
        self._next_beat = 0.0
        # by message: time of the next one, and period [s]
        self._streams: dict[int, tuple[float, float]] = {}
        self.link.listen(self._hear)

    def _hear(self, message: Any, arrival: float) -> None:
        kind = message.get_type()
        self.heard = arrival
        if self.silent:
            return
        if kind == "SET_ATTITUDE_TARGET":
            self._set_point(message)
        elif kind == "COMMAND_LONG" and message.target_system == VEHICLE_ID[0]:
            self._command(message)
        elif kind == "TIMESYNC" and message.tc1 == 0:
            now = arrival + self.question_lag + self.options.clock_offset
            self.link.send(mav.MAVLink_timesync_message(int(now * 1e9), message.ts1))
        elif kind == "PARAM_REQUEST_READ" and message.target_system == VEHICLE_ID[0]:
            self._tell_parameter(message.param_id)
        elif kind == "PARAM_SET" and message.param_id in self.parameters:
            self.parameters[message.param_id] = self.value(message.param_value, message.param_type)
            self._tell_parameter(message.param_id)

    @property
    @abstractmethod
    def ends(self) -> tuple[int, int]:
        """Ends of the mechanism's output, closed and open [us]."""

    def beat_soon(self) -> None:
        """Send a heartbeat after a change of mode or arming, if the autopilot does so at once."""
        if self.usually_prompt if self.options.prompt is None else self.options.prompt:
            self._next_beat = 0.0

    def say(self, message: Any, delay: float) -> None:
        """Send a message after a delay [s]."""
        self.later(delay, lambda: self.link.send(message))

    def acknowledge(self, command: int, result: int, delay: float | None = None) -> None:
        """Answer a command."""
        self.say(
            mav.MAVLink_command_ack_message(command, result),
            self.options.answer_delay if delay is None else delay,
        )

    def _set_point(self, message: Any) -> None:
        thrust = (
            self.thrust_map.thrust(message.thrust)
            if np.isfinite(message.thrust)
            else message.thrust
        )
        command = (thrust, message.body_roll_rate, -message.body_pitch_rate, -message.body_yaw_rate)
        ours = message.target_system == VEHICLE_ID[0] and message.type_mask == IGNORE_ATTITUDE
        self.set_point(command, ours and self.listens())

    @abstractmethod
    def listens(self) -> bool:
        """Return whether set-points are followed now."""

    def take(self) -> None:
        self.enter(self.pilots_mode)
        self.beat_soon()

    def enter(self, mode: int) -> int:
        """Enter a custom mode; return the result of the command."""
        if mode not in self.modes:
            return mav.MAV_RESULT_DENIED
        if mode != self.mode:
            self.note_event(f"mode {self.mode_text(mode)}")
            self.mode = mode
            self.stay()
            self.forget()
            self._hover.reset()
        return mav.MAV_RESULT_ACCEPTED

    def mode_text(self, mode: int) -> str:
        """Return a custom mode as text."""
        return str(mode)

    def _command(self, message: Any) -> None:
        number = message.command
        if number == mav.MAV_CMD_DO_SET_MODE:
            self.acknowledge(number, self.enter(self.custom_mode(message)))
            self.beat_soon()
        elif number == mav.MAV_CMD_COMPONENT_ARM_DISARM:
            self._arm(message)
        elif number == mav.MAV_CMD_REQUEST_MESSAGE:
            self._next_beat = (
                0.0 if int(message.param1) == mav.MAVLINK_MSG_ID_HEARTBEAT else self._next_beat
            )
            self.acknowledge(number, mav.MAV_RESULT_ACCEPTED)
        elif number == mav.MAV_CMD_SET_MESSAGE_INTERVAL:
            self._streams[int(message.param1)] = (self.plant.time, 1e-6 * message.param2)
            self.acknowledge(number, mav.MAV_RESULT_ACCEPTED)
        elif self.is_release(message):
            self.note_release()
            if self.options.answer != "silent":
                self.witness.note_answer()
                self.answer_release(message)

    def custom_mode(self, message: Any) -> int:
        """Return the custom mode that DO_SET_MODE names."""
        return int(message.param2)

    def is_release(self, message: Any) -> bool:
        """Return whether a command opens the mechanism."""
        return (
            message.command == mav.MAV_CMD_DO_GRIPPER
            and message.param2 == mav.GRIPPER_ACTION_RELEASE
        )

    @abstractmethod
    def answer_release(self, message: Any) -> None:
        """Answer a release command and execute it, as the options state."""

    def _arm(self, message: Any) -> None:
        wanted = message.param1 == 1.0
        flying = self.plant.state["pos_w"][2] > FLIES
        if wanted and not self.options.arming:
            self.link.send(
                mav.MAVLink_statustext_message(
                    mav.MAV_SEVERITY_CRITICAL, b"Arm: battery below minimum"
                )
            )
            self.acknowledge(message.command, mav.MAV_RESULT_FAILED)
        elif not wanted and flying and message.param2 != FORCE:
            self.acknowledge(message.command, mav.MAV_RESULT_FAILED)
        else:
            self.armed = wanted
            self.note_event("armed" if wanted else "disarmed")
            self.beat_soon()
            self.acknowledge(message.command, mav.MAV_RESULT_ACCEPTED)

    def field(self, name: str) -> tuple[float, int]:
        """Return the field and type of a PARAM_VALUE."""
        return self.parameters[name], mav.MAV_PARAM_TYPE_REAL32

    def value(self, field: float, kind: int) -> float:
        """Return the value in a PARAM_SET's field."""
        return field

    def _tell_parameter(self, name: str) -> None:
        if name in self.parameters:
            field, kind = self.field(name)
            self.say(
                mav.MAVLink_param_value_message(name.encode(), field, kind, 1, 0),
                self.options.answer_delay,
            )
        elif self.tells_unknown:
            error = mav.MAVLink_param_error_message(
                *(OUR_SYSTEM, OUR_COMPONENT, name.encode(), -1), mav.MAV_PARAM_ERROR_DOES_NOT_EXIST
            )
            self.say(error, self.options.answer_delay)

    def speak(self) -> None:
        time = self.plant.time
        if time >= self._next_beat:
            self._next_beat = time + 1.0
            self._stream(mav.MAVLINK_MSG_ID_HEARTBEAT)
        for number, (due, period) in self._streams.items():
            if time >= due - 1e-9:
                self._streams[number] = (due + period, period)
                self._stream(number)

    def _stream(self, number: int) -> None:
        """Send a message of a default or requested stream."""
        boot = int(self.clock() * 1e3) & 0xFFFFFFFF
        if number == mav.MAVLINK_MSG_ID_HEARTBEAT:
            flags = CUSTOM | (ARMED if self.armed else 0)
            self.link.send(
                mav.MAVLink_heartbeat_message(
                    mav.MAV_TYPE_QUADROTOR, self.autopilot, flags, self.mode, 4, 3
                )
            )
        elif number == mav.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW:
            outputs = [0] * OUTPUTS
            outputs[SERVO - 1] = self.ends[self.moved]
            self.link.send(
                mav.MAVLink_servo_output_raw_message(
                    int(self.clock() * 1e6) & 0xFFFFFFFF, 0, *outputs
                )
            )
        elif number == mav.MAVLINK_MSG_ID_ATTITUDE:
            x, y, z = map(float, self.plant.state["rate_b"])
            self.link.send(mav.MAVLink_attitude_message(boot, 0.0, 0.0, 0.0, x, -y, -z))
        elif number == mav.MAVLINK_MSG_ID_ATTITUDE_TARGET:
            share = self.thrust_map.share(self.last_thrust)
            self.link.send(
                mav.MAVLink_attitude_target_message(
                    boot, 0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, share
                )
            )

    def report(self) -> dict[str, Any]:
        return {**super().report(), "mode": self.mode, "parameters": self.parameters}

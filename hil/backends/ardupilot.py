"""ArduPilot over MAVLink: SET_ATTITUDE_TARGET with rates and thrust, DO_GRIPPER, a mode for emergencies.

The vehicle must be in GUIDED or GUIDED_NOGPS with bit 3 of GUID_OPTIONS set (else thrust is read as a climb rate) and
ATC_ANGLE_BOOST 0 (else thrust grows with tilt). This back-end neither arms nor sets a mode before a throw: pilots do.
"""

from dataclasses import dataclass
from typing import Any

from hil.backends.base import ACCEPTED, FAILED, IDLE, PENDING, Status
from hil.link import Link, attitude_target
from hil.mavlink import mav

GUIDED, GUIDED_NOGPS, LAND = 4, 20, 9
"""Mode numbers of ArduCopter."""

REPEAT = 0.04
"""Between two sends of a release that has no answer yet [s]; answers take 1 to 3 ms."""

ARMED = mav.MAV_MODE_FLAG_SAFETY_ARMED
CUSTOM = mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED


@dataclass(frozen=True)
class ArduPilotParams:
    """The vehicle on the other side.

    Raises:
        ValueError: a number out of its range.
    """

    system: int  # MAVLink id of the vehicle
    component: int  # of its autopilot
    full_thrust: float  # collective thrust that a thrust of 1 gives, by calibration [N]
    gripper: int  # number of the gripper
    mechanism_lag: float  # from DO_GRIPPER to separation [s]
    release_timeout: float  # without a final answer the release has failed [s]
    heartbeat_timeout: float  # silence after which the autopilot counts as lost [s]
    abort_mode: int  # custom mode that an abort asks for

    def __post_init__(self) -> None:
        if min(self.full_thrust, self.release_timeout, self.heartbeat_timeout) <= 0.0 or self.mechanism_lag < 0.0:
            raise ValueError(f"ardupilot {vars(self)}: expected thrust and time-outs above 0, a lag of 0 or more")
        if not (1 <= self.system <= 255 and 0 <= self.component <= 255):
            raise ValueError(f"ardupilot system {self.system}, component {self.component}; expected 1 to 255, 0 to 255")


class ArduPilot:
    """See `hil.backends.base.Backend`."""

    name = "ardupilot"

    def __init__(self, link: Link, params: ArduPilotParams) -> None:
        """Listen to the vehicle on a link."""
        self.params, self._link = params, link
        self._heartbeat: Any = None
        self._heard = self._told = self._asked = -1e9
        self._release, self._at, self._first, self._tries = IDLE, None, 0.0, 0
        self.texts: list[str] = []
        self.servo: tuple[int, ...] = ()  # last SERVO_OUTPUT_RAW: read-back of the mechanism
        link.listen(self._hear)

    def _hear(self, message: Any, arrival: float) -> None:
        p, kind = self.params, message.get_type()
        if message.get_srcSystem() != p.system:
            return
        if kind == "HEARTBEAT" and message.get_srcComponent() == p.component:
            self._heartbeat, self._heard = message, arrival
        elif kind == "COMMAND_ACK" and message.command == mav.MAV_CMD_DO_GRIPPER:
            self._answer(message.result)
        elif kind == "TIMESYNC" and message.tc1 == 0:
            self._link.send(mav.MAVLink_timesync_message(int(arrival * 1e9), message.ts1))
        elif kind == "STATUSTEXT" and len(self.texts) < 1000:
            self.texts.append(str(message.text))
        elif kind == "SERVO_OUTPUT_RAW":
            self.servo = tuple(getattr(message, f"servo{i}_raw") for i in range(1, 9))

    def _answer(self, result: int) -> None:
        if self._release != PENDING or not self._tries:
            return
        if result == mav.MAV_RESULT_ACCEPTED:
            self._release, self._at = ACCEPTED, None
        elif result == mav.MAV_RESULT_IN_PROGRESS:
            self._at = None  # at work: not to be told again
        elif result != mav.MAV_RESULT_TEMPORARILY_REJECTED:
            self._release, self._at = FAILED, None

    def status(self, now: float) -> Status:
        """See `Backend`."""
        p, beat = self.params, self._heartbeat
        if beat is None or now - self._heard > p.heartbeat_timeout:
            note = "no heartbeat" if beat is None else f"no heartbeat for {now - self._heard:.1f} s"
        elif not beat.base_mode & ARMED:
            note = "disarmed"
        elif beat.custom_mode not in (GUIDED, GUIDED_NOGPS):
            note = f"in mode {beat.custom_mode}; expected GUIDED (4) or GUIDED_NOGPS (20)"
        else:
            return Status(True, "", self._release)
        return Status(False, note, self._release)

    def send(self, command: tuple[float, ...], now: float) -> bool:
        """See `Backend`."""
        p = self.params
        thrust, x, y, z = command
        share = min(max(thrust / p.full_thrust, 0.0), 1.0)
        return self._link.send(attitude_target(now, (p.system, p.component), share, (x, -y, -z)))

    def release(self, when: float) -> None:
        """See `Backend`."""
        if self._release == IDLE:
            self._release, self._at, self._first, self._tries = PENDING, when, when, 0

    def stop_release(self) -> None:
        """See `Backend`."""
        self._release, self._at, self._tries = IDLE, None, 0

    def service(self, now: float) -> None:
        """See `Backend`."""
        if now - self._told >= 1.0:
            self._told = now
            self._link.send(mav.MAVLink_heartbeat_message(mav.MAV_TYPE_ONBOARD_CONTROLLER, 8, 0, 0, 4, 3))
        if self._release != PENDING:
            return
        if now - self._first > self.params.release_timeout:
            self._release, self._at = FAILED, None
        elif self._at is not None and now >= self._at:
            self._command(mav.MAV_CMD_DO_GRIPPER, self._tries, self.params.gripper, mav.GRIPPER_ACTION_RELEASE)
            self._tries += 1
            self._at = now + REPEAT

    def due(self) -> float | None:
        """See `Backend`."""
        return self._at

    def abort(self, now: float) -> None:
        """See `Backend`: asks for the mode until the heartbeat shows it."""
        beat = self._heartbeat
        if now - self._asked >= 0.1 and (beat is None or beat.custom_mode != self.params.abort_mode):
            self._asked = now
            self._command(mav.MAV_CMD_DO_SET_MODE, 0, CUSTOM, self.params.abort_mode)

    def _command(self, number: int, confirmation: int, first: float, second: float) -> None:
        p = self.params
        values = (float(first), float(second), 0.0, 0.0, 0.0, 0.0, 0.0)
        again = min(confirmation, 255)
        self._link.send(mav.MAVLink_command_long_message(p.system, p.component, number, again, *values))

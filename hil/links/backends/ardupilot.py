"""ArduPilot:

SET_ATTITUDE_TARGET in GUIDED or GUIDED_NOGPS, DO_GRIPPER or DO_SET_SERVO, LOITER or BRAKE to hold,
LAND.

Without bit 3 of GUID_OPTIONS, thrust is interpreted as a climb rate. With ATC_ANGLE_BOOST, thrust
grows with tilt. DO_SET_SERVO is accepted for an output that has a function, but moves nothing. The
last set-point is flown until GUID_TIMEOUT.

A gripper closes at GRIP_GRAB and opens at GRIP_RELEASE, which is the lower value by default.

Source: `hil.links.facts`, ardupilot.toml."""

from dataclasses import dataclass
from typing import Literal

from hil.links.backends.base import FOLLOW, HOLD, LAND
from hil.links.backends.mavlink_autopilot import AutopilotParams, MavlinkAutopilot
from hil.links.facts import values
from hil.links.pymav import mav
from visthrow.common.errors import ConfigError

FACTS = values("ardupilot")
GUIDED, GUIDED_NOGPS, LOITER, BRAKE, LAND_MODE = (
    FACTS[mode] for mode in ("guided", "guided_nogps", "loiter", "brake", "land")
)
THRUST_AS_THRUST = FACTS["thrust_option"]  # bit of GUID_OPTIONS
SERVO_GRIPPER = FACTS["gripper_function"]


@dataclass(frozen=True)
class ArduPilotParams(AutopilotParams):
    """Settings of an ArduPilot vehicle."""

    follow_mode: int  # GUIDED (4) or GUIDED_NOGPS (20)
    hold_mode: int  # LOITER (5) or BRAKE (17), after the throw
    release: Literal["gripper", "servo"]  # DO_GRIPPER, or DO_SET_SERVO on servo_output
    gripper: int  # number of the gripper

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.follow_mode not in (GUIDED, GUIDED_NOGPS) or self.hold_mode not in (LOITER, BRAKE):
            raise ConfigError(
                f"follow_mode {self.follow_mode}, hold_mode {self.hold_mode}; expected GUIDED (4)"
                " or GUIDED_NOGPS (20), and LOITER (5) or BRAKE (17)"
            )
        if self.release == "servo" and not self.servo_output:
            raise ConfigError(
                "release 'servo' with servo_output 0; expected the output that drives the mechanism"
            )


class ArduPilot(MavlinkAutopilot):
    """The back-end of an ArduCopter."""

    name = "ardupilot"
    autopilot = mav.MAV_AUTOPILOT_ARDUPILOTMEGA
    params: ArduPilotParams

    def _role(self, mode: int) -> str | None:
        if mode in (GUIDED, GUIDED_NOGPS):
            return FOLLOW
        return {self.params.hold_mode: HOLD, LAND_MODE: LAND}.get(mode)

    def _mode_numbers(self, mode: str) -> tuple[float, float]:
        p = self.params
        return {FOLLOW: p.follow_mode, HOLD: p.hold_mode, LAND: LAND_MODE}[mode], 0.0

    def _list_modes(self) -> str:
        return "GUIDED (4) or GUIDED_NOGPS (20)" + (
            f", or {self.params.hold_mode} to take it" if self.params.take else ""
        )

    def _release_command(self) -> tuple[int, tuple[float, ...]]:
        p = self.params
        if p.release == "servo":
            return mav.MAV_CMD_DO_SET_SERVO, (p.servo_output, p.servo_open_us)
        return mav.MAV_CMD_DO_GRIPPER, (p.gripper, mav.GRIPPER_ACTION_RELEASE)

"""PX4:

SET_ATTITUDE_TARGET in OFFBOARD, DO_GRIPPER or DO_SET_ACTUATOR, Hold (AUTO.LOITER), Land
(AUTO.LAND).

PX4 leaves OFFBOARD when set-points stop for COM_OF_LOSS_T. Up to version 1.17 it refuses OFFBOARD
until they have arrived for a second, so the runner streams them before it requests the mode.
DO_GRIPPER is answered IN_PROGRESS first, and ACCEPTED after PD_GRIPPER_TO even if nothing moves:
only the read-back of the output shows a movement. A gripper opens at the minimum of its output.
Integer parameters are sent as bytes in a float field.

Source: `hil.links.facts`, px4.toml."""

import struct
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from hil.links.backends.base import FOLLOW, HOLD, LAND, Command
from hil.links.backends.mavlink_autopilot import AutopilotParams, MavlinkAutopilot
from hil.links.facts import values
from hil.links.pymav import mav
from visthrow.config.bounds import Bound

FACTS = values("px4")
# main modes, bits 16 to 23 of a heartbeat's custom mode, and sub-modes of AUTO, bits 24 to 31
MAIN_POSCTL = FACTS["posctl"]
MAIN_AUTO = FACTS["auto"]
MAIN_OFFBOARD = FACTS["offboard"]
AUTO_LOITER = FACTS["auto_loiter"]
AUTO_LAND = FACTS["auto_land"]
# set-points are streamed for STREAM_FIRST before OFFBOARD is requested; a pause above STREAM_GAP
# restarts that [s]
MARGIN = 0.2  # beyond what PX4 requires [s]
GAP = 0.6  # share of the longest pause that PX4 accepts
STREAM_FIRST = FACTS["stream_first"] + MARGIN
STREAM_GAP = GAP / FACTS["stream_hz"]


@dataclass(frozen=True)
class Px4Params(AutopilotParams):
    """Settings of a PX4 vehicle."""

    # mode after the throw: Hold (AUTO.LOITER), or Position with the pilot's sticks
    hold: Literal["hold", "position"]
    release: Literal["gripper", "actuator"]  # DO_GRIPPER or DO_SET_ACTUATOR
    # number of the gripper, or of the actuator set from 1 to 6
    gripper: Annotated[int, Bound(1, 6)]
    actuator_open: Annotated[float, Bound(-1.0, 1.0)]  # value of DO_SET_ACTUATOR that opens
    # parameter with the function of the mechanism's output, such as PWM_AUX_FUNC1; "": not read
    output_parameter: str


class Px4(MavlinkAutopilot):
    """The back-end of a PX4 multicopter."""

    name = "px4"
    autopilot = mav.MAV_AUTOPILOT_PX4
    params: Px4Params
    _stream_since = _sent_at = -1e9

    def _role(self, mode: int) -> str | None:
        main, sub = modes_of(mode)
        if main == MAIN_OFFBOARD:
            return FOLLOW
        if main == MAIN_POSCTL and (self.params.hold == "position" or not self._ours):
            return HOLD  # by the pilot: before the take-over, or after handing back
        return {AUTO_LOITER: HOLD, AUTO_LAND: LAND}.get(sub) if main == MAIN_AUTO else None

    def _mode_text(self, mode: int) -> str:
        return "{}.{}".format(*modes_of(mode))

    def _mode_numbers(self, mode: str) -> tuple[float, float]:
        hold = (MAIN_AUTO, AUTO_LOITER) if self.params.hold == "hold" else (MAIN_POSCTL, 0)
        return {FOLLOW: (MAIN_OFFBOARD, 0), HOLD: hold, LAND: (MAIN_AUTO, AUTO_LAND)}[mode]

    def _list_modes(self) -> str:
        return "OFFBOARD (6.0)" + (
            ", or Hold (4.3) or Position (3.0) to take it" if self.params.take else ""
        )

    def send(self, command: Command, host_time: float) -> bool:
        if host_time - self._sent_at > STREAM_GAP:
            self._stream_since = host_time
        self._sent_at = host_time
        return super().send(command, host_time)

    def ask(self, mode: str, host_time: float) -> None:
        """Request a mode; OFFBOARD only after set-points were streamed."""
        streamed = (
            host_time - self._stream_since >= STREAM_FIRST
            and host_time - self._sent_at <= STREAM_GAP
        )
        if mode != FOLLOW or streamed:
            super().ask(mode, host_time)

    def _release_command(self) -> tuple[int, tuple[float, ...]]:
        p = self.params
        if p.release == "gripper":
            return mav.MAV_CMD_DO_GRIPPER, (p.gripper, mav.GRIPPER_ACTION_RELEASE)
        nan = float("nan")  # leaves the other actuators of the set alone
        values = [nan] * FACTS["actuators"]
        values[p.gripper - 1] = p.actuator_open
        return mav.MAV_CMD_DO_SET_ACTUATOR, (*values, 0.0)

    def _decode(self, value: float, kind: int) -> float:
        return parameter_value(value, kind)

    def _field(self, value: float, kind: int) -> float:
        return integer_to_bytes(value) if kind == mav.MAV_PARAM_TYPE_INT32 else value

    def _rule_values(self) -> dict[str, Any]:
        p = self.params
        gripper = p.release == "gripper"
        actuator = FACTS["actuator_function"] + p.gripper - 1
        opens = FACTS["gripper_open"] if gripper else p.actuator_open
        end = {-1.0: "MIN", 1.0: "MAX"}.get(opens)
        is_read = p.servo_output and end is not None and "FUNC" in p.output_parameter
        return {
            "position_bits": FACTS["vision_horizontal"] | FACTS["vision_vertical"],
            "output_function": FACTS["gripper_function"] if gripper else actuator,
            "open_end": p.output_parameter.replace("FUNC", end) if is_read else "",
        }


def modes_of(custom: int) -> tuple[int, int]:
    """Return main mode and sub-mode of a heartbeat's custom mode."""
    _, main, sub = struct.unpack(FACTS["mode_layout"], struct.pack("<I", custom))
    return main, sub


def parameter_value(field: float, kind: int) -> float:
    """Return a parameter's value from the field of PARAM_VALUE and its MAV_PARAM_TYPE."""
    return bytes_to_integer(field) if kind == mav.MAV_PARAM_TYPE_INT32 else field


def bytes_to_integer(value: float) -> float:
    """Return the integer whose bytes PX4 wrote into a float field."""
    return float(struct.unpack("<i", struct.pack("<f", value))[0])


def integer_to_bytes(value: float) -> float:
    """Return the float field whose bytes are those of an integer."""
    return struct.unpack("<f", struct.pack("<i", int(value)))[0]

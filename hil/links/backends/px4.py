"""PX4:

SET_ATTITUDE_TARGET in OFFBOARD, DO_GRIPPER or DO_SET_ACTUATOR, Hold (AUTO.LOITER), Land
(AUTO.LAND).

OFFBOARD is refused until set-points have come for a second, and left when they cease for
COM_OF_LOSS_T; so the runner streams first and asks then. DO_GRIPPER is answered IN_PROGRESS first,
and ACCEPTED after PD_GRIPPER_TO whatever moves: the read-back of the output is what says that it
did. A gripper opens at the minimum of its output. Integer parameters travel as bytes in a float
field.

Source: docs.px4.io, Offboard Mode and Parameter Reference (COM_OF_LOSS_T, COM_OBL_RC_ACT,
EKF2_EV_CTRL, PD_GRIPPER_TO, PWM_AUX_MIN1; PD_GRIPPER_EN up to 1.16); the output functions
(Peripheral via Actuator Set 1 is 301, Gripper 430) are those of Actuator Configuration."""

import struct
from dataclasses import dataclass
from typing import Annotated, Literal

from hil.links.backends.audit import Rule, bits, equal, within
from hil.links.backends.autopilot import SERVO_NEAR, AutopilotParams, MavlinkAutopilot
from hil.links.backends.base import FOLLOW, HOLD, LAND
from hil.links.pymav import mav
from visthrow.config.bounds import Bound

MAIN_POSCTL, MAIN_AUTO, MAIN_OFFBOARD = (
    3,
    4,
    6,
)  # main modes, bits 16 to 23 of a heartbeat's custom mode
AUTO_LOITER, AUTO_LAND = 3, 6  # sub-modes of AUTO, bits 24 to 31
# set-points are streamed for this long before OFFBOARD is asked for; PX4 wants more than 1 s [s]
STREAM_FIRST = 1.2
STREAM_GAP = 0.3  # a longer pause begins the stream anew: PX4 counts on at least 2 Hz [s]
LAND_OR_HOLD = (4.0, 5.0)  # values of COM_OBL_RC_ACT: Land, Hold
POSITION_BITS = 3  # bits of EKF2_EV_CTRL: horizontal and vertical position


@dataclass(frozen=True)
class Px4Params(AutopilotParams):
    """The vehicle on the other side."""

    hold: Literal[
        "hold", "position"
    ]  # who holds after the throw: Hold (AUTO.LOITER), or Position with the pilot's sticks
    release: Literal["gripper", "actuator"]  # DO_GRIPPER or DO_SET_ACTUATOR
    gripper: Annotated[
        int, Bound(1, 6)
    ]  # number of the gripper, or of the actuator set from 1 to 6
    actuator_open: Annotated[float, Bound(-1.0, 1.0)]  # value of DO_SET_ACTUATOR that opens
    # that says what drives the mechanism's output, such as PWM_AUX_FUNC1; "" to leave it unread
    output_parameter: str


class Px4(MavlinkAutopilot):
    """A PX4 multicopter."""

    name, autopilot = "px4", mav.MAV_AUTOPILOT_PX4
    params: Px4Params
    _stream_since = _sent_at = -1e9

    def _role(self, mode: int) -> str | None:
        main, sub = mode >> 16 & 255, mode >> 24 & 255
        if main == MAIN_OFFBOARD:
            return FOLLOW
        if main == MAIN_POSCTL and (self.params.hold == "position" or not self._ours):
            return HOLD  # the pilot holds it by hand: until it is taken, or when it is given back
        return {AUTO_LOITER: HOLD, AUTO_LAND: LAND}.get(sub) if main == MAIN_AUTO else None

    def _mode_text(self, mode: int) -> str:
        return f"{mode >> 16 & 255}.{mode >> 24 & 255}"

    def _mode_numbers(self, mode: str) -> tuple[float, float]:
        hold = (MAIN_AUTO, AUTO_LOITER) if self.params.hold == "hold" else (MAIN_POSCTL, 0)
        return {FOLLOW: (MAIN_OFFBOARD, 0), HOLD: hold, LAND: (MAIN_AUTO, AUTO_LAND)}[mode]

    def _expected_modes(self) -> str:
        return "OFFBOARD (6.0)" + (
            ", or Hold (4.3) or Position (3.0) to take it" if self.params.take else ""
        )

    def send(self, command: tuple[float, ...], now: float) -> bool:
        if now - self._sent_at > STREAM_GAP:
            self._stream_since = now
        self._sent_at = now
        return super().send(command, now)

    def ask(self, mode: str, now: float) -> None:
        """Ask for a mode; for OFFBOARD set-points are streamed first."""
        streamed = now - self._stream_since >= STREAM_FIRST and now - self._sent_at <= STREAM_GAP
        if mode != FOLLOW or streamed:
            super().ask(mode, now)

    def _release_command(self) -> tuple[int, tuple[float, ...]]:
        p = self.params
        if p.release == "gripper":
            return mav.MAV_CMD_DO_GRIPPER, (p.gripper, mav.GRIPPER_ACTION_RELEASE)
        nan = float("nan")  # leaves the other actuators of the set alone
        values = [nan] * 6
        values[p.gripper - 1] = p.actuator_open
        return mav.MAV_CMD_DO_SET_ACTUATOR, (*values, 0.0)

    def _stored(self, value: float, kind: int) -> float:
        return parameter_value(value, kind)

    def _field(self, value: float, kind: int) -> float:
        return integer_to_bytes(value) if kind == mav.MAV_PARAM_TYPE_INT32 else value

    def _rules(self) -> list[Rule]:
        p = self.params
        rules = [
            within(
                "COM_OF_LOSS_T",
                0.0,
                1.0,
                0.5,
                "so long the last rates are flown when the runner is gone [s]",
            ),
            Rule(
                "COM_OBL_RC_ACT",
                "4 (Land) or 5 (Hold)",
                "what follows when the runner is gone",
                lambda v: v in LAND_OR_HOLD,
                lambda _: LAND_OR_HOLD[0],
            ),
            bits(
                "EKF2_EV_CTRL", POSITION_BITS, "holding after the throw needs an external position"
            ),
        ]
        if p.release == "gripper":
            rules += [
                Rule(
                    "PD_GRIPPER_EN",
                    "1, or none since 1.17",
                    "DO_GRIPPER is not answered without it",
                    lambda v: v == 1.0,
                    lambda _: 1.0,
                    optional=True,
                ),
                Rule(
                    "PD_GRIPPER_TO",
                    f"below {p.release_timeout:g}",
                    "ACCEPTED comes so late [s]",
                    lambda v: v < p.release_timeout,
                    optional=True,
                ),
            ]
        if p.output_parameter:
            function = 430.0 if p.release == "gripper" else 300.0 + p.gripper
            rules.append(
                equal(
                    p.output_parameter,
                    function,
                    "what drives the output that the mechanism hangs on",
                )
            )
        open_end = {-1.0: "MIN", 1.0: "MAX"}.get(
            -1.0 if p.release == "gripper" else p.actuator_open
        )
        if p.servo_output and open_end is not None and "FUNC" in p.output_parameter:
            name, why = (
                p.output_parameter.replace("FUNC", open_end),
                "the output with the mechanism open, which is read back [us]",
            )
            rules.append(
                Rule(
                    name,
                    f"{p.servo_open_us} (servo_open_us)",
                    why,
                    lambda v: abs(v - p.servo_open_us) <= SERVO_NEAR,
                )
            )
        return rules


def parameter_value(field: float, kind: int) -> float:
    """Return a parameter's value out of a PARAM_VALUE's field, by its MAV_PARAM_TYPE."""
    return bytes_to_integer(field) if kind == mav.MAV_PARAM_TYPE_INT32 else field


def bytes_to_integer(value: float) -> float:
    """Return the integer whose bytes stand in a float field, as PX4 writes them."""
    return float(struct.unpack("<i", struct.pack("<f", value))[0])


def integer_to_bytes(value: float) -> float:
    """Return the float field whose bytes are those of an integer."""
    return struct.unpack("<f", struct.pack("<i", int(value)))[0]

"""A fake PX4.

OFFBOARD is refused until set-points have come for a second without a gap, and left for the mode of
COM_OBL_RC_ACT when they cease for COM_OF_LOSS_T; DO_GRIPPER is answered IN_PROGRESS, and ACCEPTED
after PD_GRIPPER_TO, whether anything moves or not; the gripper opens to its output's minimum; there
is no PD_GRIPPER_EN since 1.17; integer parameters travel as bytes. Out of OFFBOARD set-points are
ignored without a message. Its heartbeat comes once a second and with no change of mode. Until it is
taken the pilot holds it in Position mode."""

from typing import Any

import numpy as np

from hil.links.backends import px4
from hil.links.backends.thrust_curve import HoverThrustParams
from hil.links.pymav import mav
from hil.rehearsal.fake_mavlink import FakeMavlink

FACTS = px4.FACTS
# set-points before OFFBOARD, and the longest gap in them [s]
STREAM_FIRST, STREAM_GAP = FACTS["stream_first"], 1.0 / FACTS["stream_hz"]

INTEGERS = ("COM_OBL_RC_ACT", "EKF2_EV_CTRL", "PWM_AUX_FUNC1", "PWM_AUX_MIN1", "PWM_AUX_MAX1")


def custom(main: int, sub: int = 0) -> int:
    """Return the custom mode of a heartbeat."""
    return main << 16 | sub << 24


OFFBOARD, POSCTL = custom(px4.MAIN_OFFBOARD), custom(px4.MAIN_POSCTL)
HOLD, LAND = custom(px4.MAIN_AUTO, px4.AUTO_LOITER), custom(px4.MAIN_AUTO, px4.AUTO_LAND)


class FakePx4(FakeMavlink):
    """See the head of this module."""

    autopilot = mav.MAV_AUTOPILOT_PX4
    modes = (OFFBOARD, HOLD, LAND, POSCTL)
    usual_mode = pilots_mode = POSCTL
    usual_delay = 0.017
    usually_prompt, tells_unknown = False, True
    thrust_map = HoverThrustParams(2.668, 0.1585, 0.8, 0.1, 0.0)
    defaults = {  # noqa: RUF012 - copied by each instance
        "COM_OF_LOSS_T": 0.5,
        "COM_OBL_RC_ACT": float(FACTS["loss_hold"]),
        "EKF2_EV_CTRL": 11.0,
        "PD_GRIPPER_TO": FACTS["gripper_answer"],
        "PWM_AUX_FUNC1": float(FACTS["gripper_function"]),
        "PWM_AUX_MIN1": float(FACTS["sim_minimum"]),
        "PWM_AUX_MAX1": float(FACTS["sim_maximum"]),
    }
    _stream_since = _last = -np.inf

    def _set_point(self, message: Any) -> None:
        time = self.plant.time
        if time - self._last > STREAM_GAP:
            self._stream_since = time
        self._last = time
        super()._set_point(message)

    def listens(self) -> bool:
        return self.armed and self.mode == OFFBOARD

    def custom_mode(self, message: Any) -> int:
        return custom(int(message.param2), int(message.param3))

    def enter(self, mode: int) -> int:
        time = self.plant.time
        streamed = time - self._stream_since > STREAM_FIRST and time - self._last <= STREAM_GAP
        if mode == OFFBOARD and not streamed:
            self.refusals.append(f"{time:.3f} s: OFFBOARD before the stream")
            return mav.MAV_RESULT_TEMPORARILY_REJECTED
        return super().enter(mode)

    def mode_text(self, mode: int) -> str:
        return f"{mode >> 16 & 255}.{mode >> 24}"

    def is_release(self, message: Any) -> bool:
        set_one = message.command == mav.MAV_CMD_DO_SET_ACTUATOR and np.isfinite(message.param1)
        return set_one or super().is_release(message)

    def answer_release(self, message: Any) -> None:
        answer, number = self.options.answer, message.command
        gripper = number == mav.MAV_CMD_DO_GRIPPER
        if answer == "denied":
            self.acknowledge(number, mav.MAV_RESULT_DENIED)
            return
        if (
            self.parameters["PWM_AUX_FUNC1"]
            == FACTS["gripper_function" if gripper else "actuator_function"]
        ):
            self.open_mechanism()
        if gripper:
            self.acknowledge(number, mav.MAV_RESULT_IN_PROGRESS)
        if answer != "in-progress":
            self.acknowledge(
                number,
                mav.MAV_RESULT_ACCEPTED,
                self.parameters["PD_GRIPPER_TO"] if gripper else None,
            )

    def field(self, name: str) -> tuple[float, int]:
        if name in INTEGERS:
            return px4.integer_to_bytes(self.parameters[name]), mav.MAV_PARAM_TYPE_INT32
        return super().field(name)

    def value(self, field: float, kind: int) -> float:
        return px4.parameter_value(field, kind)

    @property
    def ends(self) -> tuple[int, int]:
        """Ends of the mechanism's output, closed and open [us]: a gripper opens at the minimum, an
        actuator set's 1 is the maximum.
        """
        ends = int(self.parameters["PWM_AUX_MAX1"]), int(self.parameters["PWM_AUX_MIN1"])
        return ends if self.parameters["PWM_AUX_FUNC1"] == FACTS["gripper_function"] else ends[::-1]

    def compute_command(self) -> np.ndarray:
        if (
            self.mode == OFFBOARD
            and self.plant.time - self._last > self.parameters["COM_OF_LOSS_T"]
        ):
            self.note_event("left OFFBOARD: no set-points")
            self.enter(
                LAND if self.parameters["COM_OBL_RC_ACT"] == px4.FACTS["loss_land"] else HOLD
            )
            self.beat_soon()
        if self.mode == LAND:
            return self.descend()
        if self.mode == OFFBOARD and self._target is not None:
            return self._target
        return self.hold(self._place)

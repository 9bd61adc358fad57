"""A fake ArduCopter.

It follows SET_ATTITUDE_TARGET only in GUIDED or GUIDED_NOGPS, armed, for its own system id and with
a type mask of exactly 128, and silently ignores all other set-points. It accepts a NaN thrust and
falls. Without bit 3 of GUID_OPTIONS thrust is a climb rate; with ATC_ANGLE_BOOST it grows with
tilt. After GUID_TIMEOUT without set-points it levels. DO_SET_SERVO is accepted for an output that
has a function, but moves nothing. Until the first command it holds its position."""

from typing import Any

import numpy as np
from numpy import ndarray

from hil.links.backends.ardupilot import (
    BRAKE,
    FACTS,
    GUIDED,
    GUIDED_NOGPS,
    LAND_MODE,
    LOITER,
    SERVO_GRIPPER,
    THRUST_AS_THRUST,
)
from hil.links.pymav import mav
from hil.rehearsal.fake import THRUST
from hil.rehearsal.fake_mavlink import SERVO, FakeMavlink
from visthrow.common.rotations import matrix_of_quat
from visthrow.onboard.hover import GRAVITY

# to a release, where it is not accepted
ANSWERS = {"denied": mav.MAV_RESULT_DENIED, "in-progress": mav.MAV_RESULT_IN_PROGRESS}


class FakeArduPilot(FakeMavlink):
    """A fake ArduCopter; see the module's docstring."""

    autopilot = mav.MAV_AUTOPILOT_ARDUPILOTMEGA
    modes = (GUIDED, GUIDED_NOGPS, LOITER, BRAKE, LAND_MODE)
    usual_mode = GUIDED
    pilots_mode = LOITER
    thrust_map = THRUST
    defaults = {  # noqa: RUF012 - copied by each instance
        "GUID_OPTIONS": float(THRUST_AS_THRUST),
        "ATC_ANGLE_BOOST": 0.0,
        "GUID_TIMEOUT": 0.5,
        "EK3_SRC1_POSXY": float(FACTS["position_source"]),
        "GRIP_ENABLE": 1.0,
        "GRIP_TYPE": float(FACTS["gripper_servo"]),
        "GRIP_RELEASE": float(FACTS["gripper_open"]),
        f"SERVO{SERVO}_FUNCTION": float(SERVO_GRIPPER),
    }

    @property
    def ends(self) -> tuple[int, int]:
        return FACTS["gripper_closed"], int(self.parameters["GRIP_RELEASE"])

    def listens(self) -> bool:
        return self.armed and self.mode in (GUIDED, GUIDED_NOGPS)

    def is_release(self, message: Any) -> bool:
        servo = message.command == mav.MAV_CMD_DO_SET_SERVO and message.param1 == SERVO
        return servo or super().is_release(message)

    def answer_release(self, message: Any) -> None:
        servo = message.command == mav.MAV_CMD_DO_SET_SERVO
        function = self.parameters[f"SERVO{SERVO}_FUNCTION"]
        able = servo or bool(self.parameters["GRIP_ENABLE"])
        if able and function == (0.0 if servo else SERVO_GRIPPER):
            self.open_mechanism()
        result = mav.MAV_RESULT_ACCEPTED if able else mav.MAV_RESULT_FAILED
        self.acknowledge(message.command, ANSWERS.get(self.options.answer, result))

    def compute_command(self) -> ndarray:
        if self.mode == LAND_MODE:
            return self.descend()
        if self.mode not in (GUIDED, GUIDED_NOGPS) or self._target is None:
            return self.hold(self._place)
        if self.plant.time - self._last_command > self.parameters["GUID_TIMEOUT"]:
            self.note_event("levelled: no set-points")
            return np.array([self.weight(), 0.0, 0.0, 0.0])
        return self._interpret(self._target)

    def _interpret(self, target: ndarray) -> ndarray:
        """Return the set-point as interpreted with the parameters."""
        out = target.copy()
        state = self.plant.state
        if not int(self.parameters["GUID_OPTIONS"]) & THRUST_AS_THRUST:
            climb = FACTS["climb_rate"] * (2.0 * target[0] / self.plant.max_thrust - 1.0)
            out[0] = self.weight() * (
                1.0 + FACTS["climb_gain"] * (climb - state["vel_w"][2]) / GRAVITY
            )
        elif self.parameters["ATC_ANGLE_BOOST"]:
            out[0] /= max(matrix_of_quat(state["quat_wb"][None].astype(float))[0, 2, 2], 0.5)
        out[0] = min(max(out[0], 0.0), self.plant.max_thrust)
        return out

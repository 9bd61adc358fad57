"""The bridge: a ball on a rope below PX4's own simulated vehicle (SIH), and the poses of both
bodies.

PX4 flies the vehicle that its ``sihsim`` holds and tells where it is; the ball hangs below as a
point on a massless rope, is dragged along, and flies freely once the mechanism's output has moved.
The vehicle does not feel it: SIH takes no force from outside, so what a throw loses by the ball's
pull does not show. The runner speaks to PX4 by itself.

Source: docs.px4.io, Simulation-In-Hardware; MAVLink LOCAL_POSITION_NED, ATTITUDE_QUATERNION,
SERVO_OUTPUT_RAW."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hil.links.backends.px4 import Px4Params
from hil.links.mavlink_link import Link
from hil.links.pymav import mav
from hil.rehearsal.fake import Bridge, Options
from hil.rehearsal.fake_mocap import MocapParams
from visthrow.common.rotations import matrix_of_quat
from visthrow.onboard.hover import GRAVITY

STEP = 0.001  # time step of the ball [s]

STREAMS = {
    mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 0.01,
    mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 0.01,
    mav.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: 0.01,
}
"""Messages that PX4 is asked for, and their periods [s]."""

ASK_AGAIN = (
    1.0  # between two requests for a stream [s]: an answer may be lost, and PX4 may start again
)
NEAR = 50.0  # an output this near to its target has arrived [us]
FLIP = np.array([1.0, -1.0, -1.0])  # north, east, down and forward, right, down to ours


@dataclass
class HangingBall:
    """A ball on a rope below a vehicle that moves as it is told, a `WirePlant`; raises `ValueError`
    for a rope without length.
    """

    mount_b: np.ndarray  # where the rope hangs [m], shape (3,)
    length: float  # from the mount to the ball's centre [m]
    lag: float  # from the trip of the latch to separation [s]
    mass: tuple[float, float]  # with and without the ball [kg]
    max_thrust: float  # [N]
    ground: float = (
        0.04  # height of the ball's centre when it has landed, landing_height of the runs [m]
    )
    period: float = 0.005  # [s]
    home_w: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        if not self.length > 0.0:
            raise ValueError(f"rope of {self.length} m; expected a length above 0")
        self.time = 0.0
        self._pos, self._vel, self._quat, self._rate = (
            np.zeros(3),
            np.zeros(3),
            np.array([0.0, 0.0, 0.0, 1.0]),
            np.zeros(3),
        )
        self._mount: np.ndarray | None = None
        self._ball, self._speed = np.array([0.0, 0.0, -self.length]), np.zeros(3)
        self._trip: float | None = None
        self.attached = True
        self.landing: dict[str, Any] = {
            "landing_w": None,
            "landing_time": None,
            "separation_time": None,
        }

    def follow(
        self, pos_w: np.ndarray, vel_w: np.ndarray, quat_wb: np.ndarray, rate_b: np.ndarray
    ) -> None:
        """Where the vehicle is now [m], how fast [m/s], attitude xyzw and body rates [rad/s]."""
        self._pos, self._vel, self._quat, self._rate = pos_w, vel_w, quat_wb, rate_b

    def step(self, command: np.ndarray, release: bool, after: float = 0.0) -> None:
        """Advance by a period; see `WirePlant`. The command is PX4's matter."""
        mount = self._pos + matrix_of_quat(self._quat) @ self.mount_b
        if self._mount is None:
            self._ball, self._mount = mount - [0.0, 0.0, self.length], mount
        if release and self._trip is None:
            self._trip = self.time + after
        count = round(self.period / STEP)
        for k in range(count):
            self._advance(
                self._mount + (k + 1) / count * (mount - self._mount), self.time + (k + 1) * STEP
            )
        self._mount, self.time = mount, self.time + self.period

    def _advance(self, mount: np.ndarray, time: float) -> None:
        """One step of the ball: free flight, then back onto the rope where it is taut
        (position-based, after Mueller et al. 2007).
        """
        if self.landing["landing_time"] is not None:
            return
        before = self._ball
        self._speed = self._speed - [0.0, 0.0, STEP * GRAVITY]
        self._ball = before + STEP * self._speed
        if self.attached and self._trip is not None and time >= self._trip + self.lag:
            self.attached = False
            self.landing["separation_time"] = time
        if self.attached:
            off = self._ball - mount
            reach = float(np.linalg.norm(off))
            if reach > self.length:
                self._ball = mount + off * (self.length / reach)
            self._speed = (self._ball - before) / STEP
        elif self._ball[2] <= self.ground:
            share = (before[2] - self.ground) / max(before[2] - self._ball[2], 1e-9)
            landed = before + share * (self._ball - before)
            self.landing |= {
                "landing_w": landed.tolist(),
                "landing_time": time - (1.0 - share) * STEP,
            }

    @property
    def state(self) -> dict[str, np.ndarray]:
        return {
            "pos_w": self._pos,
            "quat_wb": self._quat,
            "vel_w": self._vel,
            "rate_b": self._rate,
            "payload_pos_w": self._ball,
            "attached": np.array(self.attached),
        }


class Px4Sih(Bridge):
    """See the head of this module; ``heard_of``: positions that came, ``last_output``: of the
    mechanism [us].
    """

    plant: HangingBall

    def __init__(
        self,
        plant: HangingBall,
        link: Link,
        mocap: MocapParams | None,
        seed: int,
        options: Options,
        params: Px4Params,
        autopilot: Link,
    ) -> None:
        """Listen to PX4 by a link of the bridge's own; ``params`` of the back-end say which output
        opens the mechanism.
        """
        super().__init__(plant, link, mocap, seed, options)
        self.params, self.autopilot, self.port = params, autopilot, autopilot.port
        self._pos, self._vel, self._asked = (
            np.zeros(3),
            np.zeros(3),
            dict.fromkeys(STREAMS, -np.inf),
        )
        self.heard_of, self.last_output = 0, None
        autopilot.listen(self._hear)

    def hear(self) -> None:
        super().hear()
        self.autopilot.pump(self.wall)

    def _hear(self, message: Any, arrival: float) -> None:
        if message.get_srcSystem() != self.params.system:
            return
        kind = message.get_type()
        if kind == "LOCAL_POSITION_NED":
            self.heard_of += 1
            self._pos, self._vel = (
                FLIP * (message.x, message.y, message.z),
                FLIP
                * (
                    message.vx,
                    message.vy,
                    message.vz,
                ),
            )
        elif kind == "ATTITUDE_QUATERNION" and self.heard_of:
            quat = np.array([message.q2, -message.q3, -message.q4, message.q1], dtype=float)
            rate = FLIP * (message.rollspeed, message.pitchspeed, message.yawspeed)
            self.plant.follow(self._pos, self._vel, quat / np.linalg.norm(quat), rate)
        elif kind == "SERVO_OUTPUT_RAW":
            self.last_output = getattr(message, f"servo{self.params.servo_output}_raw", 0)
            near = abs(self.last_output - self.params.servo_open_us) <= NEAR
            self.output(bool(self.params.servo_output) and near, arrival)

    def flown(self) -> np.ndarray:
        """Return nothing: PX4 flies."""
        return np.zeros(4)

    def emit(self) -> None:
        """Say nothing before PX4 has said where the vehicle is."""
        if self.heard_of:
            super().emit()
        else:
            self.speak()

    def speak(self) -> None:
        """Ask for what is not coming."""
        now = self.plant.time
        for number, period in STREAMS.items():
            if now - self._asked[number] >= ASK_AGAIN:
                self._asked[number] = now
                self.autopilot.send(
                    mav.MAVLink_command_long_message(
                        self.params.system,
                        self.params.component,
                        mav.MAV_CMD_SET_MESSAGE_INTERVAL,
                        0,
                        number,
                        1e6 * period,
                        0,
                        0,
                        0,
                        0,
                        0,
                    )
                )

    def close(self) -> None:
        super().close()
        self.autopilot.close()

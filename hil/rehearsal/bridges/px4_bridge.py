"""The bridge: a ball on a rope below PX4's own simulated vehicle (SIH), and the poses of both
bodies.

PX4 flies the vehicle that its ``sihsim`` simulates and reports the vehicle's true state; the ball
hangs below as a point on a massless rope, is dragged along, and flies freely once the mechanism's
output has moved. It exerts no force on the vehicle, because SIH accepts no external forces. PX4's
clock runs the ball, so that a busy machine slows both alike. The runner speaks to PX4 by itself.

Source: docs.px4.io, Simulation-In-Hardware; PX4-Autopilot, src/modules/mavlink/streams/
HIL_STATE_QUATERNION.hpp, src/modules/simulation/simulator_sih/sih.cpp."""

import math
import select
from collections import deque
from dataclasses import dataclass, field
from time import monotonic
from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray
from numpy.linalg import norm

from hil.links.backends.px4 import Px4Params, parameter_value
from hil.links.facts import values
from hil.links.mavlink_link import Link, command_long, parameter_request
from hil.links.pymav import mav
from hil.rehearsal.fake import Bridge
from hil.rehearsal.fake_mocap import SLACK
from visthrow.common.rotations import matrix_of_quat
from visthrow.onboard.hover import GRAVITY

STEP = 0.001  # time step of the ball [s]

STREAMS = {
    mav.MAVLINK_MSG_ID_HIL_STATE_QUATERNION: 0.004,
    mav.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: 0.004,
}
"""Messages that PX4 is asked for, and their periods [s]: SIH steps at 250 Hz."""

ORIGIN = ("SIH_LOC_LAT0", "SIH_LOC_LON0", "SIH_LOC_H0")  # of SIH's world [deg, deg, m]
ASK_AGAIN = 1.0  # between two requests for a stream or a parameter [s]: an answer may be lost
PATIENCE = 1.0  # for the next state of a PX4 that was heard [s]; then the ball goes on without it
ARRIVED = 50.0  # tolerance within which an output has reached its target [us]
FLIP = np.array([1.0, -1.0, -1.0])  # north, east, down and forward, right, down to ours

HALVING = 1.4  # a slow swing halves in this time, as below the simulator's hovering vehicle [s]
MOST_DAMPING = 0.15  # of the ball [m/s^2], so that it takes 2 % off a throw

FACTS = values("px4")
EQUATOR = FACTS["earth_radius"]
ECCENTRICITY = FACTS["earth_eccentricity"]
DEGREE = FACTS["degree_unit"]  # of a latitude on the wire [deg]
SETTLING = 0.3  # in which the place, integrated from velocities, follows the latitude's steps [s]


class Motion(NamedTuple):
    """A vehicle's motion at a time [s]: place [m], velocity [m/s], attitude xyzw, rates [rad/s]."""

    time: float
    pos: ndarray
    vel: ndarray
    quat: ndarray
    rate: ndarray


def interpolate(before: Motion, after: Motion, time: float) -> Motion:
    """Return the motion at a time between two: a cubic of places and velocities, straight lines of
    the rest.
    """
    span = after.time - before.time
    if time >= after.time or span <= 0.0:
        return after._replace(time=time)
    s = max((time - before.time) / span, 0.0)
    shift = after.pos - before.pos
    bend_0 = span * before.vel - shift
    bend_1 = span * after.vel - shift
    pos = before.pos + s * shift + s * (1.0 - s) * ((1.0 - s) * bend_0 - s * bend_1)
    sign = 1.0 if before.quat @ after.quat >= 0.0 else -1.0
    quat = (1.0 - s) * before.quat + s * sign * after.quat
    vel, rate = (
        (1.0 - s) * a + s * b for a, b in ((before.vel, after.vel), (before.rate, after.rate))
    )
    return Motion(time, pos, vel, quat / norm(quat), rate)


@dataclass
class HangingBall:
    """A ball on a rope below a vehicle whose motion is given, a `WirePlant`; raises `ValueError`
    for a rope without length.
    """

    mount_b: ndarray  # where the rope hangs [m], shape (3,)
    length: float  # from the mount to the ball's centre [m]
    lag: float  # from the trip of the latch to separation [s]
    mass: tuple[float, float]  # with and without the ball [kg]
    max_thrust: float  # [N]
    # height of the ball's centre when it has landed, landing_height of the runs [m]
    ground: float = 0.04
    period: float = 0.005  # [s]
    home_w: ndarray = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        if not self.length > 0.0:
            raise ValueError(f"rope of {self.length} m; expected a length above 0")
        self.time = 0.0
        start = Motion(0.0, np.zeros(3), np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))
        self._now = start
        self._motions = deque[Motion]()
        self._hangs = False
        self._ball = np.array([0.0, 0.0, -self.length])
        self._vel = np.zeros(3)
        self._trip: float | None = None
        self.attached = True
        self.landing: dict[str, Any] = {
            "landing_w": None,
            "landing_time": None,
            "separation_time": None,
        }

    def follow(self, motion: Motion) -> None:
        """Add the vehicle's motion at a time later than the earlier ones; at the first one the
        ball hangs below the vehicle.
        """
        self._motions.append(motion)
        if not self._hangs:
            self._hangs, self._now = True, motion._replace(time=self.time)
            self._ball = self._mount(motion) - [0.0, 0.0, self.length]

    @property
    def until(self) -> float:
        """Time up to which the vehicle's motion is known [s]."""
        return self._motions[-1].time if self._motions else -math.inf

    def step(self, command: ndarray, release: bool, after: float = 0.0) -> None:
        """Advance by a period; see `WirePlant`. The command is ignored, because PX4 flies."""
        if release and self._trip is None:
            self._trip = self.time + after
        for k in range(1, round(self.period / STEP) + 1):
            self._move(self.time + k * STEP)
        self.time += self.period

    def _move(self, time: float) -> None:
        """Advance vehicle and ball to a time."""
        while self._motions and self._motions[0].time < time - SLACK:
            self._now = self._motions.popleft()
        if self._motions:
            self._now = interpolate(self._now, self._motions[0], time)
        if self._hangs:
            self._advance(self._mount(self._now), time)

    def _mount(self, motion: Motion) -> ndarray:
        return motion.pos + matrix_of_quat(motion.quat) @ self.mount_b

    def _advance(self, mount: ndarray, time: float) -> None:
        """One step of the ball: free flight, then back onto the rope where it is taut
        (position-based, after Mueller et al. 2007).
        """
        if self.landing["landing_time"] is not None:
            return
        if self.attached and self._trip is not None and time >= self._trip + self.lag:
            self.attached = False
            self.landing["separation_time"] = time
        before = self._ball
        self._vel = self._vel - [0.0, 0.0, STEP * GRAVITY]
        if self.attached:
            self._vel = self._damp(self._vel - self._now.vel) + self._now.vel
        self._ball = before + STEP * self._vel
        if self.attached:
            off = self._ball - mount
            reach = float(norm(off))
            if reach > self.length:
                self._ball = mount + off * (self.length / reach)
            self._ball[2] = max(self._ball[2], self.ground)
            self._vel = (self._ball - before) / STEP
        elif self._ball[2] <= self.ground:
            share = (before[2] - self.ground) / max(before[2] - self._ball[2], 1e-9)
            landed = before + share * (self._ball - before)
            self.landing |= {
                "landing_w": landed.tolist(),
                "landing_time": time - (1.0 - share) * STEP,
            }

    def _damp(self, vel: ndarray) -> ndarray:
        """Return a velocity relative to the vehicle after a step of damping."""
        speed = float(norm(vel))
        loss = min(2.0 * math.log(2.0) / HALVING * speed, MOST_DAMPING)
        return vel * (1.0 - STEP * loss / max(speed, 1e-9))

    @property
    def state(self) -> dict[str, ndarray]:
        vehicle = self._now
        return {
            "pos_w": vehicle.pos,
            "quat_wb": vehicle.quat,
            "vel_w": vehicle.vel,
            "rate_b": vehicle.rate,
            "payload_pos_w": self._ball,
            "attached": np.array(self.attached),
        }


class Place:
    """The vehicle's place from PX4's latitude, longitude and altitude: steps of 1 cm, which the
    velocity bridges.
    """

    def __init__(self, latitude: float, longitude: float, altitude: float):
        """Measure from an origin [deg, deg, m]."""
        flat = ECCENTRICITY**2
        curve = 1.0 - flat * math.sin(math.radians(latitude)) ** 2
        north = EQUATOR * (1.0 - flat) / (curve * math.sqrt(curve))
        east = EQUATOR / math.sqrt(curve) * math.cos(math.radians(latitude))
        self._origin = np.array([latitude, longitude, altitude])
        self._scale = np.array([math.radians(north), -math.radians(east), 1.0])
        self._time = -math.inf
        self._pos = np.zeros(3)
        self._vel = np.zeros(3)

    def update(self, time: float, message: Any) -> tuple[ndarray, ndarray]:
        """Return place [m] and velocity [m/s] at a time [s], z up, by a HIL_STATE_QUATERNION."""
        vel = FLIP * [estimate_truncated(v, 1e-2) for v in (message.vx, message.vy, message.vz)]
        where = [
            estimate_truncated(message.lat, DEGREE),
            estimate_truncated(message.lon, DEGREE),
            estimate_truncated(message.alt, 1e-3),
        ]
        pos = self._scale * (where - self._origin)
        step = time - self._time
        if 0.0 < step < SETTLING:
            expected = self._pos + 0.5 * step * (self._vel + vel)
            pos = expected + step / SETTLING * (pos - expected)
        self._time = time
        self._pos = pos
        self._vel = vel
        return pos, vel


def estimate_truncated(count: int, unit: float) -> float:
    """Return the mean of the values that PX4 cuts to this count of a unit."""
    return unit * (count + math.copysign(0.5, count) if count else 0.0)


class Px4Sih(Bridge):
    """See the head of this module; ``heard_of``: states that came, ``last_output``: of the
    mechanism [us].
    """

    plant: HangingBall
    params: Px4Params

    def connect(self, autopilot: Link) -> None:
        """Listen to PX4 by a link of the bridge's own."""
        self.autopilot = autopilot
        self.port = autopilot.port
        self._asked: dict[int | str, float] = {}
        self._origin: dict[str, float] = {}
        self._place: Place | None = None
        self._offset = 0.0  # of PX4's clock to the plant's [s]
        self.heard_of = 0
        self.last_output = None
        autopilot.listen(self._hear)

    def hear(self) -> None:
        super().hear()
        self.autopilot.pump(self.wall)

    def _hear(self, message: Any, arrival: float) -> None:
        if message.get_srcSystem() != self.params.system:
            return
        kind = message.get_type()
        if kind == "HIL_STATE_QUATERNION":
            self._hear_state(message)
        elif kind == "PARAM_VALUE" and message.param_id in ORIGIN:
            value = message.param_value
            kind = message.param_type
            # up to 1.14 latitude and longitude are integers
            unit = DEGREE if kind == mav.MAV_PARAM_TYPE_INT32 else 1.0
            self._origin[message.param_id] = unit * parameter_value(value, kind)
            if len(self._origin) == len(ORIGIN) and self._place is None:
                self._place = Place(*(self._origin[name] for name in ORIGIN))
        elif kind == "SERVO_OUTPUT_RAW":
            self.last_output = getattr(message, f"servo{self.params.servo_output}_raw", 0)
            is_open = abs(self.last_output - self.params.servo_open_us) <= ARRIVED
            self.output(bool(self.params.servo_output) and is_open, arrival)

    def _hear_state(self, message: Any) -> None:
        if self._place is None:
            return
        time = 1e-6 * message.time_usec - self._offset
        if not self.paced:  # the first one, or after a pause
            self._offset += time - self.plant.time
            time = self.plant.time
            self.paced = True
        elif time <= self.plant.until:
            return
        self.heard_of += 1
        w, x, y, z = message.attitude_quaternion
        quat = np.array([x, -y, -z, w], dtype=float)
        rate = FLIP * (message.rollspeed, message.pitchspeed, message.yawspeed)
        place = self._place.update(time, message)
        self.plant.follow(Motion(time, *place, quat / norm(quat), rate))

    def fly(self) -> None:
        """Fly a period once PX4 has flown it; without PX4, without a new motion."""
        target = self.plant.time + self.plant.period - SLACK
        end = monotonic() + PATIENCE
        waits = self.paced
        while waits and self.plant.until < target and monotonic() < end:
            select.select([self.port], [], [], max(end - monotonic(), 0.0))
            self.hear()
        super().fly()
        if waits:
            self.paced = self.plant.until >= target

    def deliver(self, time: float) -> None:
        """Count the poses' latency on PX4's clock, which is ahead of the ball's."""
        super().deliver(self.plant.until if self.paced else time)

    def compute_command(self) -> ndarray:
        """Return nothing: PX4 flies."""
        return np.zeros(4)

    def emit(self) -> None:
        """Send nothing before PX4 has reported the vehicle's position."""
        if self.heard_of:
            super().emit()
        else:
            self.speak()

    def speak(self) -> None:
        """Request missing streams and parameters."""
        target = self.params.system, self.params.component
        for number, period in STREAMS.items():
            if self._due(number):
                interval = mav.MAV_CMD_SET_MESSAGE_INTERVAL
                self.autopilot.send(command_long(target, interval, number, 1e6 * period))
        for name in ORIGIN:
            if name not in self._origin and self._due(name):
                self.autopilot.send(parameter_request(target, name))

    def _due(self, what: int | str) -> bool:
        due = self.plant.time - self._asked.get(what, -math.inf) >= ASK_AGAIN
        if due:
            self._asked[what] = self.plant.time
        return due

    def close(self) -> None:
        super().close()
        self.autopilot.close()

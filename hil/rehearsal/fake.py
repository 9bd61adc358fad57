"""The common part of all fakes: plant, motion capture over the link, a queue of delayed actions,
a hold mode.
"""

import heapq
import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from numpy import ndarray

from hil.links.backends.thrust_curve import HoverThrustParams
from hil.links.device import Port
from hil.links.mavlink_link import Link
from hil.links.pymav import mav
from hil.links.roster import SIMULATED
from hil.poses.frames import FrameParams, Frames
from hil.poses.pose import PAYLOAD, Pose, Vector
from hil.rehearsal.fake_mocap import SLACK, FakeMocapParams, Mocap
from visthrow.config.bounds import Bounded, NotNegative
from visthrow.onboard.hover import GRAVITY, HoverController, HoverParams

# MAVLink system and component that poses of vehicle and payload come from
VEHICLE_ID = (1, 1)
PAYLOAD_ID = (1, mav.MAV_COMP_ID_USER1)
MAX_RATES = (10.0, 10.0, 4.0)  # largest body rates that the policies were trained with [rad/s]

NEVER = 1e9  # a time after every flight [s]
MOST_EVENTS = 200
ROOM = 1.01  # tolerance of a limit: whole microseconds of a stick, float32 in messages
MOST_KEPT = 100  # breaches kept
ANNOUNCED = 1.0  # between two messages that nothing real flies, which `--auto-arm` requires [s]
# set-point of a landing below the vehicle, and at least; height that counts as down [m]
DESCENT = 0.4
LOWEST = 0.05
TOUCH = 0.12
# of the policy's vehicle: weight [N], its share of 14 N, straight, tolerance, no voltage
THRUST = HoverThrustParams(2.668, 0.1906, 1.0, 0.1, 0.0)
GOES_ON = 1.5  # periods after which a repeated event is a new one
COVARIANCES = 21  # numbers of a covariance in ODOMETRY


class WirePlant(Protocol):
    """The vehicle behind the link."""

    period: float
    time: float
    home_w: ndarray
    mass: tuple[float, float]
    max_thrust: float

    def step(self, command: ndarray, release: bool, after: float = 0.0) -> None:
        """Advance one period under collective thrust [N] and body rates [rad/s]; the first release
        trips so long into it [s].
        """

    @property
    def state(self) -> dict[str, ndarray]:
        """pos_w, quat_wb, vel_w, rate_b, payload_pos_w, attached."""

    @property
    def predict_landing(self) -> dict[str, Any]:
        """landing_w, landing_time, separation_time."""


@dataclass(frozen=True)
class FakeOptions(Bounded):
    """Options of a fake's behaviour."""

    # To a release; "stuck" says accepted and moves nothing, and nobody but "accepted" moves
    # anything.
    answer: Literal["accepted", "in-progress", "denied", "silent", "stuck"] = "accepted"
    armed: bool = True  # at the start
    arming: bool = True  # whether it can be armed
    mode: int | None = None  # custom mode at the start, where there are modes; None: the usual one
    # that differ from a well set-up vehicle's
    parameters: dict[str, float] = field(default_factory=dict)
    # from a set-point's arrival to its effect [s]; None: the kind's
    command_delay: NotNegative | None = None
    answer_delay: NotNegative = 0.002  # 1 to 3 ms were measured [s]
    # from a release to the output's movement; 1 to 3 ms were measured [s]
    servo_delay: NotNegative = 0.002
    # from a release to the latch of the plant, whose own lag, the output's movement in it, follows
    # [s]
    mechanism: NotNegative = 0.0
    clock_offset: float = 0.0  # of its clock [s]
    silent_after: float = NEVER  # it sends nothing from this time on [s]
    taken_after: float = NEVER  # when the pilot takes the vehicle over [s]
    # ODOMETRY carries a reset counter
    pose_message: Literal["ATT_POS_MOCAP", "ODOMETRY"] = "ATT_POS_MOCAP"
    # a heartbeat follows a change of mode at once, or only when it is due; None: as of the kind
    prompt: bool | None = None
    all_channels: bool = False  # Betaflight: all channels come by MSP, the arming one as well


class SetPoints:
    """A queue of set-points with the times from which they act, sampled by a plant with its own
    period.
    """

    def __init__(self) -> None:
        self._acting: ndarray | None = None
        self._coming: deque[tuple[float, ndarray]] = deque()

    def add(self, when: float, target: ndarray) -> None:
        """Add a set-point, thrust [N] and body rates [rad/s], that acts from a time on [s],
        later than the earlier ones.
        """
        self._coming.append((when, target))

    def forget(self) -> None:
        """Delete all set-points."""
        self._acting = None
        self._coming.clear()

    def compute_command(self, begin: float, period: float) -> ndarray | None:
        """Return the mean set-point over the period from a time on [s]; None before the first
        set-point.
        """
        mean = np.zeros(4)
        since = begin
        while self._coming and self._coming[0][0] < begin + period - SLACK:
            when, target = self._coming.popleft()
            if self._acting is not None:
                mean += (max(when, begin) - since) / period * self._acting
                since = max(when, begin)
            self._acting = target
        return (
            None
            if self._acting is None
            else mean + (begin + period - since) / period * self._acting
        )


@dataclass
class Witness:
    """A monitor on the vehicle's side that records commands that must never arrive.

    Attributes:
        limits: largest thrust [N] and body rates [rad/s] that may be asked for.
        fence: corners of the box that the payload may be released in [m], world frame.
        breaches: what happened, with its time; empty after a good run.
        commands, releases: numbers received. worst: largest magnitudes received, of thrust [N] and
            rates [rad/s].
    """

    limits: tuple[float, float, float, float]
    fence: tuple[Vector, Vector] = (
        (-3.0, -3.0, -0.05),
        (3.0, 3.0, 3.0),
    )
    breaches: list[str] = field(default_factory=list)
    commands: int = 0
    releases: int = 0
    worst: list[float] = field(default_factory=lambda: [0.0] * 4)
    _answered: bool = False

    def command(self, time: float, command: tuple[float, ...]) -> None:
        """Check a set-point: thrust [N], body rates [rad/s]."""
        self.commands += 1
        if not all(map(math.isfinite, command)):
            self._note(time, f"command {command} is not finite")
            return
        self.worst = [max(w, abs(c)) for w, c in zip(self.worst, command)]
        if command[0] < 0.0 or any(abs(c) > ROOM * limit for c, limit in zip(command, self.limits)):
            self._note(time, f"command {command} beyond {self.limits}")

    def release(self, time: float, armed: bool, payload_w: ndarray) -> None:
        """Check a command to open the mechanism."""
        self.releases += 1
        low, high = self.fence
        if self._answered:
            self._note(time, "released again after the answer")
        if not armed:
            self._note(time, "released while disarmed")
        if not all(a <= x <= b for a, x, b in zip(low, payload_w, high)):
            self._note(
                time,
                f"released with the payload at {np.round(payload_w, 2).tolist()}, outside of its"
                " fence",
            )

    def note_answer(self) -> None:
        """Record that the release was acknowledged: none may follow."""
        self._answered = True

    def _note(self, time: float, text: str) -> None:
        if len(self.breaches) < MOST_KEPT:
            self.breaches.append(f"{time:.3f} s: {text}")


class Fake(ABC):
    """A simulated vehicle with motion capture of both bodies; subclasses add an autopilot's
    protocol.

    Attributes:
        last_thrust: of the last period [N]. wall: the time now, within a period as well [s].
            events: times and what happened.
        port: that commands come by. witness: of what came. spoil: what becomes of measured poses at
            a time [s], as the source writes them.
        followed, ignored: set-points. release_time: when the mechanism's output moved.
    """

    thrust_map: HoverThrustParams
    paced = False  # whether a firmware's clock runs the plant now: it waits for the firmware's time
    # The real autopilots took 70 to 79 ms (ArduPilot), 86 to 98 ms (PX4) and 55 to 90 ms
    # (Betaflight) from a set-point to half of a step of 1.5 rad/s; the training simulator's own
    # vehicle takes 75 ms. What is missing is this delay [s].
    usual_delay = 0.0
    usually_prompt = True  # with its heartbeat after a change of mode

    def __init__(
        self,
        plant: WirePlant,
        link: Link,
        mocap: FakeMocapParams | None = None,
        seed: int = 0,
        options: FakeOptions | None = None,
        port: Port | None = None,
    ):
        """Start under a pilot's control. Poses are sent on the link with the vehicle's ids;
        commands arrive at the port, or on the link.
        """
        self.plant = plant
        self.link = link
        self.options = options or FakeOptions()
        self.port: Any = port or link.port
        self.mocap = Mocap(mocap or FakeMocapParams(), seed)
        self.spoil: Callable[[list[Pose], float], list[Pose]] = lambda poses, time: poses
        self.witness = Witness((plant.max_thrust, *MAX_RATES))
        # Out there the world is x north, y east, z down, the body forward, right, down, quaternions
        # w first.
        ned = Frames(FrameParams("x,-y,-z", "x,-y,-z", "wxyz", 0.0, (0.0, 0.0, 0.0)))
        self._to_source: Callable[[Pose], Pose] = ned.source_from_pose
        self._hover = HoverController(HoverParams(max_thrust=plant.max_thrust), plant.period)
        self._payload_sender = link.packer(*PAYLOAD_ID)
        self._payload_sender.file = link.port
        self._announced = -np.inf
        self._later: list[tuple[float, int, Callable[[], None]]] = []
        self._set_points = SetPoints()
        self._count = 0
        self.armed = self.options.armed
        self._place = np.array(plant.home_w, dtype=float)
        self._target: ndarray | None = None  # set-point that acts in this period
        self._last_command = float("-inf")  # when the last set-point was followed [s]
        self._trip: float | None = None  # when the latch of the plant trips [s]
        self.followed = self.ignored = 0
        self.release_time: float | None = None
        self.last_thrust = 0.0
        self.wall: Callable[[], float] = lambda: self.plant.time
        self.heard = 0.0  # arrival of the message that is being processed [s]
        # In lock step an answer is heard a period after its question: this makes the question come
        # in the middle [s].
        self.question_lag = 0.5 * plant.period
        self.events: list[tuple[float, str]] = []
        self._going_on: dict[str, float] = {}
        self.taken = False
        self._open: bool | None = None  # the mechanism's output; None before it was seen closed

    @staticmethod
    def open_port(number: int) -> Port | None:
        """Open a port for commands; None if they arrive on the link of the poses."""
        return None

    def note_event(self, text: str) -> None:
        """Record an action of the autopilot, its own or commanded; an action that continues in
        the next period is one event.
        """
        goes_on = self.plant.time - self._going_on.get(text, -1e9) < GOES_ON * self.plant.period
        self._going_on[text] = self.plant.time
        if len(self.events) < MOST_EVENTS and not goes_on:
            self.events.append((round(self.plant.time, 3), text))

    def later(self, delay: float, what: Callable[[], None]) -> None:
        """Call a function after a delay [s]; at once if the delay is 0."""
        if delay <= 0.0:
            what()
            return
        self._count += 1
        heapq.heappush(self._later, (self.plant.time + delay, self._count, what))

    def clock(self) -> float:
        """Return the time on the vehicle's own clock [s]."""
        return self.plant.time + self.options.clock_offset

    @property
    def silent(self) -> bool:
        """Whether the autopilot has fallen silent; the motion capture goes on."""
        return self.plant.time >= self.options.silent_after

    def set_point(self, command: tuple[float, ...], listens: bool) -> None:
        """Process a received set-point, thrust [N] and body rates [rad/s]; ``listens``: whether
        it is followed. Values that are not finite become 0.
        """
        self.witness.command(self.plant.time, command)
        if not listens:
            self.ignored += 1
            return
        self.followed += 1
        self._last_command = self.plant.time
        delay = self.options.command_delay
        delay = self.usual_delay if delay is None else delay
        self._set_points.add(self.heard + delay, np.nan_to_num(np.array(command)))

    def stay(self) -> None:
        """Hold the current position from now on."""
        self._place = self.plant.state["pos_w"].astype(float)

    def forget(self) -> None:
        """Discard earlier set-points, because somebody else flies from now on."""
        self._target = None
        self._set_points.forget()

    def open_mechanism(self) -> None:
        """Move the mechanism's output, with the option "accepted" only; the payload separates
        some time later.
        """
        if self.options.answer != "accepted" or self.release_time is not None:
            return
        self.release_time = self.heard + self.options.servo_delay
        self._trip = self.heard + self.options.mechanism

    @property
    def moved(self) -> bool:
        """Whether the mechanism's output has moved."""
        return self.release_time is not None and self.plant.time >= self.release_time

    def note_release(self) -> None:
        """Record that a release command has arrived."""
        self.witness.release(self.plant.time, self.armed, self.plant.state["payload_pos_w"])

    def output(self, is_open: bool, when: float) -> bool:
        """Process the mechanism's output, or its channel, at a time [s]; return whether it has
        opened now, which releases the payload. An output that was never closed does not release.
        """
        opens = is_open and self._open is False
        if is_open and self._open is None:
            self.note_event("the mechanism's output is open: nothing is released before it closes")
            return False
        self._open = bool(is_open)
        if opens:
            self.heard = when
            self.note_release()
            self.open_mechanism()
        return opens

    def weight(self) -> float:
        """Return the flying weight [N]."""
        return self.plant.mass[0 if self.plant.state["attached"] else 1] * GRAVITY

    def hold(self, goal_w: ndarray) -> ndarray:
        """Return the command that holds a position [m], for the autopilot or the pilot."""
        state = self.plant.state
        views = [state[name].astype(float)[None] for name in ("pos_w", "quat_wb", "vel_w")]
        return self._hover.step(*views, goal_w, self.weight() / GRAVITY)[0]

    def descend(self) -> ndarray:
        """Return the command that lands where the vehicle is; it disarms once it is down."""
        pos = self.plant.state["pos_w"]
        if pos[2] < TOUCH:
            self.armed = False
            self.note_event("landed, disarmed")
        return self.hold(np.array([self._place[0], self._place[1], max(pos[2] - DESCENT, LOWEST)]))

    @abstractmethod
    def take(self) -> None:
        """Let the pilot take the vehicle over and hold its position."""

    @abstractmethod
    def compute_command(self) -> ndarray:
        """Return the command of this period, from whoever is in control."""

    def speak(self) -> None:  # noqa: B027 - one that speaks when it is asked says nothing here
        """Send what is due: heartbeats, streams."""

    def hear(self) -> None:
        """Process received messages."""
        self.link.pump(self.wall)

    def deliver(self, time: float) -> None:
        """Call the functions that are due by a time [s]."""
        while self._later and self._later[0][0] <= time + SLACK:
            heapq.heappop(self._later)[2]()

    def run_on(self, when: float) -> None:  # noqa: B027  most fakes have no clock of their own
        """Let the autopilot run up to a time within this period [s], if its clock is ours;
        messages of that time do not act earlier.
        """

    def fly(self) -> None:
        """Process received messages, and fly one period."""
        plant = self.plant
        self.hear()
        self.deliver(plant.time)
        if not self.taken and plant.time >= self.options.taken_after:
            self.taken = True
            self.take()
        self._target = self._set_points.compute_command(plant.time, plant.period)
        command = self.compute_command()
        self.last_thrust = command[0]
        after = 0.0 if self._trip is None else self._trip - plant.time
        opens = self._trip is not None and after < plant.period - SLACK
        plant.step(command, opens, max(after, 0.0) if opens else 0.0)

    def emit(self) -> None:
        """Measure and send what is due now."""
        time = self.plant.time
        if self.mocap.due(time):
            written = [self._to_source(pose) for pose in self.mocap.measure(time, self.plant.state)]
            for pose in self.spoil(written, time):
                self._post(pose)
        if time - self._announced >= ANNOUNCED:
            self._announced = time
            self.link.send(
                mav.MAVLink_named_value_int_message(int(1e3 * time), SIMULATED.encode(), 1)
            )
        self.deliver(time)
        if not self.silent:
            self.speak()

    def step(self) -> None:
        """Fly one period."""
        self.fly()
        self.emit()

    def _post(self, pose: Pose) -> None:
        """Send a pose in the source's convention."""
        stamp = int((pose.stamp + self.options.clock_offset) * 1e6)
        if self.options.pose_message == "ODOMETRY":
            unknown = [float("nan")] * 3
            message = mav.MAVLink_odometry_message(
                stamp,
                mav.MAV_FRAME_LOCAL_FRD,
                mav.MAV_FRAME_BODY_FRD,
                *pose.pos,
                list(pose.quat),
                *unknown,  # velocity
                *unknown,  # rates
                [float("nan")] * COVARIANCES,
                [float("nan")] * COVARIANCES,
                pose.reset % 256,
            )
        else:
            message = mav.MAVLink_att_pos_mocap_message(stamp, list(pose.quat), *pose.pos)
        self.later(pose.arrival - self.plant.time, lambda: self._send_pose(message, pose.body))

    def _send_pose(self, message: Any, body: str) -> None:
        if body == PAYLOAD:
            self._payload_sender.send(message)
        else:
            self.link.send(message)

    def report(self) -> dict[str, Any]:
        """Return what happened to the payload, on the plant's clock, and to the messages."""
        w = self.witness
        last = self._last_command
        return {
            **self.plant.landing,
            "followed": self.followed,
            "ignored": self.ignored,
            "releases": w.releases,
            "release_time": self.release_time,
            "armed": self.armed,
            "commands": w.commands,
            "worst": w.worst,
            "breaches": w.breaches,
            "events": self.events,
            "last_command": last if math.isfinite(last) else None,
            "end_w": self.plant.state["pos_w"].tolist(),
            "time": self.plant.time,
        }

    def close(self) -> None:
        """Close the ports."""
        self.link.close()


class Bridge(Fake):
    """A plant flown by a real autopilot in software, which communicates with the runner
    directly.
    """

    params: Any  # of the back-end: which output or channel opens the mechanism
    # entries of a report
    unknown = ("followed", "ignored", "commands", "worst", "breaches", "last_command")

    def __init__(
        self,
        plant: WirePlant,
        link: Link,
        mocap: FakeMocapParams | None,
        seed: int,
        options: FakeOptions,
        params: Any,
        autopilot: Any = None,
    ):
        """Connect to an autopilot; ``params`` of its back-end; ``autopilot``: its link or pipe,
        where that is open already.
        """
        super().__init__(plant, link, mocap, seed, options)
        self.params = params
        self.connect(autopilot)

    @abstractmethod
    def connect(self, autopilot: Any) -> None:
        """Connect to the autopilot."""

    def take(self) -> None:
        """Do nothing: the pilot is the autopilot's."""

    def report(self) -> dict[str, Any]:
        return {name: value for name, value in super().report().items() if name not in self.unknown}

"""A fake ArduCopter and a motion-capture system, as one MAVLink peer in a process of its own.

It behaves as the real one was measured to: it follows SET_ATTITUDE_TARGET only in GUIDED or GUIDED_NOGPS, armed, for its
own system id and with a type mask of 128 alone, and ignores all else without a word; it takes a NaN thrust and falls;
DO_GRIPPER is answered; 3 s of silence level it. Until the first command it holds its own hover. The plant is injected:
this module knows no simulator.
"""

import heapq
import importlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from hil.backends.ardupilot import ARMED, CUSTOM, GUIDED, GUIDED_NOGPS, LAND
from hil.clock import Clock
from hil.errors import RunError
from hil.frames import FrameParams, Frames
from hil.link import IGNORE_ATTITUDE, Link
from hil.mavlink import mav
from hil.mocap import Mocap, MocapParams
from hil.pose import PAYLOAD, Pose
from visthrow.hover import GRAVITY, HoverController, HoverParams

VEHICLE_ID, PAYLOAD_ID = (1, 1), (1, 25)
"""MAVLink system and component that poses of vehicle and payload come from."""

TIMEOUT = 3.0
"""Silence after which the vehicle levels: GUID_TIMEOUT's default [s]."""

AFTER_LANDING = 10.0
"""The process ends this long after the payload has landed [s]: the vehicle has landed by then."""

ANSWERS = {
    "accepted": (mav.MAV_RESULT_ACCEPTED,),
    "in-progress": (mav.MAV_RESULT_IN_PROGRESS,),
    "denied": (mav.MAV_RESULT_DENIED,),
    "silent": (),
    "stuck": (mav.MAV_RESULT_ACCEPTED,),
}
"""What DO_GRIPPER is answered; "stuck" says accepted and moves nothing, and so does nobody but "accepted"."""


class WirePlant(Protocol):
    """What flies behind the wire."""

    period: float
    time: float
    home_w: np.ndarray
    mass: tuple[float, float]
    max_thrust: float

    def step(self, command: np.ndarray, release: bool) -> None:
        """Advance one period under collective thrust [N] and body rates [rad/s]."""

    @property
    def state(self) -> dict[str, np.ndarray]:
        """pos_w, quat_wb, vel_w, rate_b, payload_pos_w, attached."""

    @property
    def landing(self) -> dict[str, Any]:
        """landing_w, landing_time, separation_time."""


def load_plant(target: str, policy: str, seed: int) -> WirePlant:
    """Call ``module:function`` with policy and seed.

    Raises:
        RunError: no such module or function.
    """
    module, _, name = target.partition(":")
    try:
        make = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise RunError(f"plant '{target}': {error}; expected module:function, as visthrow.wire_plant:make") from error
    return make(policy, seed)


class FakeAutopilot:
    """The vehicle, its autopilot's protocol and the motion capture of both bodies."""

    def __init__(
        self, plant: WirePlant, link: Link, mocap: MocapParams, seed: int = 0, answer: str = "accepted", mode: int = GUIDED
    ) -> None:  # fmt: skip
        """Listen on a link.

        Args:
            plant: what flies.
            link: with the vehicle's ids.
            mocap: its faults.
            seed: of noise and loss.
            answer: of :data:`ANSWERS`.
            mode: custom mode that the pilot has chosen.
        """
        self.plant, self.link, self.answer, self.mode = plant, link, answer, mode
        self.mocap = Mocap(mocap, seed)
        # Out there the world is x north, y east, z down, the body forward, right, down, quaternions w first.
        ned = Frames(FrameParams("x,-y,-z", "x,-y,-z", "wxyz", 0.0, (0.0, 0.0, 0.0)))
        self._to_source: Callable[[Pose], Pose] = ned.source_from_pose
        self._hover = HoverController(HoverParams(max_thrust=plant.max_thrust), plant.period)
        self._payload_sender = mav.MAVLink(None, *PAYLOAD_ID)
        self._target: np.ndarray | None = None
        self._told = 0.0
        self._release = False
        self._waiting: list[tuple[float, int, Any, bool]] = []
        self._count, self._next_beat = 0, 0.0
        self.followed = self.ignored = self.grippers = 0
        self.gripper_time: float | None = None
        link.listen(self._hear)

    def _hear(self, message: Any, arrival: float) -> None:
        kind = message.get_type()
        if kind == "SET_ATTITUDE_TARGET":
            ours = message.target_system == VEHICLE_ID[0] and message.type_mask == IGNORE_ATTITUDE
            if not ours or self.mode not in (GUIDED, GUIDED_NOGPS):
                self.ignored += 1
                return
            thrust = message.thrust * self.plant.max_thrust
            rates = (message.body_roll_rate, -message.body_pitch_rate, -message.body_yaw_rate)
            self._target, self._told = np.nan_to_num(np.array([thrust, *rates])), self.plant.time
            self.followed += 1
        elif kind == "COMMAND_LONG" and message.target_system == VEHICLE_ID[0]:
            self._command(message)
        elif kind == "TIMESYNC" and message.tc1 == 0:
            self.link.send(mav.MAVLink_timesync_message(int(arrival * 1e9), message.ts1))

    def _command(self, message: Any) -> None:
        if message.command == mav.MAV_CMD_DO_SET_MODE:
            self.mode = int(message.param2)
            self._next_beat = 0.0
            self.link.send(mav.MAVLink_command_ack_message(message.command, mav.MAV_RESULT_ACCEPTED))
        elif message.command == mav.MAV_CMD_DO_GRIPPER and message.param2 == mav.GRIPPER_ACTION_RELEASE:
            self.grippers += 1
            if self.answer == "accepted" and not self._release:
                self._release, self.gripper_time = True, self.plant.time
            for result in ANSWERS[self.answer]:
                self.link.send(mav.MAVLink_command_ack_message(message.command, result))

    def _flown(self, now: dict[str, np.ndarray]) -> np.ndarray:
        """Command of this period: the runner's, or the autopilot's own."""
        alone = not now["attached"]
        if self.mode in (GUIDED, GUIDED_NOGPS) and self._target is not None:
            if self.plant.time - self._told <= TIMEOUT:
                return self._target
            return np.array([self.plant.mass[alone] * GRAVITY, 0.0, 0.0, 0.0])
        home = self.plant.home_w if self.mode != LAND else now["pos_w"] - (0.0, 0.0, 0.4)
        views = [now[name].astype(float)[None] for name in ("pos_w", "quat_wb", "vel_w")]
        return self._hover.step(*views, home, self.plant.mass[alone])[0]

    def fly(self) -> None:
        """Hear what has come, and fly one period."""
        self.link.pump(lambda: self.plant.time)
        self.plant.step(self._flown(self.plant.state), self._release)

    def emit(self) -> None:
        """Measure and send what is due now."""
        if self.mocap.due(self.plant.time):
            for pose in self.mocap.measure(self.plant.time, self.plant.state):
                self._post(pose)
        while self._waiting and self._waiting[0][0] <= self.plant.time + 1e-9:
            _, _, message, payload = heapq.heappop(self._waiting)
            if payload:
                self.link.port.write(message.pack(self._payload_sender))
                self._payload_sender.seq = (self._payload_sender.seq + 1) % 256
            else:
                self.link.send(message)
        if self.plant.time >= self._next_beat:
            self._next_beat = self.plant.time + 1.0
            self.link.send(mav.MAVLink_heartbeat_message(2, 3, ARMED | CUSTOM, self.mode, 4, 3))

    def step(self) -> None:
        """One period."""
        self.fly()
        self.emit()

    def _post(self, pose: Pose) -> None:
        """Put a pose on its way."""
        out = self._to_source(pose)
        message = mav.MAVLink_att_pos_mocap_message(int(pose.stamp * 1e6), list(out.quat), *out.pos)
        self._count += 1
        heapq.heappush(self._waiting, (pose.arrival, self._count, message, pose.body == PAYLOAD))

    def report(self) -> dict[str, Any]:
        """What happened to the payload, on the plant's clock, and to the messages."""
        counts = {name: getattr(self, name) for name in ("followed", "ignored", "grippers", "gripper_time", "mode")}
        return {**self.plant.landing, **counts, "end_w": self.plant.state["pos_w"].tolist(), "time": self.plant.time}


def serve(
    fake: FakeAutopilot, clock: Clock, most: float, out: Path | None = None, after: float = AFTER_LANDING
) -> dict[str, Any]:  # fmt: skip
    """Fly in real time until ``after`` seconds after the payload's landing, or for ``most`` seconds.

    Returns:
        The report, with the number of periods that took longer than real time has.
    """
    start, begun, late = clock.now(), fake.plant.time, 0
    while fake.plant.time - begun < most:
        fake.fly()
        due = start + (fake.plant.time - begun)
        late += clock.now() > due
        clock.sleep_until(due)
        fake.emit()
        landed = fake.plant.landing["landing_time"]
        if landed is not None and fake.plant.time > landed + after:
            break
    report = {**fake.report(), "late_periods": late}
    if out is not None:
        out.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    return report

"""Track one body: from raw poses, through frames, gate and filter, to its state at a time."""

import math
from collections import deque
from dataclasses import dataclass, replace

from hil.poses.estimate import EstimateParams, SlopeFilter, fit_weights
from hil.poses.frames import FrameParams, Frames
from hil.poses.gate import Gate, GateParams, Tether
from hil.poses.pose import Pose, Quaternion, Vector, has_attitude
from hil.poses.stream import Stream
from visthrow.common.rotations import plus, turn_one

# longest prediction [s]; for older poses the gate's time-outs act
MOST_PREDICTION = 0.1

TRUST = 0.5
"""Share of the estimated accelerations with which velocity and rate are predicted: their noise
is about as large as their signal. In 160 simulated throws with poses 20 ms old (1 mm, 0.2 deg,
100 Hz) state and vision policy landed 0.029 and 0.028 m off with it, 0.043 and 0.035 m with all
of the linear and none of the angular acceleration.
"""

# poses used by :meth:`Track.calm_speed`: so many that noise of millimetres does not count as motion
CALM_SAMPLES = 20


@dataclass(frozen=True)
class BodyState:
    """State of a body in our frames at one time."""

    pos: Vector  # [m], world frame
    quat: Quaternion | None  # body to world, xyzw
    vel: Vector  # [m/s], world frame
    rate: Vector  # [rad/s], body frame
    age: float  # since the content last changed [s]


class Track:
    """A tracker of one body.

    Attributes:
        gate: accepts or rejects poses, and counts the rejected ones. filter: estimates velocities.
        accepted: number of accepted poses. stream: judges rate and regularity.
    """

    def __init__(
        self, frames: FrameParams, gate: GateParams, estimate: EstimateParams, turns: bool = True
    ):
        """Start without a pose; ``turns``: whether the body rate is needed, which it is not for
        a payload.
        """
        self._turns = turns
        self.stream = Stream(gate, estimate)
        self.frames = Frames(frames)
        self.gate = Gate(gate)
        self.filter = SlopeFilter(estimate)
        self.accepted = 0
        self._pose: Pose | None = None
        self._vel: Vector = (0.0, 0.0, 0.0)
        self._slow: deque[tuple[float, Vector]] = deque(maxlen=CALM_SAMPLES)
        # added to the stamps, so that a step of the source's clock does not empty the filter's
        # window
        self._shift = 0.0

    def restart(self) -> None:
        """Forget all poses; see `hil.poses.gate.Gate.restart`."""
        self.gate.restart()
        self.filter.reset()
        self._slow.clear()
        self._pose = None

    def update(self, raw: Pose, tether: Tether | None = None) -> str | None:
        """Process a raw pose; return why it was rejected, or None.

        ``tether``: the cable's other end, if the payload is attached. A body whose rate is not
        needed may lack an attitude.
        """
        reason = self._accept(raw, tether)
        self.stream.note(raw, reason)
        return reason

    def _accept(self, raw: Pose, tether: Tether | None) -> str | None:
        if raw.is_lost():
            raw = replace(raw, valid=False)
        if not self._turns and raw.quat is not None and not has_attitude(raw.quat):
            raw = replace(raw, quat=None)
        pose = self.frames.pose_from_source(raw)
        before = self.gate.last
        stepped = self.gate.clock_stepped(pose)
        reason = self.gate.check(pose, self._vel if self._pose is not None else None, tether)
        if reason is not None:
            return reason
        if stepped and before is not None:
            self._shift -= (pose.stamp - before.stamp) - (pose.arrival - before.arrival)
        self.accepted += 1
        self._vel = self.filter.update(
            replace(pose, stamp=pose.stamp + self._shift) if self._shift else pose
        )
        self._pose = pose
        self._slow.appendleft((pose.arrival, pose.pos))
        return None

    def settle(self) -> None:
        """Compute now what :meth:`state` would otherwise compute at its first call."""
        if self._turns:
            _ = self.filter.rate

    def predict_position(self, time: float) -> Vector | None:
        """Predict the position at a time of arrival [s] from the last pose and velocity; None
        before the first pose.
        """
        pose = self._pose
        if pose is None:
            return None
        return plus(pose.pos, self._vel, time - pose.arrival)

    def sample(self) -> tuple[Pose, Vector, Vector]:
        """Return the last pose, its stamp corrected for clock steps, with velocity and body rate;
        raises `ValueError` before the first pose.
        """
        if self._pose is None:
            raise ValueError("no pose was taken yet; sample() is for after the first one")
        return (
            replace(self._pose, stamp=self._pose.stamp + self._shift),
            self._vel,
            self.filter.rate,
        )

    def calm_speed(self) -> float:
        """Return the speed from a line fitted to the last poses [m/s]: delayed, but with little
        noise; infinite if there are too few.
        """
        if len(self._slow) < CALM_SAMPLES:
            return math.inf
        newest = self._slow[0][0]
        weights = fit_weights([newest - time for time, _ in self._slow], 1)[0]
        return math.hypot(
            *(sum(c * pos[i] for c, (_, pos) in zip(weights, self._slow)) for i in range(3))
        )

    def state(self, time: float, lead: float = 0.0) -> BodyState | None:
        """Return the last accepted pose as a state at a time [s], predicted by ``lead`` [s] with
        part of the estimated accelerations; None before the first pose.
        """
        pose = self._pose
        if pose is None:
            return None
        pos = pose.pos
        quat = pose.quat
        vel = self._vel
        age = self.gate.age(time)
        rate = self.filter.rate if self._turns else (0.0, 0.0, 0.0)
        lead = min(max(lead, 0.0), MOST_PREDICTION)
        if lead > 0.0:
            pos = plus(pos, vel, lead)
            vel = plus(vel, self.filter.acceleration, TRUST * lead)
            if quat is not None:
                quat = turn_one(quat, rate, lead)
            if self._turns:
                rate = plus(rate, self.filter.spin, TRUST * lead)
        return BodyState(pos, quat, vel, rate, age)

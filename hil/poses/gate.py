"""Gate of a body: it rejects wrong poses, and reports how old the last new pose is, as one of the
levels warn, hold and abort of ``[gate]``.

A motion-capture system that has lost a body keeps sending its *last* pose. So staleness is judged
by content: the time since the last *accepted* pose that differed from the one before. After a jump,
a body stays rejected: a pose must lie near the prediction from the last accepted pose and its
velocity. The tolerance grows with the time in which *no* pose arrived, not with the time in which
wrong ones arrived. So two bodies that the system has swapped are never accepted again by waiting:
their poses become stale and the runner ends the throw. After a gap the tolerance may admit a swap;
then the cable reveals it. A pose far from its prediction is rejected if it is closer to the body at
the cable's other end, or farther from that body than the cable's length. A body that moves as
predicted is accepted at any distance, such as a payload that has detached. Poses less frequent than
``hold`` count as missing."""

import math
from collections import Counter
from dataclasses import dataclass

from hil.poses.pose import Pose, Vector
from visthrow.common.errors import ConfigError
from visthrow.common.rotations import plus
from visthrow.config.bounds import Bounded, Positive

OK, WARN, HOLD, ABORT = range(4)  # levels of staleness
MOST_ACCELERATION = 40.0  # assumed limit of a body's acceleration while no pose arrived [m/s^2]
MOST_STAMP = 1e11  # largest stamp [s], year 5138: beyond it, floats do not resolve 20 us
RARE = 3  # consecutive gaps longer than ``hold`` after which poses count as missing


REASONS = {
    "invalid": "the source says that it does not see the body",
    "finite": "NaN or infinite numbers",
    "attitude": "attitudes of NaN instead of unit quaternions: the source gives none",
    "stamp": "stamps that are no time",
    "quaternion": "attitudes that are no unit quaternions",
    "old": "stamps not after the last one's: reordered, or not stamped",
    "repeated": "the last pose again, or a datagram that came twice",
    "swapped": "where the other body is expected",
    "cable": "farther from the other body than the cable is long",
    "jump": "jumps",
    "speed": "faster than gate.max_speed",
    "turn": "turns faster than gate.max_turn_rate",
    "reset": "the source's reset counter has changed",
}
"""Reason for a rejection -> its text."""


@dataclass(frozen=True)
class Tether:
    """The other end of the cable while the payload hangs on it."""

    pos: Vector  # of the other body, expected at the pose's arrival [m]
    length: float  # largest distance of the two [m]; infinite if the other body's pose is stale


@dataclass(frozen=True)
class GateParams(Bounded):
    """Limits of one body."""

    quat_tolerance: Positive  # of a quaternion's norm from 1 [-]
    max_jump: Positive  # from the position predicted by the last pose and velocity [m]
    max_speed: Positive  # [m/s]
    # between two poses, beyond max_turn_rate times the time in which no pose arrived [rad]
    max_turn: Positive
    max_turn_rate: Positive  # [rad/s]
    # difference between intervals of stamps and of arrivals that counts as a step of the source's
    # clock [s]
    clock_step: Positive
    warn: Positive  # content age [s]
    hold: Positive  # content age [s]
    abort: Positive  # content age [s]

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.warn < self.hold < self.abort:
            raise ConfigError(
                f"gate: warn {self.warn}, hold {self.hold}, abort {self.abort} s; expected them"
                " ascending"
            )


class Gate:
    """Accepts or rejects one body's poses; ``last`` is the last accepted one, ``refused`` counts
    rejections by reason, ``jumped`` states whether the source's reset counter has changed since
    the last :meth:`restart`.
    """

    def __init__(self, params: GateParams):
        self.params = params
        self.refused: Counter[str] = Counter()
        self.restart()

    def restart(self) -> None:
        """Forget all poses: the next valid pose is accepted wherever it is.

        Only for use on the ground, before the take-over.
        """
        self.last: Pose | None = None
        self.jumped = False
        self._came: Pose | None = None  # last pose in order, accepted or not
        self._changed = -math.inf  # arrival of the last new content [s]
        self._gaps = 0  # longer than hold, in a row

    def check(
        self, pose: Pose, velocity: Vector | None = None, tether: Tether | None = None
    ) -> str | None:
        """Check a pose in our frames, given the body's velocity at its last accepted pose [m/s] and
        the cable's other end, if the payload is attached.

        Returns the reason of the rejection, a key of `REASONS`, or None if the pose is accepted."""
        reason = self._reason(pose, velocity, tether)
        if reason is not None:
            self.refused[reason] += 1
            return reason
        first = self.last is None
        self.last = pose
        self._came = pose
        rare = not first and pose.arrival - self._changed > self.params.hold
        self._gaps = self._gaps + 1 if rare else 0
        self._changed = pose.arrival
        return None

    def clock_stepped(self, pose: Pose) -> bool:
        """Return whether the source's clock was set between the last accepted pose and this one."""
        last = self.last
        return (
            last is not None
            and abs((pose.stamp - last.stamp) - (pose.arrival - last.arrival))
            > self.params.clock_step
        )

    def _reason(self, pose: Pose, velocity: Vector | None, tether: Tether | None) -> str | None:
        last = self.last
        reason = self._itself(pose)
        if reason is not None or last is None:
            return reason
        if self.jumped or pose.reset != last.reset:
            self.jumped = True
            return "reset"
        stepped = self.clock_stepped(pose)
        same = pose.pos == last.pos and pose.quat == last.quat
        if pose.stamp <= last.stamp and not stepped:
            return "repeated" if same and pose.stamp == last.stamp else "old"
        previous = self._came or last
        self._came = pose
        if same:
            return "repeated"
        # After a step of the clock only the arrivals show how long ago the last pose was.
        age, gap = (
            max(pose.arrival - earlier.arrival if stepped else pose.stamp - earlier.stamp, 0.0)
            for earlier in (last, previous)
        )
        return self._motion(pose, last, velocity, tether, age, gap)

    def _itself(self, pose: Pose) -> str | None:
        """Return what is wrong with a pose by itself, or None."""
        p = self.params
        if not pose.valid:
            return "invalid"
        # Checked first: without an attitude, values in body axes are NaN too.
        if not all(map(math.isfinite, pose.quat or ())):
            return "attitude"
        numbers = (pose.stamp, pose.arrival, *pose.pos, *(pose.vel or ()), *(pose.rate or ()))
        if not all(map(math.isfinite, numbers)):
            return "finite"
        if abs(pose.stamp) > MOST_STAMP:
            return "stamp"
        if pose.quat is not None and abs(math.hypot(*pose.quat) - 1.0) > p.quat_tolerance:
            return "quaternion"
        if pose.vel is not None and math.hypot(*pose.vel) > p.max_speed:
            return "speed"
        return None

    def _motion(
        self,
        pose: Pose,
        last: Pose,
        velocity: Vector | None,
        tether: Tether | None,
        age: float,
        gap: float,
    ) -> str | None:
        """Return what is wrong with the motion since the last accepted pose, or None; ``age``:
        of that pose [s]; ``gap``: time without any pose [s].
        """
        p = self.params
        expected = last.pos if velocity is None else plus(last.pos, velocity, age)
        off = math.dist(pose.pos, expected)
        if tether is not None and off > p.max_jump:
            distance = math.dist(pose.pos, tether.pos)
            if distance < off:
                return "swapped"
            if distance > tether.length:
                return "cable"
        if math.dist(pose.pos, last.pos) > p.max_jump + p.max_speed * age:
            return "speed"
        if velocity is not None and off > p.max_jump + 0.5 * MOST_ACCELERATION * gap * gap:
            return "jump"
        if pose.quat is not None and last.quat is not None:
            cosine = min(1.0, abs(sum(a * b for a, b in zip(pose.quat, last.quat))))
            if 2.0 * math.acos(cosine) > p.max_turn + p.max_turn_rate * gap:
                return "turn"
        return None

    def age(self, time: float) -> float:
        """Return the time since the content last changed [s]; infinite before the first pose."""
        return time - self._changed

    def level(self, time: float) -> int:
        """Return :data:`OK`, :data:`WARN`, :data:`HOLD` or :data:`ABORT` by the content's age;
        ABORT if poses are too rare.
        """
        if self._gaps >= RARE:
            return ABORT
        age = self.age(time)
        return (age > self.params.warn) + (age > self.params.hold) + (age > self.params.abort)

"""Gate of a body: refuses wrong poses, and says how old the last new one is (warn, hold, abort:

``[gate]``).

A motion-capture system that has lost a body goes on sending its *last* pose, so staleness is judged
on content: the time since a pose last *differed* from the one before. A body that jumps is refused
and stays refused: a pose must lie where the last accepted one and its velocity put the body, within
a room that grows with the time in which *nothing* came, not with the time in which wrong poses
came. So two bodies that the system has swapped never become right again by waiting; their timers
run out and the runner ends the throw. Swapped after a gap, which leaves room for both, they are
known by the cable: of poses off their way, one that fits the body at the cable's other end better
is not taken, nor one farther off than the cable is long. A body that goes its way is followed,
however far: a payload that has come off takes no pose of the vehicle with it. Poses that keep
coming, but more rarely than ``hold``, are as good as none."""

import math
from collections import Counter
from dataclasses import dataclass

from hil.poses.pose import Pose, Vector
from visthrow.common.errors import ConfigError
from visthrow.common.rotations import plus
from visthrow.config.bounds import Bounded, Positive

OK, WARN, HOLD, ABORT = range(4)  # levels of staleness
MOST_ACCELERATION = 40.0  # by which a body may have changed its velocity while nothing came [m/s^2]
MOST_STAMP = 1e11  # stamps beyond it [s] cannot tell poses 20 us apart; the year 5138
RARE = 3  # gaps longer than ``hold`` in a row that count as no poses at all


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
"""Why a pose is refused, in words."""


@dataclass(frozen=True)
class Tether:
    """The other end of the cable while the payload hangs on it."""

    pos: Vector  # of the other body, expected at the pose's arrival [m]
    length: float  # that the two can be apart [m]; infinite where the other body is not known well


@dataclass(frozen=True)
class GateParams(Bounded):
    """Limits of one body."""

    quat_tolerance: Positive  # of a quaternion's norm from 1 [-]
    max_jump: Positive  # from where the last pose and velocity put the body [m]
    max_speed: Positive  # [m/s]
    # between two poses, beyond max_turn_rate times the time in which nothing came [rad]
    max_turn: Positive
    max_turn_rate: Positive  # [rad/s]
    # stamps that leave the arrivals by more than this are a step of the source's clock [s]
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
    """Decides about one body's poses; ``last`` is the accepted one, ``refused`` counts by reason,
    ``jumped``: the source's reset counter has changed since the last :meth:`restart`.
    """

    def __init__(self, params: GateParams):
        self.params = params
        self.refused: Counter[str] = Counter()
        self.restart()

    def restart(self) -> None:
        """Forget all: the next good pose is taken wherever it is.

        On the ground only, at the operator's word.
        """
        self.last: Pose | None = None
        self.jumped = False
        self._came: Pose | None = None  # last pose in order, accepted or not
        self._changed = -math.inf  # arrival of the last new content [s]
        self._gaps = 0  # longer than hold, in a row

    def check(
        self, pose: Pose, velocity: Vector | None = None, tether: Tether | None = None
    ) -> str | None:
        """Judge a pose, in our frames, by the body's velocity at its last accepted pose [m/s] and
        the cable's other end, where one hangs.

        Returns why it is refused, or None where it is accepted; `REASONS` says what each means."""
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
        # A clock that was set says nothing of how long ago the last pose was; the arrivals do.
        age, gap = (
            max(pose.arrival - earlier.arrival if stepped else pose.stamp - earlier.stamp, 0.0)
            for earlier in (last, previous)
        )
        return self._motion(pose, last, velocity, tether, age, gap)

    def _itself(self, pose: Pose) -> str | None:
        """Return what is wrong with a pose, whatever came before."""
        p = self.params
        if not pose.valid:
            return "invalid"
        # Checked first: without an attitude, numbers in the body's axes are NaN as well.
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
        """Return what is wrong with the way from the last accepted pose of an age [s], after a gap
        in which nothing came at all [s].
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
        ABORT where content is rare.
        """
        if self._gaps >= RARE:
            return ABORT
        age = self.age(time)
        return (age > self.params.warn) + (age > self.params.hold) + (age > self.params.abort)

"""The hand-carry check: an operator carries the vehicle through given moves, and its poses show the
source's axes.

It starts level, with its nose along our x, and rests for a second before and after each move. Three
translations show the world's axes; three rotations show the body's axes and the quaternion's order.
Of 24 sets of axes for world and body each, and two orders, those are found under which the moves
agree best with the instructions."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np
from numpy import ndarray
from numpy.linalg import norm

from hil.errors import RunError
from hil.links.clock import Clock
from hil.poses.frames import FrameParams, Frames
from hil.poses.pose import VEHICLE, Pose
from hil.poses.sources.pose_source import Source
from visthrow.common.rotations import (
    conjugate,
    continuous,
    multiply,
    rotation_vector,
    tilt_and_heading,
    vectors_between,
)
from visthrow.logs.axes import TURNS, turn_of

# limits below which the vehicle counts as resting, above noise of a millimetre and 0.3 deg
SPEED = 0.06  # [m/s]
RATE = 0.25  # [rad/s]
SPAN = 0.2  # interval for speed and rate [s]
REST_TIME = 0.5  # shortest rest [s]
LEAST_WAY = 0.2  # of a move [m]
LEAST_TURN = math.radians(15.0)  # likewise [rad]
POLL_INTERVAL = 0.25  # [s]
TOLERANCE = math.radians(30.0)  # between a move and its axis: people do not move straight [rad]


@dataclass(frozen=True)
class CarryMove:
    """One step of the check."""

    text: str  # for the operator
    turn: bool  # whether it is a rotation, else a translation
    # our axis along or about which it goes; None for a move back, which is not judged
    axis: int | None


MOVES = (
    CarryMove("carry it forward, along our x, by half a metre", False, 0),
    CarryMove("carry it to its left, along our y, by half a metre", False, 1),
    CarryMove("lift it by half a metre", False, 2),
    CarryMove("tip its nose down by 45 deg, and hold it", True, 1),
    CarryMove("bring it level again", True, None),
    CarryMove("tip its right side down by 45 deg, and hold it", True, 0),
    CarryMove("bring it level again", True, None),
    CarryMove("turn it to the left by 90 deg, as seen from above", True, 2),
)


@dataclass(frozen=True)
class MeasuredMove:
    """A move as measured by the source, in its frames."""

    before: Pose  # mean pose of the rest before
    after: Pose  # mean pose of the rest after

    @property
    def way(self) -> ndarray:
        """Change of position [m], shape (3,), source's world."""
        return np.subtract(self.after.pos, self.before.pos)

    @property
    def turn(self) -> float:
        """Angle of the change of attitude [rad], whatever the order of the quaternions."""
        return 2.0 * math.acos(min(abs(float(np.dot(self.before.quat, self.after.quat))), 1.0))

    def turns(self, frames: Frames) -> tuple[ndarray, ndarray]:
        """Return the rotation vectors [rad] of the change of attitude in our world and body."""
        first, second = (frames.quat_from_source(pose.quat) for pose in (self.before, self.after))
        return tuple(
            np.array(rotation_vector(q))
            for q in (multiply(second, conjugate(first)), multiply(conjugate(first), second))
        )


Line = tuple[str, bool]  # judgement of one move: in words, and whether it passed


@dataclass(frozen=True)
class CarryResult:
    """The result of the check."""

    lines: tuple[Line, ...]
    fitting: FrameParams  # under which the moves fit best
    # whether the moves fit a left-handed source: axes are mirrored, or a move went the wrong way
    mirrored: bool
    passed: bool


def find_steps(poses: Sequence[Pose]) -> list[MeasuredMove]:
    """Return the moves between rests from the vehicle's raw poses, in order. Raises `RunError`:
    a pose has no attitude.
    """
    if any(pose.quat is None for pose in poses):
        raise RunError(
            "hand-carry: the vehicle's source gives no attitude; expected a rigid body, not a"
            " marker"
        )
    good = [p for p in poses if np.isfinite([*p.pos, *p.quat]).all() and math.hypot(*p.quat) > 0.5]
    rests = _rests(good)
    steps = [
        MeasuredMove(_mean(good[a.stop - 1 :: -1], a), _mean(good[b.start :], b))
        for a, b in pairwise(rests)
    ]
    return [s for s in steps if norm(s.way) > LEAST_WAY or s.turn > LEAST_TURN]


def _rests(poses: Sequence[Pose]) -> list[slice]:
    if len(poses) < 3:
        return []
    times = np.array([p.arrival for p in poses])
    pos = np.array([p.pos for p in poses])
    quat = np.array([p.quat for p in poses])
    late = np.minimum(np.searchsorted(times, times + SPAN), len(times) - 1)
    early = np.maximum(np.searchsorted(times, times - SPAN, side="right") - 1, 0)
    span = np.maximum(times[late] - times[early], 1e-9)
    # the angle of a rotation does not depend on the order of the quaternions
    rate = norm(vectors_between(quat[early], quat[late]), axis=1) / span
    resting = (norm(pos[late] - pos[early], axis=1) / span < SPEED) & (rate < RATE)
    turns = np.diff(resting, prepend=False, append=False)
    edges = np.flatnonzero(turns).reshape(-1, 2)  # of each rest: its first pose, and one past it
    return [
        slice(start, stop) for start, stop in edges if times[stop - 1] - times[start] >= REST_TIME
    ]


def _mean(poses: Sequence[Pose], span: slice) -> Pose:
    """Return the mean of the poses of a rest next to a move."""
    close = [
        p for p in poses[: span.stop - span.start] if abs(p.arrival - poses[0].arrival) <= REST_TIME
    ]
    quat = continuous(np.array([p.quat for p in close])).mean(axis=0)
    place = tuple(np.mean([p.pos for p in close], axis=0).tolist())
    return replace(close[0], pos=place, quat=tuple((quat / norm(quat)).tolist()))


def judge(steps: Sequence[MeasuredMove], frames: FrameParams) -> CarryResult:
    """Judge each move with the config's frames, and find the frames that fit best. Raises
    `RunError`: the number of moves is not that of `MOVES`.
    """
    if len(steps) != len(MOVES):
        moves = "; ".join(f"{i}. {move.text}" for i, move in enumerate(MOVES, start=1))
        raise RunError(
            f"hand-carry: {len(steps)} moves between rests; expected {len(MOVES)}, a second of rest"
            f" around each: {moves}"
        )
    pairs = [(move, step) for move, step in zip(MOVES, steps) if move.axis is not None]
    ways = [(move.axis, step.way) for move, step in pairs if not move.turn]
    turns = [(move.axis, step) for move, step in pairs if move.turn]
    world = max(TURNS, key=lambda axes: _agreement(turn_of(axes), ways))
    cases = [
        replace(frames, axes=world, body_axes=body, quaternion=order, yaw_offset_deg=0.0)
        for order, body in product(("xyzw", "wxyz"), TURNS)
    ]

    def fit(case: FrameParams) -> float:
        tried = Frames(case)
        vectors = [(axis, vector) for axis, step in turns for vector in step.turns(tried)]
        return round(_agreement(np.eye(3), vectors), 9)

    fitting = replace(max(cases, key=fit), yaw_offset_deg=_yaw(ways, turn_of(world)))
    lines = [*(_line(move, step, frames) for move, step in pairs), _start(steps[0].before, frames)]
    mirrored = bool(np.linalg.det(np.column_stack([way / norm(way) for _, way in ways])) < -0.5)
    return CarryResult(tuple(lines), fitting, mirrored, all(passed for _, passed in lines))


def _agreement(turn: ndarray, vectors: list[tuple[int, ndarray]]) -> float:
    """Return the sum of the cosines between rotated vectors and their axes."""
    return sum(float((turn @ v)[axis] / max(norm(v), 1e-12)) for axis, v in vectors)


def _yaw(ways: list[tuple[int, ndarray]], world: ndarray) -> float:
    """Return the remaining rotation about our z after the exchange of axes [deg]; 0 if it is so
    small that the operator may have caused it.
    """
    forward, leftward = (world @ ways[i][1] for i in (0, 1))
    angle = math.degrees(math.atan2(-forward[1] + leftward[0], forward[0] + leftward[1]))
    return round(angle, 0) if abs(angle) > 10.0 else 0.0


def _line(move: CarryMove, step: MeasuredMove, frames: FrameParams) -> Line:
    ours = Frames(frames)
    motion = step.turns(ours)[1] if move.turn else np.array(ours.world_from_source(tuple(step.way)))
    size = "rad about" if move.turn else "m along"
    length = float(norm(motion))
    angle = math.acos(max(-1.0, min(1.0, motion[move.axis] / max(length, 1e-12))))
    passed = angle <= TOLERANCE and length >= (LEAST_TURN if move.turn else LEAST_WAY)
    numbers = ", ".join(f"{axis} {value:+.2f}" for axis, value in zip("xyz", motion))
    name = move.text.split(",")[0]
    deviation = math.degrees(angle)
    return f"{name}: {numbers} ({size} our axes), {deviation:.0f} deg off", passed


def _start(pose: Pose, frames: FrameParams) -> Line:
    """Return the judgement of the initial attitude: level, with the nose along our x."""
    tilt, heading = tilt_and_heading(Frames(frames).quat_from_source(pose.quat))
    return (
        (
            f"at first: tilted by {math.degrees(tilt):.0f} deg, nose {math.degrees(heading):+.0f}"
            " deg from our x (if the moves pass and this does not, define the rigid body anew,"
            " level and with its nose along x)"
        ),
        max(tilt, abs(heading)) <= TOLERANCE,
    )


def collect(
    source: Source,
    clock: Clock,
    seconds: float,
    tell: Callable[[str], None] = lambda text: None,
    recorded: bool = False,
) -> list[MeasuredMove]:
    """Collect the vehicle's poses until all moves are made or a time [s] is over, or to the end
    of a recording, and return the moves. ``tell``: called with the text of each next move.
    """
    poses: list[Pose] = []
    steps: list[MeasuredMove] = []
    begin = clock.now()
    prompted = -1
    while (
        not source.ended and len(steps) < len(MOVES) and (recorded or clock.now() - begin < seconds)
    ):
        source.wait(clock, clock.now() + POLL_INTERVAL)
        poses += [pose for pose in source.poll(clock.now()) if pose.body == VEHICLE]
        if not recorded:
            steps = find_steps(poses)
            if len(steps) != prompted and len(steps) < len(MOVES):
                prompted = len(steps)
                text = MOVES[prompted].text
                tell(f"{prompted + 1} of {len(MOVES)}: {text}; then hold it still for a second")
    return find_steps(poses)


def summary_text(finding: CarryResult, frames: FrameParams) -> str:
    """Return the result as text."""
    lines = [f"{'PASS' if passed else 'FAIL'}  {text}" for text, passed in finding.lines]
    if finding.mirrored:
        lines.append(
            "the moves fit a mirrored world: it was not carried forward, left and up in this order,"
            " or the source is left-handed"
        )
    for name in ("axes", "body_axes", "quaternion", "yaw_offset_deg"):
        was = getattr(frames, name)
        fits = getattr(finding.fitting, name)
        if was != fits and not finding.passed:
            lines.append(
                f"would fit: {name} = {fits!r}".replace("'", '"')
                + f"  (config: {was!r})".replace("'", '"')
            )
    return "\n".join(lines)

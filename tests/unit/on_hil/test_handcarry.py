"""The hand-carry check on synthetic recordings: every axis case, both quaternion orders, and
carelessness of the carrier.
"""

import math

import numpy as np
from numpy.random import default_rng
from pytest import approx, fixture, mark, raises

from hil.errors import RunError
from hil.links.clock import ManualClock
from hil.poses.frames import FrameParams, Frames
from hil.poses.handcarry import MOVES, MeasuredMove, collect, find_steps, judge, summary_text
from hil.poses.pose import Pose
from hil.poses.sources.pose_source import RecordedSource
from tests.commands import run_command
from visthrow.common.rotations import multiply
from visthrow.logs.axes import TURNS as AXES

OURS = FrameParams("x,y,z", "x,y,z", "xyzw", 0.0, (0.0, 0.0, 0.0))
RATE = 100.0
TURNS = [(3, 1, 0.8), (4, 1, -0.8), (5, 0, 0.8), (6, 0, -0.8), (7, 2, 1.5)]


def smooth(n):
    return 0.5 - 0.5 * np.cos(np.pi * np.arange(n) / n)


def about(axis, angle):
    vector = [0.0, 0.0, 0.0]
    vector[axis] = math.sin(angle / 2)
    return (*vector, math.cos(angle / 2))


def carry(frames: FrameParams, seed=0, moves=8, rest=1.2) -> list[Pose]:
    """Poses of a source with these frames, of a vehicle carried about, not quite straight."""
    rng = default_rng(seed)
    pos, quat, track = np.array([0.3, -0.2, 1.0]), about(2, math.radians(rng.uniform(-5, 5))), []
    ways = {i: 0.5 * np.eye(3)[i] + rng.normal(0, 0.05, 3) for i in range(3)}
    turned = {i: (axis, angle) for i, axis, angle in TURNS}
    for i in range(moves):
        track += [(pos, quat)] * int(rest * RATE)
        for part in smooth(100):
            axis, angle = turned.get(i, (0, 0.0))
            track.append(
                (pos + part * ways.get(i, np.zeros(3)), multiply(quat, about(axis, part * angle)))
            )
        pos, quat = track[-1]
    track += [(pos, quat)] * int(rest * RATE)
    poses = []
    for n, (place, attitude) in enumerate(track):
        jittered = multiply(attitude, (*rng.normal(0, 5e-4, 3), 1.0))
        unit = tuple(x / math.hypot(*jittered) for x in jittered)
        noisy = tuple((place + rng.normal(0, 5e-4, 3)).tolist())
        poses.append(
            Frames(frames).source_from_pose(Pose(n / RATE, n / RATE, "vehicle", noisy, unit))
        )
    return poses


def made(axes="x,y,z", body_axes="x,y,z", quaternion="xyzw") -> FrameParams:
    return FrameParams(axes, body_axes, quaternion, 0.0, (0.0, 0.0, 0.0))


@fixture(scope="module")
def track():
    """Poses in our frames."""
    return carry(OURS)


@fixture(scope="module")
def steps(track):
    """Moves in our frames; each case writes them as its source would."""
    return find_steps(track)


def check(steps, true: FrameParams, config: FrameParams):
    source = Frames(true).source_from_pose
    return judge([MeasuredMove(source(step.before), source(step.after)) for step in steps], config)


@mark.parametrize("axes", AXES)
def test_every_axis_case_is_named(steps, axes):
    for true in (
        made(axes=axes),
        made(body_axes=axes),
        made(axes=axes, body_axes="x,-y,-z", quaternion="wxyz"),
    ):
        right = check(steps, true, true)
        assert right.passed
        assert right.fitting == true
        wrong = check(steps, true, OURS)
        assert wrong.passed == (true == OURS)
        assert wrong.fitting == true
        assert not wrong.mirrored


def test_a_left_handed_world_is_reported(track):
    mirrored = [
        Pose(p.stamp, p.arrival, p.body, (p.pos[0], -p.pos[1], p.pos[2]), p.quat) for p in track
    ]
    judged = judge(find_steps(mirrored), OURS)
    assert judged.mirrored
    assert not judged.passed
    assert "mirrored world" in summary_text(judged, OURS)


def test_moves_that_were_left_out_are_counted():
    with raises(RunError, match=r"5 moves between rests; expected 8.*8\. turn it to the left"):
        judge(find_steps(carry(OURS, moves=5)), OURS)
    with raises(RunError, match="expected 8"):
        judge(find_steps(carry(OURS, rest=0.2)), OURS)
    assert find_steps([]) == []
    with raises(RunError, match="gives no attitude"):
        find_steps([Pose(0.0, 0.0, "vehicle", (0.0, 0.0, 0.0))])
    assert len(MOVES) == 8


def test_a_live_source_asks_for_the_next_move_and_left_when_all_are_made(track):
    prompts, clock = [], ManualClock()
    later = Pose(99.0, 99.0, "vehicle", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    steps = collect(RecordedSource([*track, later]), clock, 60.0, prompts.append)
    assert judge(steps, OURS).passed
    assert [text.split(":")[0] for text in prompts] == [f"{i} of 8" for i in range(1, 9)]
    assert clock.time < 20.0
    clock = ManualClock()
    assert len(collect(RecordedSource(track), clock, 8.0)) < 8
    assert clock.time == approx(8.0, abs=0.3)


@mark.parametrize(("axes", "status"), [("y,x,-z", 0), ("x,-y,-z", 1)])
def test_the_command_on_a_recording(tmp_path, capsys, axes, status):
    path = tmp_path / "carried.csv"
    rows = [(p.stamp, *p.pos, *p.quat) for p in carry(made("y,x,-z", "x,-y,-z", "wxyz"))]
    path.write_text("t,x,y,z,qw,qx,qy,qz\n" + "\n".join(",".join(map(str, row)) for row in rows))
    columns = (
        '[{name="pos_w", columns=["x", "y", "z"], unit="m"}, '
        '{name="quat_wb", columns=["qw", "qx", "qy", "qz"], unit="1", kind="quaternion"}]'
    )
    settings = (
        "source.kind=csv",
        f"source.file={path}",
        'source.time={column="t"}',
        f"source.columns={columns}",
        f'frames.vehicle.axes="{axes}"',
    )
    assert run_command("hil check --hand-carry", sets=settings) == status
    out = capsys.readouterr().out
    assert ("FAIL" in out) == bool(status)
    assert ('would fit: axes = "y,x,-z"' in out) == bool(status)

"""The gate, the track and the clock: refusals, staleness, and steps of a clock."""

import math
from dataclasses import replace

from numpy.testing import assert_allclose
from pytest import approx, mark, raises

from hil.links.clock import MonotonicClock
from hil.poses.body_track import Track
from hil.poses.estimate import EstimateParams
from hil.poses.frames import FrameParams
from hil.poses.gate import ABORT, HOLD, OK, WARN, Gate, GateParams, Tether
from hil.poses.pose import Pose
from visthrow.common.errors import ConfigError

PARAMS = GateParams(0.02, 0.12, 8.0, 0.3, 15.0, 0.5, 0.04, 0.1, 0.25)
LEVEL = (0.0, 0.0, 0.0, 1.0)
FRAMES = FrameParams("x,y,z", "x,y,z", "xyzw", 0.0, (0.0, 0.0, 0.0))


def pose(time=0.0, x=0.0, quat=LEVEL, arrival=None, **more) -> Pose:
    return Pose(time, time if arrival is None else arrival, "vehicle", (x, 0.0, 1.0), quat, **more)


def begun() -> Gate:
    """Return a gate that has taken a pose."""
    gate = Gate(PARAMS)
    assert gate.check(pose()) is None
    return gate


@mark.parametrize(
    ("second", "reason"),
    [
        (pose(0.01, 0.01), None),
        (pose(0.01, math.nan), "finite"),
        (pose(0.01, math.inf), "finite"),
        (pose(0.01, quat=(0.0, 0.0, math.nan, 1.0)), "attitude"),
        (pose(0.01, 0.01, (0.0, 0.0, 0.0, 0.0)), "quaternion"),
        (pose(0.01, 0.5), "speed"),
        (pose(0.01, 0.01, vel=(math.nan, 0.0, 0.0)), "finite"),
        (pose(0.01), "repeated"),
        (pose(0.0, 0.01), "old"),
        (pose(-0.02, 0.01), "old"),
        (pose(0.01, 0.01, reset=1), "reset"),
    ],
)
def test_each_reason(second, reason):
    gate = begun()
    assert gate.check(second, (0.0, 0.0, 0.0)) == reason
    assert gate.refused == ({} if reason is None else {reason: 1})


def turn(angle: float, norm: float = 1.0):
    return (0.0, norm * math.sin(angle / 2.0), 0.0, norm * math.cos(angle / 2.0))


@mark.parametrize(
    ("at", "limit", "reason"),
    [
        (lambda x: pose(0.01, x), 0.12 + 20.0 * 0.01**2, "jump"),  # 0.5 * 40 m/s^2
        (lambda x: pose(0.02, -x), 0.12 + 20.0 * 0.02**2, "jump"),
        (lambda a: pose(0.01, 0.01, turn(a)), 0.3 + 15.0 * 0.01, "turn"),
        (lambda a: pose(0.02, 0.01, turn(-a)), 0.3 + 15.0 * 0.02, "turn"),
        (lambda n: pose(0.01, 0.01, turn(0.0, n)), 1.02, "quaternion"),
        (lambda v: pose(0.01, 0.01, vel=(0.0, -v, 0.0)), 8.0, "speed"),
    ],
)
def test_limits_just_inside_and_just_outside(at, limit, reason):
    for share, expected in ((0.999, None), (1.001, reason)):
        gate = begun()
        assert gate.check(at(share * limit), (0.0, 0.0, 0.0)) == expected


def test_without_a_velocity_the_largest_speed_bounds_the_way():
    for x, expected in ((0.199, None), (0.201, "speed")):
        gate = begun()
        assert gate.check(pose(0.01, x)) == expected


def test_a_swapped_body_is_never_taken_back_by_waiting():
    gate = begun()
    reasons = {gate.check(pose(0.01 * i, 0.4), (0.0, 0.0, 0.0)) for i in range(1, 3)}
    assert reasons <= {"jump", "speed"}
    gate = begun()
    assert gate.check(pose(0.01, 0.01, reset=1)) == "reset"
    assert gate.check(pose(0.02, 0.02)) == "reset", "also when the counter goes back"
    gate.restart()
    assert gate.check(pose(0.03, 0.03)) is None


@mark.parametrize("gap", [0.01, 0.13, 0.2])
def test_bodies_swapped_after_a_gap_are_known_by_the_cable(gap):
    """After 0.13 s without poses the room for a jump is wider than the cable is long."""
    still, tether = (0.0, 0.0, 0.0), Tether((0.43, 0.0, 1.0), 0.6)
    gate = begun()
    swapped = pose(gap, 0.43)
    assert gate.check(swapped, still, tether) == "swapped"
    assert gate.check(pose(gap + 0.01, 0.431), still, tether) == "swapped", "nor by waiting"
    assert gate.check(pose(gap + 0.02, 0.02), still, tether) is None, "back in its own place"
    if gap > 0.1:
        gate = begun()
        assert gate.check(swapped, still) is None, "without the cable it would have been taken"


def test_a_body_farther_off_than_the_cable_is_long():
    """After a gap another body's pose may lie within the room of a jump; a body that goes its way
    is followed, whatever has come off.
    """
    still, gap = (0.0, 0.0, 0.0), 0.1
    gate = begun()
    assert gate.check(pose(gap, 0.2), still, Tether((-0.5, 0.0, 1.0), 0.69)) == "cable"
    assert gate.check(pose(gap + 0.01, 0.05), still, Tether((-0.5, 0.0, 1.0), 0.54)) is None, (
        "where it was to be"
    )


def test_rare_poses_are_as_good_as_none():
    gate = Gate(PARAMS)
    times = [0.01 * i for i in range(10)] + [0.09 + 0.2 * i for i in range(1, 5)]
    levels = []
    for i, time in enumerate(times):
        assert gate.check(pose(time, 0.001 * i), (0.0, 0.0, 0.0)) is None
        levels.append(gate.level(time))
    assert levels == [OK] * 12 + [ABORT] * 2, "5 Hz from 0.09 s on: the third gap ends it"
    assert gate.check(pose(times[-1] + 0.01, 0.02), (0.0, 0.0, 0.0)) is None
    assert gate.level(times[-1] + 0.01) == OK


def test_staleness_is_of_content_not_of_arrival():
    gate = Gate(PARAMS)
    assert gate.level(0.0) == ABORT
    gate.check(pose(1.0))
    levels = []
    for i in range(1, 40):
        now = 1.0 + 0.01 * i
        assert gate.check(pose(now)) == "repeated"
        levels.append(gate.level(now))
    first = {level: 0.01 * (levels.index(level) + 1) for level in (OK, WARN, HOLD, ABORT)}
    assert first[OK] == 0.01
    for level, limit in ((WARN, 0.04), (HOLD, 0.10), (ABORT, 0.25)):
        assert limit <= first[level] <= limit + 0.011


@mark.parametrize("quat", [(math.nan,) * 4, (0.0,) * 4, (0.0, math.nan, 0.0, 1.0)])
def test_a_single_marker_is_a_position(quat):
    """The vehicle's attitude is needed, a ball's is not. An untracked body gives no pose."""
    for turns, reason in ((True, "quaternion"), (False, None)):
        reason = "attitude" if turns and math.isnan(sum(quat)) else reason
        for offset in ((0.1, 0.0, 0.0), (0.0, 0.0, 0.0)):  # which an attitude turns
            frames = replace(FRAMES, marker_offset_b=offset)
            track = Track(frames, PARAMS, EstimateParams(0.055, 2), turns)
            assert track.update(pose(0.0, 0.1, quat)) == reason
        zeros = Pose(1.0, 1.0, "payload", (0.0, 0.0, 0.0), quat)
        assert track.update(zeros) == "invalid"
        assert track.update(pose(0.01, 0.1, valid=False)) == "invalid"
        assert track.gate.refused["invalid"] == 2


def test_a_stamp_that_is_no_time_spoils_no_velocity():
    track = Track(FRAMES, PARAMS, EstimateParams(0.055, 2))
    assert track.update(Pose(1e300, 0.0, "vehicle", (0.0, 0.0, 1.0), LEVEL)) == "stamp"
    for i in range(1, 8):
        assert track.update(pose(0.01 * i, 0.01 * i)) is None
    assert track.state(0.07).vel == approx((1.0, 0.0, 0.0))


def test_wrong_limits():
    for ages in ((0.1, 0.04, 0.25), (0.04, 0.1, 0.1), (0.04, 0.3, 0.25), (0.1, 0.1, 0.25)):
        with raises(ConfigError, match="ascending"):
            GateParams(0.02, 0.12, 8.0, 0.3, 15.0, 0.5, *ages)
    with raises(ConfigError, match=r"quat_tolerance is 0.0; expected above 0"):
        GateParams(0.0, 0.12, 8.0, 0.3, 15.0, 0.5, 0.04, 0.1, 0.25)


def track() -> Track:
    return Track(FRAMES, PARAMS, EstimateParams(0.025, 1))


@mark.parametrize("step", [1.0, -1.0])
def test_a_step_of_the_sources_clock_costs_nothing(step):
    body = track()
    for i in range(60):
        time = 0.01 * i
        stamp = time + (step if i >= 30 else 0.0)
        assert body.update(pose(stamp, 0.5 * time, arrival=time)) is None
        if i > 2:
            assert_allclose(body.state(time).vel, (0.5, 0.0, 0.0), atol=1e-9)
    assert body.accepted == 60


def test_the_monotonic_clock_keeps_its_speed():
    clock = MonotonicClock(4.0)
    start = clock.now()
    clock.sleep_until(start + 0.08)
    assert 0.08 <= clock.now() - start < 1.0
    with raises(ValueError, match="above 0"):
        MonotonicClock(0.0)

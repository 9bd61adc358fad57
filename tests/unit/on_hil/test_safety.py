"""The guard's limits and the fence: each axis, both directions, just inside and just outside."""

import math
from dataclasses import replace

from pytest import approx, mark
from scipy.spatial.transform import Rotation

from hil.control.safety import (
    FenceParams,
    Guard,
    GuardParams,
    box_violation,
    failed_checks,
    fence_violation,
)
from hil.poses.body_track import BodyState
from tests.hil_flight import params

DECELERATION = 12.0  # m/s^2
FENCE = FenceParams(
    vehicle_low=(-2.5, -2.0, 0.3),
    vehicle_high=(2.4, 2.2, 2.8),
    payload_low=(-3.0, -3.0, -0.05),
    payload_high=(3.0, 3.0, 3.0),
    deceleration=DECELERATION,
)
MIDDLE = (0.0, 0.0, 1.5)
NEAR = 0.01  # m or N beside a limit


def body(pos=MIDDLE, vel=(0.0, 0.0, 0.0)) -> BodyState:
    return BodyState(pos, (0.0, 0.0, 0.0, 1.0), vel, (0.0, 0.0, 0.0), 0.0)


def move(axis: int, value: float, start=MIDDLE) -> tuple[float, ...]:
    return tuple(value if i == axis else x for i, x in enumerate(start))


@mark.parametrize("axis", range(3))
@mark.parametrize("side", [-1, 1])
def test_the_vehicle_is_stopped_where_it_could_not_brake(axis, side):
    limit = (FENCE.vehicle_low if side < 0 else FENCE.vehicle_high)[axis]
    distance = 0.4
    speed = math.sqrt(2.0 * DECELERATION * distance)  # stops within the distance exactly
    still = move(axis, limit - side * distance)
    for factor, broken in ((0.99, False), (1.01, True)):
        vehicle = body(still, move(axis, side * speed * factor, (0.0, 0.0, 0.0)))
        reason = fence_violation(FENCE, vehicle, None)
        assert bool(reason) is broken, (axis, side, factor)
        assert not broken or "braking point" in reason
    away = body(still, move(axis, -side * speed * 1.01, (0.0, 0.0, 0.0)))
    assert fence_violation(FENCE, away, None) is None, "moving away from the wall is no danger"


@mark.parametrize("axis", range(3))
@mark.parametrize("side", [-1, 1])
def test_vehicle_and_payload_have_separate_boxes(axis, side):
    for name, low, high in (
        ("vehicle", FENCE.vehicle_low, FENCE.vehicle_high),
        ("payload", FENCE.payload_low, FENCE.payload_high),
    ):
        limit = (low if side < 0 else high)[axis]
        for shift, broken in ((-NEAR, False), (NEAR, True)):
            place = body(move(axis, limit + side * shift))
            vehicle, payload = (place, None) if name == "vehicle" else (body(), place)
            reason = fence_violation(FENCE, vehicle, payload)
            assert bool(reason) is broken, (name, axis, side, shift)
            assert not broken or reason.startswith(f"{name} {'xyz'[axis]}")


def test_a_payload_that_flies_is_not_watched():
    assert fence_violation(FENCE, body(), None) is None
    assert box_violation((0.0, 0.0, 0.0), (-1.0,) * 3, (1.0,) * 3) is None


def guard_of(thrust: float, rate: tuple[float, float, float]) -> Guard:
    """Return a guard of a 14 N vehicle that limits the change of commands."""
    return Guard(GuardParams(slew_thrust=thrust, slew_rate=rate), 14.0, (10.0, 9.0, 8.0))


@mark.parametrize("axis", range(4))
@mark.parametrize("side", [-1, 1])
def test_the_guard_limits_each_command_and_its_change(axis, side):
    guard = guard_of(3.0, (4.0, 5.0, 6.0))
    slew, high = (3.0, 4.0, 5.0, 6.0)[axis], (14.0, 10.0, 9.0, 8.0)[axis]
    low = 0.0 if axis == 0 else -high
    start = [7.0, 0.0, 0.0, 0.0]
    assert guard.check(tuple(start)) == tuple(start)
    limit = high if side > 0 else low
    command = list(start)
    command[axis] = limit + side * 5.0
    sent, steps = guard.check(tuple(command)), 1
    assert sent[axis] == approx(start[axis] + side * slew), "one step of the slew limit"
    while sent[axis] != limit:
        sent, steps = guard.check(tuple(command)), steps + 1
        assert steps < 10
    assert guard.clipped == steps
    assert guard.slewed == steps - 1 or abs(limit - start[axis]) % slew == 0.0
    assert sent[:axis] + sent[axis + 1 :] == tuple(start[:axis] + start[axis + 1 :])


def test_after_a_reset_any_command_within_the_limits_passes():
    guard = guard_of(1.0, (1.0, 1.0, 1.0))
    guard.check((0.0, 0.0, 0.0, 0.0))
    guard.reset()
    assert guard.check((14.0, 10.0, 9.0, 8.0)) == (14.0, 10.0, 9.0, 8.0)


@mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@mark.parametrize("axis", range(4))
def test_what_is_not_finite_is_refused_and_counted(bad, axis):
    guard = guard_of(1.0, (1.0, 1.0, 1.0))
    command = [7.0, 0.0, 0.0, 0.0]
    command[axis] = bad
    assert guard.check(tuple(command)) is None
    assert guard.refused == 1


@mark.parametrize(
    ("configured_deg", "heading_deg", "good"),
    [(0.0, 9.0, True), (0.0, 11.0, False), (175.0, -176.0, True), (-175.0, 174.0, False)],
)
def test_a_heading_is_compared_across_180_degrees(configured_deg, heading_deg, good):
    check = replace(params().check, heading_deg=configured_deg, heading_tolerance_deg=10.0)
    quat = tuple(Rotation.from_euler("z", heading_deg, degrees=True).as_quat())
    vehicle, payload = replace(body(), quat=quat), body((0.0, 0.0, 1.0))
    failed = failed_checks(check, FENCE, vehicle, payload, (1.0, 0.0, 0.0), MIDDLE, 0.5)
    assert [text.split()[0] for text in failed] == ([] if good else ["heading"])

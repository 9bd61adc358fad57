"""The runner on a vehicle of a few lines: a throw, and every fault with the reaction and delay."""

import math
from dataclasses import replace

import numpy as np
from pytest import approx, mark

from hil.control.hovering import Hovering
from hil.control.state_machine import Inputs, Machine
from hil.control.tick.commander import can_hand_over
from hil.control.tick.runner import OperatorInput, Runner
from hil.links.backends.base import HOLD, Status
from hil.poses.body_track import BodyState
from hil.poses.detection import Detection, Detections
from tests.hil_flight import HOVER, TICK, Spy, changes, fly, params, simple_policy

NEVER = (HOVER, 0.0, 0.0, 0.0, -1.0)
AT_ONCE = (HOVER, 0.0, 0.0, 0.0, 1.0)
LAG = 0.11


def runner(action=AT_ONCE, *overrides, mechanism=0.0, **kwargs) -> Runner:
    return Runner(params(*overrides), simple_policy(action), Spy(), mechanism, **kwargs)


def safe(pilot: Runner, decisions) -> None:
    """Invariants of every run: finite, clipped commands, and at most one release, and that in a
    throw.
    """
    for _, command in pilot.backend.sent:
        assert all(map(math.isfinite, command))
        assert 0.0 <= command[0] <= 14.0
        assert np.all(np.abs(command[1:]) <= (10.0, 10.0, 4.0))
    assert len(pilot.backend.release_times) <= 1
    assert all(d.state == "throw" for d in decisions if d.release)


def throw(*args, action=AT_ONCE, overrides=(), seconds=12.0, **kwargs):
    pilot = runner(action, *overrides)
    decisions = fly(pilot, seconds, **kwargs)
    safe(pilot, decisions)
    return pilot, decisions


def when(decisions, state: str) -> float:
    return next(d.time for d in decisions if d.state == state)


def test_a_throw_from_idle_to_done():
    pilot, decisions = throw(seconds=20.0)
    assert [state for state, _ in changes(decisions)] == [
        "idle",
        "check",
        "ready",
        "armed",
        "throw",
        "recover",
        "land",
        "done",
    ]
    latch = next(d.time for d in decisions if d.release)
    assert pilot.backend.release_times == [approx(latch + LAG)], (
        "no mechanism: the runner waits the trained lag"
    )
    assert when(decisions, "recover") == approx(latch + LAG, abs=TICK)
    (landing,) = pilot.latch.landings
    np.testing.assert_allclose(landing.landing_w, (0.0, 0.0, 0.04), atol=0.02)
    assert landing.error == approx(2.0, abs=0.02)
    fall = math.sqrt(2 * (1.333 - pilot.hang - 0.04) / 9.81)
    assert landing.duration == approx(LAG + fall, abs=0.02)
    assert not pilot.errors


def test_one_word_of_the_operator_is_one_throw():
    words = lambda time, state: OperatorInput(arm=state == "ready" and time < 3)  # noqa: E731
    pilot, decisions = throw(overrides=("throws=2",), seconds=20.0, words=words)
    assert decisions[-1].state == "ready"
    assert len(pilot.backend.release_times) == 1


START = 3.0  # the policy that never releases throws from about 2.1 s to 7.1 s


def test_a_body_that_was_reset_on_the_ground_is_taken_again():
    _, decisions = throw(
        action=NEVER,
        poses=lambda t, poses: [replace(p, reset=int(t > 0.5)) for p in poses],
        status=lambda t: Status(t > 2.5),
        seconds=6.0,
    )
    assert decisions[-1].state == "throw"


def test_a_payload_that_reappears_in_its_fall_is_farther_off_than_its_cable():
    latch = next(d.time for d in throw()[1] if d.release)

    def blink(time, poses):
        gone = latch + LAG + 0.05 < time < latch + LAG + 0.25
        return [p for p in poses if not (gone and p.body == "payload")]

    pilot, _ = throw(poses=blink)
    assert pilot.tracks["payload"].gate.refused == {}
    assert len(pilot.latch.landings) == 1


@mark.parametrize(
    ("speed", "tilt_deg", "able"),
    [(0.9, 19.0, True), (1.1, 0.0, False), (0.0, 21.0, False), (0.0, math.nan, False)],
)
def test_a_vehicle_that_is_slow_and_level_is_handed_over(speed, tilt_deg, able):
    half = 0.5 * math.radians(tilt_deg)
    quat = (math.sin(half), 0.0, 0.0, math.cos(half))
    assert can_hand_over(BodyState((0.0,) * 3, quat, (0.0, speed, 0.0), (0.0,) * 3, 0.0)) is able


def test_a_release_that_waits_for_late_commands_is_not_stopped_before_its_time():
    pilot, ticks, stops = runner(AT_ONCE, "delay.command=0.05", "delay.compensate=true"), [0.0], []
    pilot.backend.stop_release = lambda: stops.append(ticks[-1])
    fly(pilot, 5.0, watch=lambda time, decision: ticks.append(time))
    latch = pilot.latch.command_time - LAG - 0.05
    assert pilot.backend.release_times == [approx(latch + LAG + 0.05)]
    assert stops[0] >= pilot.backend.release_times[0] - TICK


@mark.parametrize(("share", "throws"), [(0.1, True), (1.05, True), (1.3, False)])
def test_another_hover_thrust_than_the_weights_forbids_a_throw_unless_it_stands(share, throws):
    pilot = runner(NEVER)
    pilot.thrust_tolerance = 0.1
    thrust = share * pilot.mass * 9.81
    decisions = fly(pilot, 5.0, status=lambda time: Status(True, thrust=thrust))
    assert ("throw" in {d.state for d in decisions}) is throws


def test_errors_are_not_integrated_while_the_vehicle_follows_another():
    pilot, resets = runner(NEVER), []
    pilot.hovering.reset = lambda: resets.append(1)
    fly(pilot, 3.0, status=lambda time: Status(True, mode=HOLD))
    assert len(resets) > 50


def test_a_payload_that_rolls_on_after_its_landing_keeps_no_vehicle_from_being_calm():
    def roll(time, poses):
        way = max(time - START, 0.0)
        return [replace(p, pos=(p.pos[0] + way * (p.body == "payload"), *p.pos[1:])) for p in poses]

    _, decisions = throw(poses=roll, seconds=9.0)
    assert "hovering again" in {reason for _, reason in changes(decisions)}


def test_a_vehicle_that_the_autopilot_holds_is_calm_away_from_its_hover_point():
    pilot = runner(NEVER)
    fly(pilot, 2.0)
    pilot.params = replace(pilot.params, home_w=(0.5, 0.0, 1.333))
    estimate = pilot.estimator.estimate(2.0)
    assert [pilot.is_calm(estimate, holding) for holding in (True, False)] == [True, False]


def test_a_hover_has_a_share_after_a_second_and_descends_to_the_ground():
    hovering = Hovering((0.0, 0.0, 0.01), 0.0, 14.0, TICK)
    for _ in range(50):
        assert hovering.share() is None
        hovering.note(1.1)
        hovering.descend()
    assert hovering.share() == approx(1.1)
    assert hovering.place_w == (0.0, 0.0, 0.0)


@mark.parametrize(
    ("overrides", "message"),
    [
        (
            ('frames.vehicle.quaternion="wxyz"', 'frames.payload.quaternion="wxyz"'),
            "heading|tilted",
        ),
        (('frames.vehicle.axes="y,-x,z"', 'frames.payload.axes="y,-x,z"'), "heading"),
        (("home_w=[1.0, 0.0, 1.333]",), "from its hover point"),
        ((), "bodies exchanged"),
    ],
)
def test_the_checks_before_a_throw(overrides, message):
    def poses(time, poses):
        if "bodies exchanged" not in message:
            return poses
        vehicle, payload = poses
        return [replace(vehicle, body=payload.body), replace(payload, body=vehicle.body)]

    pilot, decisions = throw(overrides=(*overrides, "states.check=1.5"), seconds=4.0, poses=poses)
    state, reason = changes(decisions)[2]
    assert state == "abort"
    assert any(word in reason for word in message.split("|")), reason
    assert not pilot.backend.sent, "nothing was ever sent"


GOAL = (
    'frames.goal={axes="x,y,z", body_axes="x,y,z", quaternion="xyzw", yaw_offset_deg=0.0,'
    " marker_offset_b=[0.0, 0.0, 0.0]}"
)


@mark.parametrize("x", [2.0, 9.0])
def test_a_goal_that_moves_is_looked_for_in_the_fence_once_it_is_visible(x):
    """The configured goal, which would lie outside, is none then."""

    def with_goal(time, poses):
        noise = 1e-4 * math.sin(1e3 * time)
        return (
            [*poses, replace(poses[0], body="goal", pos=(x + noise, 0.0, 0.0))] if poses else poses
        )

    overrides = (GOAL, "goal_w=[9.0, 0.0, 0.0]", "states.check=1.5")
    _, decisions = throw(overrides=overrides, seconds=4.0, poses=with_goal)
    state, reason = changes(decisions)[2]
    assert (state, "goal x 9.00 m beyond" in reason) == (
        ("ready", False) if x == 2.0 else ("abort", True)
    )


def test_a_payload_that_comes_off_takes_no_pose_of_the_vehicle_with_it():
    """The runner gets no report of it; the vehicle, without the load, drifts away, and is followed.

    The throw is over.
    """
    begun = START + 0.02

    def spoil(time, poses):
        fall = min(max(time - begun, 0.0) ** 2 * 0.5 * 9.81, 0.8)
        return [
            replace(p, pos=(*p.pos[:2], p.pos[2] - fall * (p.body == "payload"))) for p in poses
        ]

    pilot, decisions = throw(action=NEVER, poses=spoil, seconds=START + 0.6)
    assert pilot.tracks["vehicle"].gate.refused == {}
    assert changes(decisions)[-1] == ("recover", "the payload has come off by itself")
    assert when(decisions, "recover") < begun + 0.2, "a fall of the tolerance, 10 cm"


@mark.parametrize("name", ["ball", "goal"])
def test_no_throw_on_pictures_that_do_not_show(name):
    """Detected in the hover and then lost, the goal sends the runner back to ready; detected again,
    it throws.
    """
    hidden = (1.6, 2.6)
    ahead = np.array([[-0.1, -0.8, 0.7], [0.1, -0.8, 0.7], [0.1, -0.6, 0.7], [-0.1, -0.6, 0.7]])
    corners = tuple(map(tuple, (ahead / np.linalg.norm(ahead, axis=1, keepdims=True)).tolist()))
    shown = {"goal": corners, "ball": (0.0, 0.1, math.sqrt(0.99), 0.08)}
    pilot = runner(NEVER)
    pilot.detections = Detections(pilot.pilot.camera, 0.1)

    def watch(time, decision):
        rays_by_thing = {
            thing: None if thing == name and hidden[0] <= time < hidden[1] else rays
            for thing, rays in shown.items()
        }
        older, newest = Detection(time - 0.01, None, None), Detection(time, *rays_by_thing.values())
        pilot.estimator.take_detections([older, newest])

    decisions = fly(pilot, hidden[1] + 2.0, watch=watch)
    begun = when(decisions, "throw")
    assert hidden[1] < begun < hidden[1] + 1.5
    assert any(f"the pictures show no {name}" in d.waits for d in decisions)


def break_policy(pilot: Runner, act):
    """Replace what the policy does from `START` on; returns what watches a flight for that."""

    def watch(time, decision):
        if time > START:
            pilot.pilot.act = act

    return watch


def not_finite(pilot: Runner, value: float):
    """A policy's step whose command is no number, and which requests the release."""
    act = pilot.pilot.act

    def broken(*args):
        command = np.full((1, 4), value, np.float32)
        return replace(act(*args), command=command, release=np.array([True]))

    return broken


@mark.parametrize("value", [math.nan, math.inf])
def test_a_policy_that_puts_out_no_numbers(value):
    pilot = runner(NEVER)
    decisions = fly(pilot, 5.0, watch=break_policy(pilot, not_finite(pilot, value)))
    safe(pilot, decisions)
    assert "is not finite" in changes(decisions)[-1][1]
    assert not pilot.backend.release_times, "what it says of the release counts for nothing either"
    assert when(decisions, "abort") == approx(START, abs=2 * TICK)
    assert not pilot.errors


def test_an_abort_in_mid_throw_holds_the_place_where_it_happened():
    """Pitching slowly, the vehicle has gone some way ahead when the policy's numbers end."""
    pilot = runner((HOVER, 0.0, 0.02, 0.0, -1.0))
    spoil, places = break_policy(pilot, not_finite(pilot, math.nan)), []

    def watch(time, decision):
        spoil(time, decision)
        if decision.state == "abort":
            places.append((pilot.tracks["vehicle"].state(time).pos[0], pilot.hovering.place_w[0]))

    fly(pilot, START + 0.2, watch=watch)
    assert places[0][0] > 0.15
    assert places[1][1] == approx(places[1][0], abs=0.02)


def test_no_exception_leaves_the_runner():
    pilot = runner(NEVER)

    def broken(*args):
        raise ZeroDivisionError("in flight")

    decisions = fly(pilot, 5.0, watch=break_policy(pilot, broken))
    safe(pilot, decisions)
    assert changes(decisions)[-1] == ("abort", "ZeroDivisionError: in flight")
    assert "in flight" in pilot.errors[0]


OUTSIDE = {"vehicle_high": (-0.5, 2.5, 2.8)}
"""Bounds that the vehicle is beyond [m]."""


def narrow_fence(pilot, state, bounds):
    """Return what gives the fence other bounds [m] from a state on."""
    tight = replace(pilot.params.fence, **bounds)

    def watch(time, decision):
        if decision.state == state:
            object.__setattr__(pilot.params, "fence", tight)

    return watch


def test_a_fence_that_is_left_after_the_throw_lands_and_is_no_abort():
    """The payload is off, the vehicle brakes: what was to be done is done.

    It comes down at once, and says why.
    """
    pilot = runner(AT_ONCE, "throws=2")
    decisions = fly(pilot, 20.0, watch=narrow_fence(pilot, "recover", OUTSIDE))
    safe(pilot, decisions)
    assert [state for state, _ in changes(decisions)][-4:] == ["throw", "recover", "land", "done"]
    assert when(decisions, "land") - when(decisions, "recover") <= 2 * TICK
    assert dict(changes(decisions))["land"].startswith("after the throw, fence: vehicle x")
    assert (pilot.summary()["aborted"], len(pilot.latch.landings)) == (False, 1)
    assert pilot.summary()["left_fence"].startswith("vehicle x")


def test_a_fence_that_is_left_with_the_payload_on_still_aborts():
    pilot = runner(NEVER, "states.throw=1.0")
    decisions = fly(pilot, 20.0, watch=narrow_fence(pilot, "recover", OUTSIDE))
    safe(pilot, decisions)
    assert dict(changes(decisions))["recover"] == "the policy did not release in time"
    assert dict(changes(decisions))["abort"].startswith("fence: vehicle x")


@mark.parametrize(
    ("sends", "ended"), [(True, ["check", "ready", "abort"]), (False, ["check", "ready"])]
)
def test_a_fence_that_others_leave_ends_no_run_that_looks_on(sends, ended):
    """A recorded throw brakes below the floor: the observing runner flies nothing.

    A vehicle of ours comes down.
    """
    machine, states = Machine(runner().params.states, 1, patient=True, sends=sends), []
    for tick in range(500):
        states.append(
            machine.step(
                tick * TICK, Inputs(0, 0, fence="vehicle's braking point z" if tick > 300 else None)
            )
        )
    assert list(dict.fromkeys(states)) == ended


def test_a_throw_that_does_not_begin_says_what_is_in_the_way():
    """The vehicle drifts while it is armed, beyond where a throw may begin; then the thrust is
    wrong. Neither is called a swing.
    """
    pilot = runner(AT_ONCE, "states.armed=1.5", "states.armed_least=1.0")
    pilot.decider.thrust_problems = lambda: (
        ["hovering takes 1.10 times the weight"] if pilot.machine.state == "armed" else []
    )
    decisions = fly(pilot, 5.0)
    assert ("ready", "disarmed: hovering takes 1.10 times the weight") in changes(decisions)
    waits = [d.waits for d in decisions if d.state == "armed"]
    assert "hovering takes 1.10 times the weight" in waits[1]
    assert all(d.waits == "" for d in decisions if d.state == "throw")


def test_a_release_outside_of_the_fence_is_refused():
    """The payload hangs outside of its fence from the policy's release request on."""
    pilot = runner(AT_ONCE)
    decisions = fly(
        pilot, 5.0, watch=narrow_fence(pilot, "armed", {"payload_low": (-3.0, -3.0, 1.2)})
    )
    safe(pilot, decisions)
    assert not pilot.backend.release_times


class HoldingSpy(Spy):
    """An autopilot that holds and lands by itself, and records the times of requests."""

    holds = True

    def __init__(self):
        super().__init__()
        self.times = []

    def ask(self, mode, now):
        if mode != "follow":
            self.times.append(now)

    def abort(self, now):
        self.times.append(now)


@mark.parametrize("reported", [False, True])
def test_a_tilted_vehicle_without_poses_is_levelled_before_it_is_handed_over(reported):
    """By dead reckoning, with the rates that the autopilot reports and without."""
    tilting = (HOVER, 0.0, 0.5, 0.0, -1.0)
    pilot = Runner(params(), simple_policy(tilting), HoldingSpy())
    tilts, gone = {}, []

    def stopped(time, poses):
        x, y, _, _ = poses[0].quat
        tilts[round(time, 2)] = math.acos(1.0 - 2.0 * (x * x + y * y))
        if gone or tilts[round(time, 2)] > math.radians(60.0):
            gone.append(time)
            return []
        return poses

    def status(time):
        rates = pilot.commander._last_command[1:] if reported else None
        return Status(True, rates=rates)

    fly(pilot, 4.0, poses=stopped, status=status)
    handed = round(pilot.backend.times[0], 2)
    assert math.degrees(max(tilts.values())) > 80.0, "the policy goes on for a while"
    assert math.degrees(tilts[handed]) < 25.0
    assert handed - gone[0] < 0.4


def test_a_payload_that_returns_farther_off_than_its_cable_is_refused():
    gap = 0.13  # after it a jump of 0.4 m would pass

    def spoil(time, poses):
        if time <= START:
            return poses
        vehicle, payload = poses
        x, y, z = payload.pos
        low = replace(payload, pos=(x, y, z - 0.4))
        return [vehicle] if time <= START + gap else [vehicle, low]

    pilot, _ = throw(action=NEVER, poses=spoil, seconds=START + 0.4)
    assert pilot.tracks["payload"].gate.refused["cable"] > 10


def test_without_poses_it_is_levelled_and_falls_silent_in_the_end():
    gone = lambda time, poses: poses if time <= START else []  # noqa: E731
    _, decisions = throw(action=NEVER, poses=gone, seconds=6.0)
    levelled = [d for d in decisions if d.note.startswith("level")]
    assert levelled[0].command[1:] == approx((0.0, 0.0, 0.0), abs=0.2)
    assert decisions[-1].command is None, "the autopilot's failsafes act"

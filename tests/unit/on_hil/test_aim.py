"""Predicted landings: closed forms, and the refusal of releases that miss."""

import math

import numpy as np
from pytest import approx, mark
from scipy.integrate import solve_ivp

from hil.control.aim import AimParams, ReleaseCheck
from hil.control.tick.runner import Runner
from hil.poses.body_track import BodyState
from tests.hil_flight import AT_ONCE, Spy, fly, params

ROPE = {"payload_mass": 0.058}
AHEAD, HEIGHT = 0.12, 0.04


def at(pos, vel) -> BodyState:
    return BodyState(pos, None, vel, (0.0, 0.0, 0.0), 0.0)


def integrate_fall(pos, vel, drag):
    """By an integrator with steps of its own; drag per mass [1/m]."""

    def motion(_, y):
        return [*y[3:], *(-drag * np.linalg.norm(y[3:]) * y[3:] - [0.0, 0.0, 9.81])]

    def down(_, y):
        return y[2] - HEIGHT

    down.terminal, down.direction = True, -1.0
    start = [*(np.array(pos) + AHEAD * np.array(vel)), *vel]
    return solve_ivp(motion, (0.0, 5.0), start, events=down, rtol=1e-10, atol=1e-12).y_events[0][
        0, :2
    ]


@mark.parametrize("drag", [0.0, 1.04e-3])
@mark.parametrize("vel", [(4.0, 0.3, 2.0), (-1.0, 2.0, -3.0), (0.0, 0.0, 0.0)])
def test_prediction_against_an_integrator(vel, drag):
    pos = (0.4, -0.1, 1.2)
    landing = ReleaseCheck(None, AHEAD, HEIGHT, {**ROPE, "payload_drag": drag}).predict_landing(
        at(pos, vel)
    )
    assert landing == approx(integrate_fall(pos, vel, drag / 0.058), abs=2e-3)


def test_a_payload_below_the_ground_or_without_end_is_judged():
    aim = ReleaseCheck(None, AHEAD, HEIGHT, ROPE)
    assert aim.predict_landing(at((1.0, 2.0, -0.1), (0.0, 0.0, -1.0))) == approx((1.0, 2.0))
    assert all(map(math.isfinite, aim.predict_landing(at((1.0, 2.0, 1.0), (0.0, 0.0, 100.0)))))


def test_what_is_held_back_and_when_it_is_given_up():
    aim, goal = (
        ReleaseCheck(AimParams(bound=0.5, patience=0.4), AHEAD, HEIGHT, ROPE),
        (2.0, 0.0, 0.0),
    )
    good, bad = at((0.5, 0.0, 1.2), (2.4, 0.0, 1.5)), at((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    aim.begin()
    assert aim.miss(1.0, good, goal) is None
    assert "2.00 m from the goal, within 0.5 m expected" in aim.miss(1.1, bad, goal)
    assert aim.miss(1.2, good, goal) is None, "the policy may ask again"
    for x, y in ((2.51, 0.0), (1.49, 0.0), (2.0, 0.51), (2.0, -0.51), (2.36, 0.36)):
        near = at((2.0 + 0.95 * (x - 2.0), 0.95 * y, 1.0), (0.0, 0.0, 0.0))
        assert aim.miss(1.25, near, goal) is None
        assert aim.miss(1.25, at((x, y, 1.0), (0.0, 0.0, 0.0)), goal)
    assert aim.miss(1.3, bad, goal)
    assert (aim.has_given_up(1.49), aim.has_given_up(1.51), aim.refused) == (False, True, 7)
    aim.begin()
    assert not aim.has_given_up(9.0)
    assert ReleaseCheck(None, AHEAD, HEIGHT, ROPE).miss(1.0, bad, goal) is None, (
        "without a table all is let go"
    )


def test_a_policy_that_asks_in_hover_never_releases():
    """It requests the release at every tick; the throw ends after the patience, and the vehicle
    hovers on with its payload.
    """
    runner = Runner(
        params("aim.bound=0.8", "aim.patience=0.3"),
        AT_ONCE,
        Spy(),
    )
    decisions = fly(runner, 5.0)
    refusals = [d for d in decisions if d.note.startswith("release refused: it would land at")]
    assert runner.backend.release_times == []
    assert refusals[-1].time - refusals[0].time == approx(0.28, abs=0.021)
    assert all(d.observation[19] < 0.5 for d in refusals), (
        "the policy must not learn of a release: there was none"
    )
    states = [d.state for d in decisions]
    assert states[decisions.index(refusals[-1]) + 1] == "recover"
    assert (
        decisions[decisions.index(refusals[-1]) + 1].reason
        == "the policy released where it would miss"
    )
    assert runner.summary()["held_back"] == len(refusals)
    assert "abort" not in states

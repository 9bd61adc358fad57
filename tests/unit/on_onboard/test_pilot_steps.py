"""Observations after steps that were late or missing: a history of steps a period apart, as in
training.
"""

import numpy as np
import torch
from numpy.testing import assert_allclose
from pytest import approx, mark

from tests.hil_flight import simple_policy
from visthrow.onboard.observations import RESPONSE, resample
from visthrow.onboard.pilot import Pilot
from visthrow.onboard.policy import Policy

PERIOD = 0.02
LEVEL = np.array([[0.0, 0.0, 0.0, 1.0]])
STILL, GOAL = np.zeros((1, 3)), np.array([2.0, 0.0, 0.0])


def observe(pilot: Pilot, time: float, now: float | None):
    """Observation of a payload that moves evenly."""
    payload = np.array([[0.1 + 0.9 * time, -0.4 * time, -0.38 + 0.2 * time]])
    speed = np.array([[1.5 * time, -time, 0.3]])
    return pilot.act(STILL, LEVEL, speed, 2.0 * speed, payload, GOAL, True, None, now).observation


def responsive():
    """A policy that is given the response of earlier steps too."""
    policy = simple_policy((-0.1, 0.0, 0.0, 0.0, -1.0))
    contract = {
        **policy.contract,
        "observation": {**policy.contract["observation"], "response": 8},
    }
    contract["observation"]["dimension"] = policy.obs_dim + 8 * RESPONSE
    return Policy(
        (torch.zeros(5, contract["observation"]["dimension"]),), policy.biases, "relu", contract
    )


def fly_pilot(times, timed=True, policy=None):
    """Observations of a pilot whose steps come at some times [periods]."""
    pilot = Pilot(policy or simple_policy((-0.1, 0.0, 0.0, 0.0, -1.0)))
    return [observe(pilot, PERIOD * t, PERIOD * t if timed else None) for t in times][-1]


@mark.parametrize(
    "times",
    [
        [0, 1, 2, 3, 4, 6],  # one missed
        [0, 1, 2, 3, 6],  # two
        [0, 1, 2, 6],  # more than the history is long
        [0, 1, 2, 3.7, 4, 5, 6],  # one late, the next ones in time
        [0, 1, 2, 3, 4, 5.9, 6],
        [0, 2, 5, 6],
    ],
)
def test_a_history_with_gaps_is_that_of_regular_steps(times):
    even = fly_pilot(range(7), timed=False)
    assert_allclose(fly_pilot(times), even, atol=2e-6)
    assert np.abs(fly_pilot(times, timed=False) - even).max() > 5e-3, "without the times it is not"


@mark.parametrize(
    "times", [[0, 1, 2, 3, 4, 6], [0, 1, 2, 9], [0, 1, 2, 3, 3.7, 4.2, 5, 6, 7, 8, 9, 10.7, 11]]
)
def test_a_response_with_gaps_is_that_of_regular_steps(times):
    speeds = [
        fly_pilot(t, timed, responsive())[:, -8 * RESPONSE :].reshape(8, RESPONSE)[:, :6]
        for t, timed in ((times, True), (range(times[-1] + 1), False), (times, False))
    ]
    assert_allclose(speeds[0], speeds[1], atol=2e-6)
    assert np.abs(speeds[2] - speeds[1]).max() > 5e-3, "without the times it is not"


def test_what_is_older_than_the_throw_is_its_first_step():
    history = torch.tensor([[[4.0], [1.0], [1.0], [1.0]]])
    resampled = resample(history, torch.tensor([[8.0]]), [0.04, 0.06], PERIOD)
    assert resampled[0, :, 0].tolist() == approx([6.0, 4.0, 1.0, 1.0])


def test_a_release_that_was_not_done_is_not_reported():
    pilot = Pilot(simple_policy((-0.1, 0.3, 0.0, 0.0, 1.0)))
    before = pilot.previous_action[0, 4]
    observe(pilot, 0.0, 0.0)
    assert pilot.previous_action[0, 4] == 1.0
    pilot.cancel_release()
    assert pilot.previous_action[0].tolist() == approx([-0.1, 0.3, 0.0, 0.0, before])
    observe(pilot, PERIOD, PERIOD)
    pilot.cancel_release()
    assert pilot.previous_action[0, 4] == before, "nor when it is requested again"

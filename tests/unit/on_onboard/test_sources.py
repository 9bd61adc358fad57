"""A vision policy's inputs on goal and payload: keypoints and their validity bits alone, as the
camera reports them.
"""

import numpy as np
from numpy.testing import assert_array_equal
from pytest import mark

from visthrow.onboard.pilot import Pilot
from visthrow.throws.loading import load_policy

GROUPS = ("goal", "payload", "validity")
STEPS = 12


def observations(name, seed):
    """Observations of a throw whose vehicle and actions are the same for all seeds, and whose
    keypoints, validity bits, goal and payload are not; with these bits of the last step.
    """
    loaded = load_policy(name)
    pilot, rng = Pilot(loaded.policy, loaded.experiment.camera), np.random.default_rng(seed)
    shown = []
    for step in range(STEPS):
        points, valid = rng.uniform(-0.3, 0.3, (1, 8, 2)), rng.random((1, 8)) > 0.3
        pilot._previous = np.full((1, 5), 0.01 * step, dtype=np.float32)
        out = pilot.act(
            np.array([[0.02 * step, 0.0, 1.3]]),
            np.array([[0.0, 0.0, 0.0, 1.0]]),
            np.array([[0.5, 0.0, 0.1 * step]]),
            np.zeros((1, 3)),
            rng.standard_normal((1, 3)),
            np.append(rng.standard_normal((1, 2)), [[0.0]], axis=1),
            keypoints=(points.astype(np.float32), valid),
        )
        shown.append(out.observation[0])
        assert not np.shares_memory(out.valid, valid)
    return np.array(shown), pilot.layout, valid[0]


def find_changes(name):
    """Columns that differ between two throws of other keypoints, goals and payloads."""
    (one, layout, _), (two, _, _) = observations(name, 1), observations(name, 2)
    return set(np.flatnonzero((one != two).any(0))), layout


@mark.parametrize("name", ["vision", "vision_betaflight"])
def test_nothing_but_keypoints_tells_of_goal_and_payload(name):
    columns, layout = find_changes(name)
    assert columns == set(layout.columns(*GROUPS))
    assert not layout.fits


def test_what_an_estimator_adds_is_found():
    """The check is not vacuous: of a located layout more columns differ."""
    columns, layout = find_changes("vision_located")
    assert columns & set(layout.columns("located"))
    assert columns <= set(layout.columns(*GROUPS, "located"))


def test_validity_bits_are_the_cameras():
    shown, layout, valid = observations("vision", 3)
    assert_array_equal(shown[-1, layout.columns("validity")], valid)
    shown, layout, valid = observations("vision_located", 3)
    bits = shown[-1, layout.columns("validity")]
    assert_array_equal(bits[4:], valid[4:])
    assert bits[:4].sum() >= valid[:4].sum()

"""The foreign generator: null worlds are the tool's model but for the noise, hidden ones are not;
answers are judged as they should be.
"""

import numpy as np
from pytest import mark

from bench.diagnose import foreign
from visthrow.diagnose.models.flyer import FlyerModel

NOISE = 2e-4 * np.sqrt(2.0)
"""Deviation of its double exponential noise [m]."""


def off(world: dict, name: str) -> float:
    """Deviation of what its owner's model leaves of a short flight [m]."""
    log = foreign.flown(world, np.random.default_rng(5), seconds=4.0)
    gap = np.linalg.norm(log["payload_pos_w"].values - log["pos_w"].values, axis=1)
    assert np.abs(gap - world["cable"]).max() < 12.0 * NOISE
    return float(np.std(np.concatenate(FlyerModel([log], foreign.known(name)).residuals({}))))


@mark.parametrize("vehicle", [0, 1])
def test_a_world_without_a_hidden_effect_is_what_its_owner_expects(vehicle):
    name, hidden, world = foreign.drawn(6 * vehicle)
    assert (name, hidden) == (("crazyflie", "five_inch")[vehicle], "")
    assert off(world, name) < 1.2 * NOISE
    for i, kind in enumerate(foreign.FOREIGN):
        _, hidden, other = foreign.drawn(12 * i + 6 * vehicle + 1)
        assert hidden == kind
        assert off(world | {kind: other[kind]}, name) > 4.0 * NOISE


def test_worlds_differ_and_every_effect_is_hidden_by_some_seed():
    assert {foreign.drawn(seed)[1] for seed in range(600)} == {
        "",
        *foreign.FOREIGN,
        *foreign.HIDDEN,
    }
    for seed in range(40):
        _, hidden, world = foreign.drawn(seed)
        base = foreign.CRAFT[foreign.drawn(seed)[0]] | {"gain": 1.0}
        changed = {
            key for key, value in world.items() if key != "J" and value != base.get(key, 0.0)
        }
        assert changed == (
            {hidden} if hidden in foreign.FOREIGN else {foreign.HIDDEN[hidden]} if hidden else set()
        )


@mark.parametrize(
    ("hidden", "groups", "overall", "judged"),
    [
        ("", [], "NO EFFECT", "right"),
        ("", [], "UNKNOWN", "unsure"),
        ("", [{"wind_x"}], "KNOWN", "false"),
        ("beat", [{"wind_x"}], "EXPLAINED IN PART", "part"),
        ("wake", [{"wind_x"}], "UNKNOWN", "part"),
        ("swirl", [], "UNKNOWN", "unknown"),
        ("swirl", [], "NO EFFECT", "missed"),
        ("swirl", [{"wind_x"}], "KNOWN", "false"),
        ("lag", [], "NO EFFECT", "missed"),
        ("mass_quad", [{"mass_quad"}], "KNOWN", "right"),
        ("mass_quad", [{"mass_quad", "thrust_gain"}], "KNOWN", "class"),
        ("mass_quad", [{"mass_quad", "wind_x"}], "KNOWN", "false"),
        ("mass_quad", [{"mass_quad"}, {"wind_x"}], "KNOWN", "false"),
        ("mass_quad", [{"thrust_gain"}], "KNOWN", "false"),
    ],
)
def test_answers_are_judged(hidden, groups, overall, judged):
    assert foreign.judged(hidden, groups, overall) == judged

"""The reference's two ropes against each other: universal joints in C, and directions without twist
in NumPy.
"""

from dataclasses import replace

import numpy as np
from numpy.linalg import norm
from pytest import mark

from tests.oracle.bare_rope import BareScene
from tests.oracle.converged import converged
from tests.plants import SCENES
from tests.scenes import load_scene

CONVERGED = 1e-6
"""Doubling the oracle's step moves the whip, the harsher scene, by 1.7e-7 m, halving it by 1.4e-11
m [m].
"""
SAME_ROPE = 1e-8
"""Without damping they are one rope; 0.25 ms at order 4 leaves 1e-10 m or less within 0.1 s [m]."""


def hard_throw(**changes):
    return replace(load_scene(SCENES / "hard_throw.toml"), **changes)


def apart(run, bare):
    """Largest distance of ball and quadrotor [m]."""
    ball = norm(run.ball_pos_w[-1] - bare.ball[0])
    return max(ball, norm(run.pos_w[-1] - bare.body[:3]))


@mark.parametrize("name", ["hard_throw", "whip"])
def test_oracle_is_converged(name):
    scene = load_scene(SCENES / f"{name}.toml")
    fine, coarse = converged(scene, 20e-6), converged(scene, 40e-6)
    assert np.abs(fine.ball_pos_w - coarse.ball_pos_w).max() < CONVERGED
    assert np.abs(fine.pos_w - coarse.pos_w).max() < CONVERGED


@mark.parametrize("segments", [1, 3, 15])
def test_two_ropes_agree_without_damping(segments):
    scene = hard_throw(
        segments=segments,
        segment_length=0.33 / segments,
        segment_mass=0.004 / segments,
        joint_damping=0.0,
        cable_rate_w=(1.0, 3.0, -2.0),
        rate_b=(0.5, -1.0, 2.0),
        duration=0.1,
    )
    bare = BareScene(scene, 2.5e-4)
    bare.advance(0.1)
    run = converged(scene)
    assert apart(run, bare) < SAME_ROPE
    assert np.abs(bare.rope[0] - run.cable_dir_w[-1]).max() < 1e-5


def test_fold_beyond_a_right_angle():
    """Directions along +-y of the parent are where universal joints are singular; the plant's rope
    passes them.
    """
    scene = hard_throw(direction=(0.0, 1.0, 0.02), duration=0.02)
    fine, coarse = BareScene(scene, 1e-4), BareScene(scene, 5e-4)
    for bare in (fine, coarse):
        bare.advance(scene.duration)
    assert np.all(np.isfinite(fine.body))
    assert norm(fine.ball[0] - coarse.ball[0]) < 1e-7

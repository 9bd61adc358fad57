"""The rope's recursion and its integrator against converged MuJoCo runs of the same bodies.

MuJoCo's joints are universal: they pass the twist of a turning vehicle on and damp it, a string and
our recursion do not. With the damping of the scenes that is worth 0.03 mm; the tests of the order
leave the damping out."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.linalg import norm
from pytest import mark

from sim.kernels.state import NONFINITE
from tests.oracle.converged import OracleRun, run_converged
from tests.plants import SCENES
from tests.scenes import Scene, load_scene
from tests.simulators import Flight, fly

POSITION = 1e-3
"""A thirtieth of the landing error that a policy is to reach [m]."""
VELOCITY = 1e-2
"""Over a flight of half a second it is worth 5 mm [m/s]."""
FINE_POSITION = 1e-4
"""At an eighth of the step: order 2 would give a 64th; float32 and the twist's damping leave 0.03
mm each [m].
"""
ORDER = 1.8
"""Order 2 at steps where the next power is still seen."""
CONVERGED = 1e-6
"""Doubling the oracle's step moves the whip, the harsher scene, by 1.7e-7 m, halving it by 1.4e-11
m [m].
"""
RESOLVED = {1: 2e-3, 3: 5e-4}
"""Segments and a step [s] that resolves their fastest mode: one swings at 6 rad/s, three at 200
rad/s when taut.
"""


@lru_cache
def oracle(scene: Scene) -> OracleRun:
    return run_converged(scene)


def errors(flight: Flight, run: OracleRun) -> tuple[float, float, float]:
    """Vehicle [m], ball [m], ball's velocity [m/s]."""
    return (
        norm(flight.pos_w - run.pos_w[-1]),
        norm(flight.ball_pos_w - run.ball_pos_w[-1]),
        norm(flight.ball_vel_w - run.ball_vel_w[-1]),
    )


@mark.parametrize("name", ["hard_throw", "whip"])
def test_the_oracle_has_converged(name):
    scene = load_scene(SCENES / f"{name}.toml")
    fine, coarse = oracle(scene), run_converged(scene, 40e-6)
    assert np.abs(fine.ball_pos_w - coarse.ball_pos_w).max() < CONVERGED
    assert np.abs(fine.pos_w - coarse.pos_w).max() < CONVERGED


@mark.parametrize(
    ("step", "near", "slow", "name", "precision"),
    [
        (2e-3, POSITION, VELOCITY, "hard_throw", "float32"),
        (2e-3, POSITION, VELOCITY, "pull_back", "float32"),
        (2.5e-4, FINE_POSITION, np.inf, "hard_throw", "float64"),
    ],
)
def test_a_throw_is_as_accurate_as_its_step(step, near, slow, name, precision):
    scene = load_scene(SCENES / f"{name}.toml")
    vehicle, ball, velocity = errors(fly(scene, step, precision), oracle(scene))
    assert vehicle < near
    assert ball < near
    assert velocity < slow


def test_the_violent_whip_converges():
    """Slack three times as deep, snapped to 170 rad/s: a limit case whose errors grow a
    thousandfold, MuJoCo's too.

    No step of milliseconds follows it; what must hold is that nothing fails and that finer steps
    lead to the oracle."""
    scene = load_scene(SCENES / "whip.toml")
    coarse = fly(scene, 2e-3, "float32")
    assert not coarse.status & NONFINITE
    assert max(errors(coarse, oracle(scene))[:2]) < 0.2
    fine, finer = (max(errors(fly(scene, h, "float64"), oracle(scene))[:2]) for h in (2e-4, 5e-5))
    assert finer < 5e-3
    assert finer < fine / 4.0


def coarse_rope(segments: int) -> Scene:
    """The hard throw with a rope of few segments, without damping."""
    scene = load_scene(SCENES / "hard_throw.toml")
    return replace(
        scene,
        segments=segments,
        segment_length=0.33 / segments,
        segment_mass=0.004 / segments,
        joint_damping=0.0,
    )


@mark.parametrize("segments", RESOLVED)
def test_order_of_the_step(segments):
    """Against MuJoCo, and by three steps of our own, which needs no other code."""
    scene = coarse_rope(segments)
    run = run_converged(scene, 40e-6)
    flights = [fly(scene, RESOLVED[segments] / k, "float64") for k in (1, 2, 4)]
    for part in range(2):
        against = [errors(flight, run)[part] for flight in flights]
        assert np.log2(against[0] / against[1]) > ORDER
        assert np.log2(against[1] / against[2]) > ORDER
    for name in ("pos_w", "ball_pos_w", "ball_vel_w"):
        first, second, third = (getattr(flight, name) for flight in flights)
        assert np.log2(norm(first - second) / norm(second - third)) > ORDER

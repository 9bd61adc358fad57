"""The reference plant against closed forms and conservation laws."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
from pytest import mark, raises

from sim.reference.plant import ReferencePlant
from tests.plants import paper_plant, plain_plant
from visthrow.common.free_fall import fall_time, free_flight

LEVEL = np.array([[0.0, 0.0, 0.0, 1.0]])
STILL = np.zeros((1, 3))
HIGH = np.array([[0.0, 0.0, 1.5]])


def start_swinging(plant, step):
    """A plant whose rope starts at 0.5 rad and swings down."""
    reference = ReferencePlant(plant, step=step)
    direction = np.tile([np.sin(0.5), 0.1, -np.cos(0.5)], (1, plant.rope.segments, 1))
    reference.reset(HIGH, LEVEL, STILL, STILL, direction)
    return reference


def test_steps_of_the_plant_have_converged():
    """Queue, controller, battery, aerodynamics, rope: halving 0.5 ms moves nothing by a micrometre
    in 0.14 s.
    """
    ends = []
    for step in (5e-4, 2.5e-4):
        reference = start_swinging(paper_plant(), step)
        for k in range(7):
            reference.step(np.array([[3.5, 1.0, -2.0 + 0.6 * k, 0.5]]), True)
        ends.append(reference.state)
    assert np.abs(ends[0].pos_w - ends[1].pos_w).max() < 1e-6
    assert np.abs(ends[0].payload_pos_w - ends[1].payload_pos_w).max() < 1e-6
    assert_allclose(ends[0].attached, False)


def test_a_rope_folds_beyond_a_right_angle():
    """Directions along +-y of the parent are where universal joints are singular; the plant's rope
    passes them.
    """
    ends = []
    for step in (5e-4, 1e-4):
        reference = ReferencePlant(plain_plant(), step=step)
        direction = np.tile([0.0, 1.0, 0.02], (1, reference.params.rope.segments, 1))
        reference.reset(HIGH, LEVEL, STILL, STILL, direction)
        reference.step(np.array([[2.6, 0.0, 0.0, 0.0]]))
        ends.append(reference.state.payload_pos_w)
    assert_allclose(ends[0], ends[1], atol=1e-7)


@mark.parametrize("step", [2e-3, 1.3e-3])  # a landing lies within a step, of whatever length
def test_landing_equals_the_closed_form_without_rope_mass(step):
    """A rope of 10 mg: the ball flies a parabola from separation."""
    plain = plain_plant()
    rope = replace(plain.rope, segments=2, rope_mass=1e-5, joint_damping=0.0)
    release = replace(plain.release, lag=0.04)
    plant = replace(plain, rope=rope, release=release)
    reference = start_swinging(plant, step)
    command = np.array([[2.6, 0.0, 0.0, 0.0]])
    for k in range(10):
        reference.step(command, k == 8)
    opened = reference.state
    assert not opened.attached[0]
    p, v = opened.payload_pos_w[0], opened.payload_vel_w[0]
    time = fall_time(p[2] - plant.release.landing_height, v[2])
    for _ in range(int(time / 0.02) + 1):
        reference.step(command)
    landing = reference.landing
    assert landing.landed[0]
    assert abs(landing.time[0] - opened.time - time) < 1e-5
    assert_allclose(landing.point_w[0], free_flight(p, v, time), atol=1e-6)


def test_wrong_shapes_are_named():
    reference = ReferencePlant(plain_plant())
    with raises(ValueError, match=r"cable_dir_w has shape \(1, 3, 3\), expected \(1, 15, 3\)"):
        reference.reset(HIGH, LEVEL, STILL, STILL, np.zeros((1, 3, 3)))
    with raises(ValueError, match="step is 0"):
        ReferencePlant(plain_plant(), step=0.0)

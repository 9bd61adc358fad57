"""The vehicle that a firmware flies: its stand, its rotors, its sensors."""

import numpy as np
from pytest import approx, fixture, mark

from visthrow.throws.wire_plant import GRAVITY, make_motors

REFERENCE = 15.2
"""Voltage of the thrust map [V]."""

FULL = 3.5
"""Thrust of a rotor at full command and that voltage [N]."""


@fixture(params=["vision", "vision_betaflight"])
def plant(request):
    """The paper's vehicle: by its own controller's full thrust, and by that of a firmware's at the
    voltage of its calibration.
    """
    return make_motors(request.param, 3)


def command_for(plant, thrust):
    """Motor command at which the four rotors give a thrust [N] at the present voltage."""
    return np.sqrt(thrust / 4 / FULL) * REFERENCE / plant.look()["voltage"]


def fly(plant, command, seconds):
    for _ in range(round(seconds / plant.period)):
        plant.step(np.broadcast_to(command, 4), False)


def test_it_stands_until_its_rotors_carry_it(plant):
    start = plant.state["pos_w"].copy()
    weight = plant.mass[0] * GRAVITY
    fly(plant, command_for(plant, 0.7 * weight), 1.0)
    assert plant.held
    assert plant.state["pos_w"] == approx(start)
    assert plant.force_b == approx([0.0, 0.0, GRAVITY])
    fly(plant, command_for(plant, 1.1 * weight), 0.5)
    assert not plant.held
    assert plant.state["vel_w"][2] > 0.0


def test_thrust_goes_with_the_square_of_the_command_and_is_what_the_accelerometer_shows(plant):
    """``f = k_f (full_speed u V / V_ref)^2`` a rotor, over the mass that it carries; the rope hangs
    straight meanwhile.
    """
    weight = plant.mass[0] * GRAVITY
    fly(plant, command_for(plant, 1.3 * weight), 0.4)
    slow = plant.look()["motor_speed"].mean()
    fly(plant, 1.5 * command_for(plant, weight), 0.15)
    assert plant.look()["motor_speed"].mean() > slow
    thrust = (plant.look()["motor_speed"] ** 2).sum() * FULL / 4000.0**2
    assert plant.force_b[2] * plant.mass[0] == approx(
        thrust, rel=0.12
    )  # inflow and drag take their share


@mark.parametrize(
    ("more", "axis", "sign"),
    [((1, 0, 1, 0), 0, 1.0), ((0, 0, 1, 1), 1, 1.0), ((1, 0, 0, 1), 2, 1.0)],
    ids=["left rolls right", "rear pitches the nose down", "clockwise rotors yaw left"],
)
def test_rotors_turn_the_body_about_the_right_axis(plant, more, axis, sign):
    hover = command_for(plant, 1.05 * plant.mass[0] * GRAVITY)
    fly(plant, hover, 0.3)
    fly(plant, hover + 0.02 * np.array(more), 0.1)
    rate = sign * plant.rate_b
    assert rate[axis] > 0.05
    assert np.abs(np.delete(rate, axis)).max() < 0.3 * rate[axis]


def test_the_ball_separates_the_mechanisms_lag_after_the_latch(plant):
    hover = command_for(plant, 1.02 * plant.mass[0] * GRAVITY)
    fly(plant, hover, 0.4)
    latch_time = plant.time
    for _ in range(60):
        plant.step(np.full(4, hover), True)
    assert plant.landing["separation_time"] - latch_time == approx(0.06, abs=1e-6)


def test_it_stands_on_the_ground_it_came_down_to_and_takes_off_again(plant):
    """Whoever flies it finds out that it has landed, and may disarm."""
    fly(plant, command_for(plant, 1.1 * plant.weight), 0.3)
    fly(plant, command_for(plant, 0.7 * plant.weight), 2.0)
    assert plant.held
    assert plant.touchdown > 1.0
    height = plant.state["pos_w"][2]
    assert height == approx(0.08)
    assert plant.state["payload_pos_w"][2] >= 0.033
    assert plant.force_b == approx([0.0, 0.0, GRAVITY])
    fly(plant, command_for(plant, 1.2 * plant.weight), 0.5)
    assert plant.state["pos_w"][2] > height + 0.05

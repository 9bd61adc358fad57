"""The simulator's blocks and rope where mechanics has a formula."""

from dataclasses import replace

import numpy as np
from numpy.linalg import norm
from numpy.testing import assert_allclose
from pytest import approx, mark
from scipy.special import ellipk

from sim.hybrid import HybridSim
from sim.kernels.state import NONFINITE
from sim.params import GRAVITY, BodyParams, PlantParams, QueueParams, change_values
from tests.plants import EVERYTHING, calm, paper_plant
from tests.simulators import bare_quadrotor, numerics, rods

PERIOD = 1e-4
"""Of a pendulum's period; order 2 at 2 ms leaves (w h)^2 = 2e-4 of the phase, less by the method's
constant.
"""
HELD = 2e3
"""Mass of a vehicle that the rope hardly moves [kg]: by 3e-5 of its own motion."""


def advance(sim, steps: int) -> None:
    """Step, and see to it that no step was undone."""
    for _ in range(steps):
        sim.step()
        assert not np.any(sim.get("status") & NONFINITE)


@mark.parametrize("amplitude", [0.05, 1.2])
def test_pendulum_period(amplitude):
    """One rigid segment swings as a physical pendulum:

    ``T = 4 sqrt(I / (m g c)) K(sin^2(amplitude / 2))``; the vehicle above is too heavy to move.
    """
    plant = paper_plant()
    rope = replace(plant.rope, mount=(0.0, 0.0, 0.0), segments=1, joint_damping=0.0)
    reach = rope.length + rope.payload_offset
    inertia = (
        rope.rope_mass * rope.length**2 / 3.0 + rope.payload_inertia + rope.payload_mass * reach**2
    )
    moment = rope.rope_mass * rope.length / 2.0 + rope.payload_mass * reach
    rate = np.sqrt(moment * GRAVITY / inertia)
    period = 4.0 / rate * ellipk(np.sin(amplitude / 2.0) ** 2)
    body = BodyParams(HELD, (0.01 * HELD,) * 3)
    strong = replace(plant.vehicle.controller, max_thrust=HELD * GRAVITY)
    vehicle = replace(plant.vehicle, body=body, controller=strong, queue=QueueParams(0.0))
    steps = numerics(0.002, "float64", period / 100)
    sim = HybridSim(PlantParams(vehicle, rope, plant.release, steps), 1, direct=True)
    sim.place(
        np.zeros((1, 3)), cable_dir_w=np.array([[[np.sin(amplitude), 0.0, -np.cos(amplitude)]]])
    )
    sim.set_command([[sim.params.total_mass * GRAVITY, 0.0, 0.0, 0.0]])
    advance(sim, 325)
    x, _, z = sim.get("cable_dir_w")[0, 0]
    late = np.arctan2(x, -z) / (2.0 * rate * np.sin(amplitude / 2.0))
    assert late == approx(0.0, abs=PERIOD * 3.25 * period)
    assert norm(sim.get("pos_w")) < 1e-3, "the vehicle was to be held"


def test_battery_counts_its_charge():
    """The used fraction grows by the current: power over voltage over capacity, in hover steady but
    for the sag.
    """
    sim = bare_quadrotor(
        replace(paper_plant().vehicle, queue=QueueParams(0.0)), 1, precision="float64"
    )
    vehicle = sim.vehicles[0]
    weight = vehicle.body.mass * GRAVITY
    sim.set_command([[weight, 0.0, 0.0, 0.0]])
    voltage, speed = sim.get("voltage")[0], sim.get("motor_speed")[0, 0]
    power = (
        vehicle.battery.idle_power
        + weight * vehicle.thrust.torque_ratio * speed / vehicle.battery.efficiency
    )
    advance(sim, 50)
    expected = power / voltage / 3600.0 / vehicle.battery.capacity
    assert sim.get("charge_used")[0] == approx(expected, rel=0.05)


def test_a_push_accelerates_all_that_hangs():
    """The vehicle's mass, the rope's and the ball's as well. The kernel is the one of all tests of
    extensions.
    """
    plant = change_values(paper_plant(), {"sim.precision": "float64"})
    sim = HybridSim(plant, 1, extensions=EVERYTHING)
    sim.set_command([[GRAVITY * plant.total_mass, 0.0, 0.0, 0.0]])
    sim.set_wrench([[0.2, 0.0, 0.0]], [[0.0, 0.0, 0.0]])
    advance(sim, 1)
    masses, _, _, velocities, _ = rods(sim)
    momentum = plant.vehicle.body.mass * sim.get("vel_w")[0, 0] + masses @ velocities[0, :, 0]
    assert momentum == approx(0.2 * 0.02, rel=1e-2)


def test_external_wrench():
    """Force over mass and torque over inertia, added to a vehicle whose controller and air do
    nothing.
    """
    vehicle = paper_plant().vehicle
    none = (0.0, 0.0, 0.0)
    gains = {"p_gain": none, "i_gain": none, "d_gain": none, "feedforward_gain": none}
    idle = replace(vehicle.controller, min_thrust=0.0, **gains)
    vehicle = replace(vehicle, controller=idle, aero=calm(vehicle.aero), queue=QueueParams(0.0))
    sim = bare_quadrotor(vehicle, 2, "rk4", 0.002, precision="float64", gravity=0.0)
    sim.set_wrench([[0.3, -0.2, 0.1], [0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0], [0.0, 0.0, 1e-4]])
    advance(sim, 10)
    time = 0.2
    expected = np.array([0.3, -0.2, 0.1]) / vehicle.body.mass * time
    assert_allclose(sim.get("vel_w"), [expected, np.zeros(3)], atol=1e-12)
    assert_allclose(sim.get("pos_w")[0], expected * time / 2.0, atol=1e-12)
    spun = [0.0, 0.0, 1e-4 / vehicle.body.inertia[2] * time]
    assert_allclose(sim.get("rate_b"), [np.zeros(3), spun], atol=1e-12)

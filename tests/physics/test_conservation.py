"""What a free chain of vehicle, rope and ball must keep: energy and linear momentum."""

from dataclasses import replace

import numpy as np
from pytest import approx, mark
from scipy.spatial.transform import Rotation

from sim.hybrid import HybridSim
from sim.params import LawParams
from tests.plants import EVERYTHING, SCENES
from tests.scenes import Wrench, load_scene
from tests.simulators import energy, momentum, place_scene, scene_plant, scene_sim

DRIFT = 5e-3
"""Of the energy in 1.2 s at 2 ms."""
ROUND_OFF = {"float32": 1e-5, "float64": 1e-12}
"""Momentum [kg m/s]; the rates below give 0.24 kg m/s."""
ENERGY_ROUND_OFF = {"float32": 5e-6, "float64": 1e-12}
"""Of the energy; float32 states hold seven digits."""
DISSIPATION = 0.01
"""Of the dissipated energy; the integrator's own loss at 0.25 ms is a few millionths of the whole
energy.
"""
STEPS = 60
"""Of 20 ms."""
FRICTION = 5e-4
"""Of a rope's mount [N m s]."""
MOVED = 0.02
"""Rate [rad/s] and speeds [m/s] that this friction changes at least."""
HELD = 2e-3
"""Share of the change by which a law differs, that is held over a step of 0.25 ms."""


def free(**changes):
    """The hard throw's bodies, undamped, unpushed, the vehicle tumbling and the rope
    swinging fast.
    """
    scene = load_scene(SCENES / "hard_throw.toml")
    nothing = (Wrench(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),)
    start = {
        "schedule": nothing,
        "joint_damping": 0.0,
        "rate_b": (5.0, -8.0, 3.0),
        "cable_rate_w": (2.0, 15.0, 1.0),
    }
    return replace(scene, **{**start, **changes})


@mark.parametrize("precision", ["float32", "float64"])
def test_free_chain_keeps_energy_and_momentum(precision):
    sim = scene_sim(free(), 2e-3, precision, 0.02, gravity=0.0)
    sim.set_command(np.zeros((1, 4)))
    energies, momenta = [], []
    for _ in range(STEPS):
        energies.append(energy(sim)[0])
        momenta.append(momentum(sim)[0])
        sim.step()
    lost = 1.0 - np.array(energies) / energies[0]
    assert np.abs(lost).max() < DRIFT
    assert lost.min() > -ENERGY_ROUND_OFF[precision], "energy grew"
    assert np.abs(np.array(momenta) - momenta[0]).max() < ROUND_OFF[precision]


def relative_rates(sim):
    """Angular velocity of every rod against what it hangs from [rad/s], shape (L, 3)."""
    rate_w = Rotation.from_quat(sim.get("quat_wb")).apply(sim.get("rate_b"))
    rods = np.cross(sim.get("cable_dir_w"), sim.get("cable_vel_w"))[0]
    return np.diff(np.concatenate((rate_w, rods)), axis=0)


def test_joint_damping_takes_what_its_law_says():
    """Power of the couples -d (w_i - w_(i-1)) is -d |w_i - w_(i-1)|^2; integrated by the
    trapezoidal rule.
    """
    damping, period = 1e-5, 5e-4
    sim = scene_sim(free(joint_damping=damping), 2.5e-4, "float64", period, gravity=0.0)
    sim.set_command(np.zeros((1, 4)))
    energies, powers = [energy(sim)[0]], [damping * np.square(relative_rates(sim)).sum()]
    for _ in range(400):
        sim.step()
        energies.append(energy(sim)[0])
        powers.append(damping * np.square(relative_rates(sim)).sum())
    expected = period * (np.sum(powers) - 0.5 * (powers[0] + powers[-1]))
    assert energies[0] - energies[-1] == approx(expected, rel=DISSIPATION)


def test_a_linear_torque_in_the_ropes_joint_is_the_mounts_friction():
    """A law's pair of forces and torque do to vehicle, rod and ball what the couple in the chain's
    own equations does.
    """
    scene = free(
        segments=1, segment_length=0.5, rate_b=(1.0, -4.0, 3.0), cable_rate_w=(2.0, 6.0, 1.0)
    )
    plant = scene_plant(scene, 2.5e-4, "float64", 0.01)
    rubbing = replace(plant.rope, mount_damping=FRICTION)
    law = LawParams("rope joint", (), "joint_rate", FRICTION)
    ends = []
    for same in (plant, replace(plant, rope=rubbing), replace(plant, laws=(law,))):
        sim = HybridSim(same, 1, gravity=0.0, extensions=EVERYTHING)
        place_scene(sim, scene)
        sim.set_command([[2.0, 0.0, 0.0, 0.0]])
        for _ in range(20):
            sim.step()
        ends.append(
            np.concatenate(
                [np.ravel(sim.get(name)) for name in ("rate_b", "vel_w", "payload_vel_w")]
            )
        )
    without, rubbed, lawful = ends
    moved = np.abs(rubbed - without)
    assert np.all(moved.reshape(3, 3).max(1) > MOVED)
    assert np.abs(lawful - rubbed).max() < HELD * moved.max()

"""Effects that a kernel holds only if built for them, against the reference plant and scipy; off, they are not there."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from sim.hybrid import HybridSim
from sim.params import GRAVITY, AirParams
from sim.reference.extras import ReferenceExtras
from sim.reference.plant import ReferencePlant
from sim.standalone import QuadSim
from sim.structs import EXTENSIONS, extensions_of
from tests.plants import paper_plant, plain_vehicle
from visthrow.bench.flops import env_step

EVERYTHING = frozenset(EXTENSIONS)
"""One build for all: what is built in and stands at zero changes nothing."""
STEPS = 12  # of 20 ms
AGREEMENT = 3e-4  # m; both integrate with steps of 0.5 and 1 ms, which alone leaves 0.2 mm after such a swing
DISTINCT = 10.0  # times that agreement an effect must move the payload for the test to say anything


def fine(plant):
    """The plant in float64 with a step of 1 ms."""
    return dataclasses.replace(plant, sim=dataclasses.replace(plant.sim, precision="float64", substep=1e-3))


def swing(plant, effect=None):
    """Positions of vehicle and payload [m] after a swinging payload was pulled along, by this simulator or the reference."""
    com = np.array(plant.vehicle.body.com)
    start = {"pos_w": np.array([[0.0, 0.0, 1.5]]) + com}
    tilt = np.array([np.sin(0.6), 0.0, -np.cos(0.6)])
    rope = np.tile(tilt, (1, plant.rope.segments, 1))
    if effect is None:
        sim = HybridSim(plant, 1, extensions=EVERYTHING)
        sim.place(**start, cable_dir_w=rope)
    else:
        sim = ReferencePlant(plant, effect)
        still = np.zeros((1, 3))
        sim.reset(start["pos_w"], np.array([[0.0, 0.0, 0.0, 1.0]]), still, still, rope)
    weight = GRAVITY * (plant.vehicle.body.mass + plant.rope.rope_mass + plant.rope.payload_mass)
    for k in range(STEPS):
        command = np.array([[weight * (1.0 + 0.2 * np.sin(0.4 * k)), 1.5 * np.sin(0.3 * k), 1.5, 0.0]])
        if effect is None:
            sim.set_command(command)
            sim.step()
        else:
            sim.step(command)
    if effect is None:
        origin = sim.get("pos_w") - Rotation.from_quat(sim.get("quat_wb")).apply(com)
        return np.vstack((origin, sim.get("payload_pos_w")))
    return np.vstack((sim.state.pos_w, sim.state.payload_pos_w))


def changed(plant, **parts):
    """The plant with fields of its parts replaced: ``changed(plant, rope={"payload_drag": 1e-3})``."""
    vehicle, rest = plant.vehicle, dict(parts)
    for name in ("thrust", "body"):
        if name in rest:
            vehicle = dataclasses.replace(vehicle, **{name: dataclasses.replace(getattr(vehicle, name), **rest.pop(name))})
    return dataclasses.replace(
        plant, vehicle=vehicle, **{k: dataclasses.replace(getattr(plant, k), **v) for k, v in rest.items()}
    )


CASES = {
    "payload_drag": ({"rope": {"payload_drag": 0.05}}, {"payload_drag": 0.05}),
    "wind": ({"air": {"wind_w": (1.0, -0.5, 0.2)}}, {"wind_mean_w": (1.0, -0.5, 0.2)}),
    "drag in wind": (
        {"rope": {"payload_drag": 0.03}, "air": {"wind_w": (-2.0, 0.0, 0.0)}},
        {"payload_drag": 0.03, "wind_mean_w": (-2.0, 0.0, 0.0)},
    ),
    "gain": ({"thrust": {"gain": (1.03, 1.03, 1.03, 1.03)}}, {"thrust_gain_error": 0.03}),
    "com": ({"body": {"com": (2e-3, -1e-3, 3e-3)}}, {"com_offset": (2e-3, -1e-3, 3e-3)}),
}


@pytest.mark.parametrize("name", CASES)
def test_extension_is_the_reference_plants(name):
    here, there = CASES[name]
    plant = fine(paper_plant())
    extended = changed(plant, **here)
    assert np.abs(swing(extended) - swing(plant, ReferenceExtras(**there))).max() < AGREEMENT
    assert np.abs(swing(plant) - swing(extended)).max() > DISTINCT * AGREEMENT


def test_mount_damping_is_the_joint_damping_of_a_rigid_rope():
    plant = fine(paper_plant())
    stiff = changed(plant, rope={"segments": 1, "joint_damping": 1e-4, "mount_damping": 4e-4})
    assert np.abs(swing(stiff) - swing(changed(stiff, rope={"joint_damping": 5e-4, "mount_damping": 0.0}))).max() < 1e-12


def test_flight_under_drag_and_wind():
    drag, wind = 5e-3, np.array([3.0, -1.0, 0.0])
    plant = changed(fine(paper_plant()), rope={"payload_drag": drag}, air={"wind_w": tuple(wind)})
    plant = changed(plant, release={"lag": 0.0})
    sim = HybridSim(plant, 1, extensions=EVERYTHING)
    sim.place(pos_w=np.array([[0.0, 0.0, 2.0]]), vel_w=np.array([[2.0, 1.0, 3.0]]))
    sim.set_command(np.array([[2.0, 0.0, 0.0, 0.0]]), np.array([1]))
    sim.step()
    pos, vel = sim.get("payload_pos_w")[0], sim.get("payload_vel_w")[0]

    def rates(_, y):
        air = y[3:] - wind
        return np.concatenate((y[3:], np.array([0, 0, -GRAVITY]) - drag / plant.rope.payload_mass * np.linalg.norm(air) * air))

    def ground(_, y):
        return y[2] - plant.release.landing_height

    ground.terminal, ground.direction = True, -1
    path = solve_ivp(rates, (0, 5), np.concatenate((pos, vel)), events=ground, rtol=1e-11, atol=1e-12, dense_output=True)
    assert sim.get("time_to_impact")[0] == pytest.approx(path.t[-1], abs=1e-7)
    np.testing.assert_allclose(sim.get("landing_w")[0], path.y[:3, -1], atol=1e-6)
    at = path.sol(np.linspace(0, path.t[-1], plant.release.clearance_samples))[:3]
    nearest = np.linalg.norm(at.T - sim.get("release_pos_w")[0], axis=1).min()
    assert sim.get("clearance")[0] == pytest.approx(nearest, abs=1e-6)


def test_ground_effect_lifts_as_the_formula_says():
    vehicle = paper_plant().vehicle
    height, effect = 0.06, 1.5
    thrust = vehicle.body.mass * GRAVITY
    rise = []
    for air in (AirParams(), AirParams(ground_effect=effect)):
        sim = QuadSim(vehicle, 1, precision="float64", air=air)
        sim.place(np.array([[0.0, 0.0, height]]))
        sim.set_command(np.array([[thrust, 0.0, 0.0, 0.0]]))
        sim.control_period = 1e-3
        sim.step()
        rise.append(sim.get("vel_w")[0, 2] / 1e-3)
    ratio = vehicle.rotors.radius / (4 * height)
    assert rise[1] - rise[0] == pytest.approx(effect * (1 / (1 - ratio**2) - 1) * GRAVITY, rel=2e-3)


def test_asymmetric_motor_is_first_order_one_way():
    vehicle = plain_vehicle(paper_plant().vehicle)
    slow = dataclasses.replace(vehicle.motor, kind="asymmetric", time_constant_down=0.1)
    sim = QuadSim(dataclasses.replace(vehicle, motor=slow), 1, precision="float64", step=5e-4)
    sim.place(np.array([[0.0, 0.0, 1.0]]))
    before = sim.get("motor_speed")[0, 0]
    sim.set_command(np.array([[0.5 * vehicle.body.mass * GRAVITY, 0.0, 0.0, 0.0]]))
    for _ in range(3):
        sim.step()
    acting = 3 * 0.02 - vehicle.queue.delay
    target = np.sqrt(0.5) * before  # of half the thrust
    expected = target + (before - target) * np.exp(-acting / 0.1)
    assert sim.get("motor_speed")[0, 0] == pytest.approx(expected, rel=1e-6)


def test_built_in_at_zero_is_the_plain_simulator():
    plant = fine(paper_plant())
    plain, extended = HybridSim(plant, 1), HybridSim(plant, 1, extensions=EVERYTHING)
    for sim in (plain, extended):
        sim.place(pos_w=np.array([[0.0, 0.0, 1.5]]))
        for k in range(STEPS):
            sim.set_command(np.array([[3.0, np.sin(0.3 * k), 1.0, 0.0]]), np.array([k == 4]))
            sim.step()
    for name in ("pos_w", "quat_wb", "landing_w", "time_to_impact"):
        np.testing.assert_allclose(plain.get(name), extended.get(name), atol=1e-8)


def test_off_costs_nothing():
    plant = paper_plant()
    assert extensions_of([plant.vehicle], [plant.rope], [plant.air]) == frozenset()
    plain = env_step(plant)["total"]
    zero = changed(plant, rope={"payload_drag": 0.0, "mount_damping": 0.0}, air={"wind_w": (0.0, 0.0, 0.0)})
    assert env_step(zero)["total"] == plain
    for part in ({"rope": {"payload_drag": 1e-3}}, {"air": {"wind_w": (0.1, 0.0, 0.0)}}, {"thrust": {"gain": (1.1,) * 4}},
                 {"air": {"ground_effect": 1.0}}, {"rope": {"mount_damping": 1e-5}}):  # fmt: skip
        assert env_step(changed(plant, **part))["total"] > plain, part
    assert set(EXTENSIONS) >= {"gain", "wind", "ground_effect", "payload_drag", "mount_damping", "push"}


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ({"rope": {"payload_drag": -1.0}}, "payload_drag"),
        ({"rope": {"mount_damping": float("nan")}}, "mount_damping"),
        ({"air": {"wind_w": (float("inf"), 0.0, 0.0)}}, "wind_w"),
        ({"thrust": {"gain": (1.0, 0.0, 1.0, 1.0)}}, "gain"),
    ],
)
def test_unphysical_values_are_refused(part, message):
    with pytest.raises(ValueError, match=message):
        HybridSim(changed(paper_plant(), **part), 1)


def test_the_reference_refuses_what_it_does_not_know():
    for part in ({"body": {"com": (1e-3, 0.0, 0.0)}}, {"air": {"wind_w": (0.1, 0.0, 0.0)}}, {"release": {"rope_tail": 1.0}}):
        with pytest.raises(ValueError, match="does not know"):
            ReferencePlant(changed(paper_plant(), **part))

"""Effects that a kernel holds only if built for them, against the reference plant and scipy; off,
they change nothing.
"""

import numpy as np
from numpy.linalg import norm
from numpy.testing import assert_allclose
from pytest import approx, mark, raises
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from sim.hybrid import HybridSim
from sim.params import GRAVITY, AirParams, change_values
from sim.reference.plant import ReferencePlant
from sim.reference.reference_extras import ReferenceExtras
from tests.plants import EVERYTHING, paper_plant
from tests.simulators import bare_quadrotor
from visthrow.throws.plants import fly_payloads

STEPS = 12  # of 20 ms
REFERENCE_STEP = 2e-3  # s, at most; of order 4: payloads move by 2 nm against steps of a quarter
AGREEMENT = 3e-4  # m; the simulator's steps of 1 ms alone leave 0.2 mm after such a swing
DISTINCT = 10.0  # times that agreement an effect must move the payload for the test to say anything


def fine(plant):
    """The plant in float64 with a step of 1 ms."""
    return change_values(plant, {"sim.precision": "float64", "sim.substep": 1e-3})


def swing(plant, effect=None):
    """Positions of vehicle and payload [m] after a swinging payload was pulled along, by this
    simulator or the reference.
    """
    com = np.array(plant.vehicle.body.com)
    start = {"pos_w": np.array([[0.0, 0.0, 1.5]]) + com}
    tilt = np.array([np.sin(0.6), 0.0, -np.cos(0.6)])
    rope = np.tile(tilt, (1, plant.rope.segments, 1))
    if effect is None:
        sim = HybridSim(plant, 1, extensions=EVERYTHING)
        sim.place(**start, cable_dir_w=rope)
    else:
        sim = ReferencePlant(plant, effect, step=REFERENCE_STEP)
        still = np.zeros((1, 3))
        sim.reset(start["pos_w"] - com, np.array([[0.0, 0.0, 0.0, 1.0]]), still, still, rope)
    weight = GRAVITY * plant.total_mass
    for k in range(STEPS):
        command = np.array(
            [[weight * (1.0 + 0.2 * np.sin(0.4 * k)), 1.5 * np.sin(0.3 * k), 1.5, 0.0]]
        )
        if effect is None:
            sim.set_command(command)
            sim.step()
        else:
            sim.step(command)
    if effect is None:
        origin = sim.get("pos_w") - Rotation.from_quat(sim.get("quat_wb")).apply(com)
        return np.vstack((origin, sim.get("payload_pos_w")))
    return np.vstack((sim.state.pos_w, sim.state.payload_pos_w))


CASES = {
    "payload_drag": {"rope.payload_drag": 0.05},
    "wind": {"air.wind_w": (1.0, -0.5, 0.2)},
    "drag in wind": {"rope.payload_drag": 0.03, "air.wind_w": (-2.0, 0.0, 0.0)},
    "gain": {"vehicle.thrust.gain": (1.03, 1.02, 1.04, 1.03)},
    "drag torque": {
        "vehicle.thrust.torque_gain": 1.8,
        "vehicle.thrust.gain": (1.03, 0.97, 1.03, 0.97),
    },
    "com": {"vehicle.body.com": (2e-3, -1e-3, 3e-3)},
    "ground": {"air.ground_effect": 1000.0},  # at 1.5 m a hundredth of a per cent each
    "motors": {"vehicle.motor.kind": "asymmetric", "vehicle.motor.time_constant_down": 0.25},
    "friction": {"rope.swing_damping": 0.05},
    "jet": {"rope.downwash": 0.05},
    "mount": {"rope.mount_damping": 2e-3},
}
"""Parameters of which both plants have the equation; the vehicle's motion does not depend on the
number of segments.
"""


@mark.parametrize("name", CASES)
def test_extension_is_the_reference_plants(name):
    of_rope = name in ("payload_drag", "wind", "drag in wind")
    plain = fine(change_values(paper_plant(), {"rope.segments": 15 if of_rope else 1}))
    extended = change_values(plain, CASES[name])
    expected = swing(extended, ReferenceExtras(payload_drag=extended.rope.payload_drag))
    here = swing(extended)
    assert np.abs(here - expected).max() < AGREEMENT
    assert np.abs(swing(plain) - here).max() > DISTINCT * AGREEMENT


def let_go(plant):
    """When a swinging payload separated [s] and how fast it then was [m/s], by this simulator and
    the reference.

    The release is commanded after three periods: the pull is known once a step was done.
    """
    tilt, still = (
        np.tile([np.sin(0.9), 0.0, -np.cos(0.9)], (1, plant.rope.segments, 1)),
        np.zeros((1, 3)),
    )
    weight = GRAVITY * plant.total_mass
    command, home = np.array([[weight, 0.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 1.5]])
    here, reference = (
        HybridSim(plant, 1, extensions=EVERYTHING),
        ReferencePlant(plant, step=REFERENCE_STEP),
    )
    here.place(pos_w=home, cable_dir_w=tilt)
    reference.reset(home, np.array([[0.0, 0.0, 0.0, 1.0]]), still, still, tilt)
    k = 0
    while not here.get("separated")[0]:
        here.set_command(command, np.array([int(k >= 3)]))
        here.step()
        reference.step(command, k >= 3)
        k += 1
    opened = (
        0.02 * (k - 1) + float(here.get("separation_time")[0]),
        float(reference.landing.separation_time[0]),
    )
    fallen = np.array([0.0, 0.0, GRAVITY]) * (0.02 * k - opened[1])
    return opened, (here.get("payload_vel_w")[0], reference.state.payload_vel_w[0] + fallen)


def test_release_by_pull_and_kick_are_the_reference_plants():
    """A payload lets go by the rope's pull, which is less than its weight out there, with the kick
    on top of what it had.
    """
    plant = change_values(fine(paper_plant()), {"rope.segments": 1, "release.lag": 0.05})
    (plain, _), _ = let_go(plant)
    early = change_values(plant, {"release.lag_tension": 0.05})
    opened, calm = let_go(early)
    assert opened[0] == approx(opened[1], abs=2e-4)
    assert plain - opened[0] > 5e-3
    kick = np.array([0.1, 0.0, -0.05])
    _, kicked = let_go(change_values(early, {"release.kick_w": tuple(kick)}))
    for before, after in zip(calm, kicked):
        assert_allclose(after - before, kick, atol=1e-6)
    assert_allclose(kicked[0], kicked[1], atol=5e-3)
    _, shot = let_go(change_values(early, {"release.kick_along": 0.2}))
    for before, after in zip(calm, shot):
        assert norm(after - before) == approx(0.2, rel=1e-6)
    assert_allclose(shot[0], shot[1], atol=5e-3)


def test_mount_damping_is_the_joint_damping_of_a_rigid_rope():
    plant = change_values(fine(paper_plant()), {"rope.segments": 1})
    mount = change_values(plant, {"rope.joint_damping": 1e-4, "rope.mount_damping": 4e-4})
    joint = change_values(plant, {"rope.joint_damping": 5e-4})
    assert np.abs(swing(mount) - swing(joint)).max() < 1e-12


@mark.parametrize(
    ("drag", "side", "lift", "wind", "extensions"),
    [(0.0, 0.0, 0.0, (0.0, 0.0, 0.0), frozenset()), (5e-3, 2e-3, -1e-3, (3, -1, 0), EVERYTHING)],
)
def test_a_payload_flies_and_lands_as_its_equation_says(drag, side, lift, wind, extensions):
    rope = {"rope.payload_drag": drag, "rope.payload_side": side, "rope.payload_lift": lift}
    others = {"air.wind_w": wind, "release.lag": 0.0}
    plant = change_values(fine(paper_plant()), rope | others)
    sim = HybridSim(plant, 1, extensions=extensions)
    sim.place(pos_w=np.array([[0.0, 0.0, 2.0]]), vel_w=np.array([[2.0, 1.0, 3.0]]))
    sim.set_command([[2.0, 0.0, 0.0, 0.0]], [1])
    sim.step()
    pos, vel = sim.get("payload_pos_w")[0], sim.get("payload_vel_w")[0]

    def rates(_, y):
        air = y[3:] - wind
        across = np.cross([0.0, 0.0, 1.0], air)
        push = side * across + lift * np.cross(air, across / norm(across)) - drag * air
        return np.concatenate(
            (
                y[3:],
                np.array([0, 0, -GRAVITY]) + norm(air) / plant.rope.payload_mass * push,
            )
        )

    def ground(_, y):
        return y[2] - plant.release.landing_height

    ground.terminal, ground.direction = True, -1
    path = solve_ivp(
        rates,
        (0, 5),
        np.concatenate((pos, vel)),
        events=ground,
        rtol=1e-11,
        atol=1e-12,
        dense_output=True,
    )
    assert sim.get("time_to_impact")[0] == approx(path.t[-1], abs=1e-7)
    assert_allclose(sim.get("landing_w")[0], path.y[:3, -1], atol=1e-6)
    away = np.array([0.1, 0.3])
    gone = fly_payloads(plant.rope, plant.air, *(np.tile(x, (2, 1)) for x in (pos, vel)), away)
    assert_allclose(np.hstack(gone), path.sol(away).T, atol=1e-6)
    at = path.sol(np.linspace(0, path.t[-1], plant.release.clearance_samples))[:3]
    nearest = norm(at.T - sim.get("release_pos_w")[0], axis=1).min()
    assert sim.get("clearance")[0] == approx(nearest, abs=1e-6)


def spring_pendulum(
    give: float, mass: float, length: float, angle: float, seconds: float
) -> np.ndarray:
    """End of a pendulum on a stiff, damped spring without mass [m], from rest in balance along the
    spring; (x, z).
    """
    down, tension = np.array([0.0, -GRAVITY]), mass * GRAVITY * np.cos(angle)
    start = (length + give * tension) * np.array([np.sin(angle), -np.cos(angle)])
    damping = 1.4 * np.sqrt(mass / give)

    def rates(_, y):
        reach = norm(y[:2])
        along = y[:2] / reach
        pull = (reach - length) / give + damping * y[2:] @ along
        return np.concatenate((y[2:], down - pull / mass * along))

    return solve_ivp(
        rates, (0, seconds), np.append(start, (0.0, 0.0)), rtol=1e-9, atol=1e-11, method="LSODA"
    ).y[:2, -1]


@mark.parametrize("steps", [12, 18])
def test_a_rope_that_gives_is_a_spring(steps):
    """A thousand times heavier vehicle holds the mount still; what the rope's give changes is what
    a spring changes.
    """
    plant, heavy, angle = fine(paper_plant()), 1e3, 0.9
    v = plant.vehicle
    grown = {
        f"vehicle.controller.{name}": tuple(heavy * x for x in getattr(v.controller, name))
        for name in ("p_gain", "i_gain", "d_gain")
    }
    grown |= {
        "vehicle.controller.max_thrust": heavy * v.controller.max_thrust,
        "vehicle.controller.feedforward_gain": (0.0, 0.0, 0.0),
        "vehicle.body.mass": heavy * v.body.mass,
        "vehicle.body.inertia": tuple(heavy * x for x in v.body.inertia),
        "vehicle.thrust.k_f": heavy * v.thrust.k_f,
        "vehicle.battery.resistance": v.battery.resistance / heavy,
        "vehicle.battery.capacity": heavy * v.battery.capacity,
    }
    rope = {"rope.payload_offset": 0.0, "rope.payload_inertia": 1e-9, "rope.rope_mass": 1e-5}
    plant = change_values(plant, grown | rope)
    tilt = np.array([np.sin(angle), 0.0, -np.cos(angle)])

    def hang(give: float) -> np.ndarray:
        sim = HybridSim(change_values(plant, {"rope.compliance": give}), 1, extensions=EVERYTHING)
        sim.place(
            pos_w=np.array([[0.0, 0.0, 5.0]]),
            cable_dir_w=np.tile(tilt, (1, plant.rope.segments, 1)),
        )
        for _ in range(steps):
            sim.set_command(np.array([[GRAVITY * plant.total_mass, 0.0, 0.0, 0.0]]))
            sim.step()
        return (sim.get("payload_pos_w") - sim.get("pos_w"))[0, [0, 2]]

    give, mass, length = 2e-3, plant.rope.payload_mass, plant.rope.length
    expected = [spring_pendulum(g, mass, length, angle, 0.02 * steps) for g in (give, 1e-6)]
    change = hang(give) - hang(0.0)
    assert norm(change) > 5e-4
    assert_allclose(change, expected[0] - expected[1], atol=0.12 * norm(change))  # the mount drifts


def test_ground_effect_lifts_as_the_formula_says():
    vehicle = paper_plant().vehicle
    height, effect = 0.06, 1.5
    thrust = vehicle.body.mass * GRAVITY
    rise = []
    for air in (AirParams(), AirParams(ground_effect=effect)):
        sim = bare_quadrotor(vehicle, precision="float64", control_period=1e-3, airs=[air])
        sim.place(np.array([[0.0, 0.0, height]]))
        sim.set_command([[thrust, 0.0, 0.0, 0.0]])
        sim.step()
        rise.append(sim.get("vel_w")[0, 2] / 1e-3)
    ratio = vehicle.rotors.radius / (4 * height)
    assert rise[1] - rise[0] == approx(effect * (1 / (1 - ratio**2) - 1) * GRAVITY, rel=2e-3)


def test_the_reference_refuses_what_it_does_not_know():
    with raises(ValueError, match=r"does not know release\.rope_tail"):
        ReferencePlant(change_values(paper_plant(), {"release.rope_tail": 1.0}))

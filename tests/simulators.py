"""The training simulator set up as the tests need it, and mechanics of its states in
plain NumPy.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sim.hybrid import HybridSim
from sim.params import (
    GRAVITY,
    BodyParams,
    PlantParams,
    QueueParams,
    RopeParams,
    SimParams,
    VehicleParams,
)
from tests.plants import paper_plant
from tests.scenes import Scene, wrench_at

LOW, HIGH = (0.0, -10.0, -10.0, -4.0), (14.0, 10.0, 10.0, 4.0)
"""Full range of commands: collective thrust [N], body rates [rad/s]."""


def random_commands(seed: int, steps: int, count: int) -> np.ndarray:
    """Full-range commands, uniform and independent, shape (steps, count, 4)."""
    return np.random.default_rng(seed).uniform(LOW, HIGH, (steps, count, 4))


def numerics(
    substep: float = 0.002, precision: str = "float32", control_period: float = 0.02
) -> SimParams:
    """The paper's numerics with another substep, precision or period."""
    return replace(
        paper_plant().sim, substep=substep, precision=precision, control_period=control_period
    )


def bare_quadrotor(
    vehicle: VehicleParams,
    count: int = 1,
    integrator: str = "rk4",
    step: float = 0.002,
    precision: str = "float32",
    control_period: float = 0.02,
    **options: Any,
) -> HybridSim:
    """Return quadrotors without a rope; in float64 with the kernel of the ground's effect."""
    sim = numerics(step, precision, control_period)
    plant = replace(paper_plant(), vehicle=vehicle, sim=sim)
    if precision == "float64":
        options["extensions"] = frozenset({"ground_effect"})
    return HybridSim(plant, count, without_rope=integrator, **options)


def scene_plant(
    scene: Scene, substep: float, precision: str, control_period: float = 0.01
) -> PlantParams:
    """Plant of a bare scene; flown with ``direct=True`` only body, rope and numerics count."""
    plant = paper_plant()
    controller = plant.vehicle.controller
    strong = replace(controller, max_thrust=max(controller.max_thrust, GRAVITY * scene.mass))
    vehicle = replace(
        plant.vehicle,
        body=BodyParams(scene.mass, scene.inertia),
        controller=strong,
        queue=QueueParams(delay=0.0),
    )
    rope = RopeParams(
        segments=scene.segments,
        length=scene.segments * scene.segment_length,
        rope_mass=scene.segments * scene.segment_mass,
        payload_mass=scene.ball_mass,
        payload_inertia=scene.ball_inertia,
        payload_offset=scene.ball_offset,
        payload_radius=0.033,
        joint_damping=scene.joint_damping,
        mount=scene.mount,
    )
    return PlantParams(vehicle, rope, plant.release, numerics(substep, precision, control_period))


def scene_sim(
    scene: Scene,
    substep: float,
    precision: str,
    control_period: float = 0.01,
    solver: str = "chain",
    **options,
) -> HybridSim:
    """Simulator of one vehicle at the start of a scene."""
    plant = scene_plant(scene, substep, precision, control_period)
    plant = replace(plant, sim=replace(plant.sim, solver=solver))
    sim = HybridSim(plant, 1, direct=True, **options)
    place_scene(sim, scene)
    return sim


def place_scene(sim: HybridSim, scene: Scene) -> None:
    """Put a simulator's vehicle and rope where a scene starts."""
    vehicle = (
        np.array([value]) for value in (scene.pos_w, scene.quat_wb, scene.vel_w, scene.rate_b)
    )
    sim.place(*vehicle, scene.cable_dir_w()[None], scene.cable_vel_w()[None])


@dataclass(frozen=True)
class Flight:
    """End of a scene [m], [m/s], shapes (3,); status bits of all steps."""

    pos_w: np.ndarray
    ball_pos_w: np.ndarray
    ball_vel_w: np.ndarray
    status: int


def fly(
    scene: Scene,
    substep: float,
    precision: str,
    control_period: float = 0.01,
    solver: str = "chain",
) -> Flight:
    """Fly a scene to its end."""
    sim = scene_sim(scene, substep, precision, control_period, solver)
    status = 0
    for k in range(round(scene.duration / control_period)):
        wrench = wrench_at(scene, k * control_period)
        sim.set_command([[wrench.force_b[2], *wrench.torque_b]])
        sim.step()
        status |= int(sim.get("status")[0])
    pos, ball, vel = (
        sim.get(k)[0].astype(float) for k in ("pos_w", "payload_pos_w", "payload_vel_w")
    )
    return Flight(pos, ball, vel, status)


def rods(sim: HybridSim) -> tuple[np.ndarray, ...]:
    """Masses, transverse inertias about the centre, centres and their velocities of every body of
    the rope.

    The ball counts as a body of its own: shapes (L+1,), (L+1,), (E, L+1, 3), (E, L+1, 3); also the
    rates of the rods' directions, with the ball's, shape (E, L+1, 3).
    """
    rope = sim.params.rope
    length, mass = rope.segment_length, rope.segment_mass
    turn, n, u = (
        Rotation.from_quat(sim.get("quat_wb")),
        sim.get("cable_dir_w"),
        sim.get("cable_vel_w"),
    )
    n, u = n.astype(float), u.astype(float)
    turning = np.cross(sim.get("rate_b").astype(float), rope.mount)
    top = sim.get("pos_w") + turn.apply(np.tile(rope.mount, (sim.count, 1)))
    top_vel = sim.get("vel_w") + turn.apply(turning)

    def centres(upper: np.ndarray, along: np.ndarray) -> np.ndarray:
        ends = upper[:, None] + length * np.cumsum(along, axis=1)
        ball = ends[:, -1:] + rope.payload_offset * along[:, -1:]
        return np.concatenate((ends - 0.5 * length * along, ball), axis=1)

    masses = np.append(np.full(rope.segments, mass), rope.payload_mass)
    inertias = np.append(np.full(rope.segments, mass * length**2 / 12.0), rope.payload_inertia)
    rates = np.concatenate((u, u[:, -1:]), axis=1)
    return masses, inertias, centres(top, n), centres(top_vel, u), rates


def energy(sim: HybridSim) -> np.ndarray:
    """Kinetic and potential energy [J] of vehicle, rope and ball, shape (E,)."""
    masses, inertias, pos, vel, u = rods(sim)
    body = sim.params.vehicle.body
    v, w, pos_w = (sim.get(name).astype(float) for name in ("vel_w", "rate_b", "pos_w"))
    kinetic = 0.5 * body.mass * (v**2).sum(-1) + 0.5 * (np.array(body.inertia) * w**2).sum(-1)
    kinetic += 0.5 * ((vel**2).sum(-1) @ masses + (u**2).sum(-1) @ inertias)
    return kinetic + sim.gravity * (body.mass * pos_w[:, 2] + pos[..., 2] @ masses)


def momentum(sim: HybridSim) -> np.ndarray:
    """Linear momentum [kg m/s] of vehicle, rope and ball, shape (E, 3), world frame."""
    masses, _, _, vel, _ = rods(sim)
    return sim.params.vehicle.body.mass * sim.get("vel_w").astype(float) + np.einsum(
        "elx,l->ex", vel, masses
    )

"""The hard throw as bodies and numbers, and how far a plant ends from the truth in it."""

import dataclasses

import numpy as np

from sim.hybrid import HybridSim
from sim.params import PlantParams
from sim.reference.scene import Scene, Wrench

TOTAL_MASS = 0.21 + 0.004 + 0.058
THRUST_WEIGHTS = 2.2

HARD_THROW = Scene(
    mass=0.21, inertia=(2.5e-4, 2.5e-4, 4.0e-4),
    pos_w=(0.0, 0.0, 1.5), quat_wb=(0.0, 0.0, 0.0, 1.0),
    vel_w=(0.4, -0.2, 0.1), rate_b=(0.0, 0.0, 0.0), mount=(0.0, 0.0, -0.02),
    segments=15, segment_length=0.022, segment_mass=0.004 / 15,
    ball_mass=0.058, ball_inertia=4.2108e-5, ball_offset=0.033, direction=(1.2, -0.15, -1.0),
    cable_rate_w=(0.0, 0.0, 0.0), joint_damping=1.0e-5, duration=0.5,
    schedule=(Wrench(0.0, (0.0, 0.0, THRUST_WEIGHTS * TOTAL_MASS * 9.81), (0.0, 0.0, 0.0)),),
)  # fmt: skip
"""2.2 times the total weight along body z, the rope straight but far from hanging. Equal to the tests' scene file."""


def plant_of_scene(scene: Scene, like: PlantParams) -> PlantParams:
    """The simulator's parameters for a scene's bodies, with the numerics of ``like``; commands act without delay."""
    vehicle = dataclasses.replace(
        like.vehicle,
        body=dataclasses.replace(like.vehicle.body, mass=scene.mass, inertia=scene.inertia),
        queue=dataclasses.replace(like.vehicle.queue, delay=0.0),
    )
    rope = dataclasses.replace(
        like.rope,
        segments=scene.segments,
        length=scene.segments * scene.segment_length,
        rope_mass=scene.segments * scene.segment_mass,
        payload_mass=scene.ball_mass,
        payload_inertia=scene.ball_inertia,
        payload_offset=scene.ball_offset,
        joint_damping=scene.joint_damping,
        mount=scene.mount,
    )
    return dataclasses.replace(like, vehicle=vehicle, rope=rope)


def end_of_scene(scene: Scene, like: PlantParams) -> tuple[np.ndarray, np.ndarray]:
    """Fly a scene of one constant wrench in the simulator, with its numerics.

    Returns:
        Positions of ball and vehicle at the end [m], shape (3,) each, world frame.
    """
    plant = plant_of_scene(scene, like)
    sim = HybridSim(plant, 1, direct=True)
    wrench = scene.schedule[0]
    sim.place(
        pos_w=np.array([scene.pos_w]),
        quat_wb=np.array([scene.quat_wb]),
        vel_w=np.array([scene.vel_w]),
        rate_b=np.array([scene.rate_b]),
        cable_dir_w=scene.cable_dir_w()[None],
        cable_vel_w=scene.cable_vel_w()[None],
    )
    sim.set_command(np.array([[wrench.force_b[2], *wrench.torque_b]]))
    for _ in range(round(scene.duration / plant.sim.control_period)):
        sim.step()
    return sim.get("payload_pos_w")[0].astype(float), sim.get("pos_w")[0].astype(float)


def distance(ends: tuple[np.ndarray, np.ndarray], truth: tuple[np.ndarray, np.ndarray]) -> tuple[float, float]:
    """Distances of ball and vehicle [m]."""
    return float(np.linalg.norm(ends[0] - truth[0])), float(np.linalg.norm(ends[1] - truth[1]))

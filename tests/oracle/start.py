"""The rope of a scene for MuJoCo C: masses and lengths, and the state that it begins in."""

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from sim.params import BodyParams, RopeParams
from tests.scenes import Scene
from tests.simulators import scene_plant

CONVERGED_STEP = 20e-6
"""Step of a converged run [s]: half of it moves the ball of both scenes by less than a micrometre.
"""


def vehicle_and_rope(scene: Scene) -> tuple[BodyParams, RopeParams]:
    """Return the masses and lengths of a scene."""
    plant = scene_plant(scene, 2e-3, "float64")
    return plant.vehicle.body, plant.rope


def upper_hinges(
    rot_wb: np.ndarray, rate_w: np.ndarray, direction: np.ndarray, velocity: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return angles [rad] and rates [rad/s] of the universal joint at the mount, shape (2,) each,
    order y, x.

    With ``n = Ry(a) Rx(b) (0, 0, -1) = (-cos b sin a, sin b, -cos b cos a)`` in the vehicle's
    frame.

    Args:
        rot_wb: attitude of the quadrotor, shape (3, 3).
        rate_w: its angular velocity, world frame [rad/s], shape (3,).
        direction: unit direction of the rope, shape (3,).
        velocity: its time derivative [1/s], shape (3,).
    """
    n = rot_wb.T @ direction
    a, b = np.arctan2(-n[0], -n[2]), np.arcsin(np.clip(n[1], -1.0, 1.0))
    first = rot_wb[:, 1]
    second = rot_wb @ np.array([np.cos(a), 0.0, -np.sin(a)])
    columns = np.stack((np.cross(first, direction), np.cross(second, direction)), -1)
    rates = np.linalg.lstsq(columns, velocity - np.cross(rate_w, direction), rcond=None)[0]
    return np.array([a, b]), rates


def initial_data(model: "mujoco.MjModel", scene: Scene) -> "mujoco.MjData":
    """Return MuJoCo data of a universal-joint model at the start of a scene, whose rope is straight
    and turns as one.
    """
    data = mujoco.MjData(model)
    rot_wb = Rotation.from_quat(scene.quat_wb).as_matrix()
    angles, rates = upper_hinges(
        rot_wb, rot_wb @ np.array(scene.rate_b), scene.cable_dir_w()[0], scene.cable_vel_w()[0]
    )
    data.qpos[:3], data.qpos[3:7], data.qpos[7:9] = scene.pos_w, np.roll(scene.quat_wb, 1), angles
    data.qvel[:3], data.qvel[3:6], data.qvel[6:8] = scene.vel_w, scene.rate_b, rates
    return data

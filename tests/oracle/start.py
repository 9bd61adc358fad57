"""The rope of a scene for MuJoCo C: masses and lengths, and the state that it begins in."""

import mujoco
import numpy as np

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


def matrix_from_quat(quat: np.ndarray) -> np.ndarray:
    """Return the rotation matrix of a unit quaternion xyzw, shape (3, 3)."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, np.roll(np.asarray(quat, dtype=np.float64), 1))
    return matrix.reshape(3, 3)


def hinges_from_directions(
    rot_wb: np.ndarray, rate_w: np.ndarray, cable_dir_w: np.ndarray, cable_vel_w: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return angles [rad] and rates [rad/s] of the universal joints, shape (2 L,) each, order y0,
    x0, y1, x1, ..

    With ``n = Ry(a) Rx(b) (0, 0, -1) = (-cos b sin a, sin b, -cos b cos a)`` in the parent's frame.

    Args:
        rot_wb: attitude of the quadrotor, shape (3, 3).
        rate_w: its angular velocity, world frame [rad/s], shape (3,).
        cable_dir_w: unit directions, shape (L, 3).
        cable_vel_w: their time derivatives [1/s], shape (L, 3).
    """
    angles, rates = [], []
    frame, omega = np.array(rot_wb), np.array(rate_w)
    for direction, velocity in zip(cable_dir_w, cable_vel_w):
        n = frame.T @ direction
        b, a = np.arcsin(np.clip(n[1], -1.0, 1.0)), np.arctan2(-n[0], -n[2])
        first = frame[:, 1]
        turned = frame @ np.array(
            [[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]
        )
        second = turned[:, 0]
        columns = np.stack((np.cross(first, direction), np.cross(second, direction)), -1)
        rate = np.linalg.lstsq(columns, velocity - np.cross(omega, direction), rcond=None)[0]
        angles += [a, b]
        rates += list(rate)
        frame = turned @ np.array(
            [[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]]
        )
        omega = omega + rate[0] * first + rate[1] * second
    return np.array(angles), np.array(rates)


def initial_data(model: "mujoco.MjModel", scene: Scene) -> "mujoco.MjData":
    """Return MuJoCo data of a universal-joint model at the start of a scene."""
    data = mujoco.MjData(model)
    rot_wb = matrix_from_quat(scene.quat_wb)
    angles, rates = hinges_from_directions(
        rot_wb, rot_wb @ np.array(scene.rate_b), scene.cable_dir_w(), scene.cable_vel_w()
    )
    data.qpos[:3], data.qpos[3:7] = scene.pos_w, np.roll(scene.quat_wb, 1)
    data.qpos[7:] = angles
    data.qvel[:3], data.qvel[3:6], data.qvel[6:] = scene.vel_w, scene.rate_b, rates
    return data

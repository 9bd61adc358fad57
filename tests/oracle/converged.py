"""Converged runs of bare quadrotor and rope in MuJoCo C: what the tests of every other plant are
held against.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from sim.reference.model import build_attached
from tests.oracle.start import CONVERGED_STEP, initial_data, vehicle_and_rope
from tests.scenes import Scene


@dataclass(frozen=True)
class OracleRun:
    """States of one run at the asked times; T times, L segments, world frame, quaternions xyzw."""

    time: np.ndarray  # [s], shape (T,)
    pos_w: np.ndarray  # of the quadrotor's centre of mass [m], shape (T, 3)
    quat_wb: np.ndarray  # shape (T, 4)
    vel_w: np.ndarray  # [m/s], shape (T, 3)
    rate_b: np.ndarray  # [rad/s], shape (T, 3)
    ball_pos_w: np.ndarray  # [m], shape (T, 3)
    ball_vel_w: np.ndarray  # [m/s], shape (T, 3)
    # mount, every joint and the end of the last segment [m], shape (T, L+1, 3)
    cable_points_w: np.ndarray
    cable_dir_w: np.ndarray  # shape (T, L, 3)
    cable_vel_w: np.ndarray  # time derivative of the directions [1/s], shape (T, L, 3)
    energy: np.ndarray  # kinetic and potential [J], shape (T, 2)


def _record(
    model: "mujoco.MjModel", data: "mujoco.MjData", scene: Scene, rows: dict[str, list[np.ndarray]]
) -> None:
    # After mj_step the derived fields describe the state before it.
    mujoco.mj_forward(model, data)
    count, length = scene.segments, scene.segment_length
    rotations = data.xmat[2:].reshape(count, 3, 3)
    directions = -rotations[:, :, 2]
    top = data.xpos[2:]
    end = top[-1] + length * directions[-1]
    twist = np.empty((count, 6))
    for i in range(count):
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, 2 + i, twist[i], 0)
    cable_vel = np.cross(twist[:, :3], directions)
    mujoco.mj_energyPos(model, data)
    mujoco.mj_energyVel(model, data)
    values = {
        "time": np.array(data.time),
        "pos_w": data.qpos[:3],
        "quat_wb": np.roll(data.qpos[3:7], -1),
        "vel_w": data.qvel[:3],
        "rate_b": data.qvel[3:6],
        "ball_pos_w": end + scene.ball_offset * directions[-1],
        "ball_vel_w": twist[-1, 3:] + (length + scene.ball_offset) * cable_vel[-1],
        "cable_points_w": np.vstack((top, end)),
        "cable_dir_w": directions,
        "cable_vel_w": cable_vel,
        "energy": np.array([data.energy[1], data.energy[0]]),
    }
    for key, value in values.items():
        rows.setdefault(key, []).append(np.array(value))


def _step_index(time: float, step: float, what: str) -> int:
    index = round(time / step)
    if abs(index * step - time) > 1e-9:
        raise ValueError(f"oracle: {what} {time} s is no multiple of the step {step} s")
    return index


def converged(
    scene: Scene,
    step: float = CONVERGED_STEP,
    times: np.ndarray | None = None,
    joints: str = "universal",
    armature: float = 0.0,
    integrator: str = "RK4",
) -> OracleRun:
    """Run a scene in MuJoCo C with a fixed step.

    Args:
        scene: the scene; each switch of its schedule must fall on a step edge.
        step: integration step [s].
        times: times to record at [s], ascending multiples of the step; by default start and end.
        joints: ``universal`` (damping inside MuJoCo).
        armature: of the hinges [kg m^2].
        integrator: ``RK4`` or ``implicitfast``.

    Returns:
        The recorded states.

    Raises:
        ValueError: a time or a switch off the step edges, or another kind of joint.
    """
    if joints != "universal":
        raise ValueError(
            f"oracle: joints {joints!r}, expected 'universal'; ball joints are run by"
            " sim.reference.plant"
        )
    model = build_attached(*vehicle_and_rope(scene), joints, armature)
    model.opt.timestep = step
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    data = initial_data(model, scene)
    asked = (0.0, scene.duration) if times is None else times
    records = [_step_index(t, step, "time") for t in asked]
    switches = {_step_index(w.t_start, step, "switch"): w for w in scene.schedule}
    rows: dict[str, list[np.ndarray]] = {}
    now = 0
    for index in sorted(set(records) | {s for s in switches if s <= max(records)}):
        mujoco.mj_step(model, data, index - now)
        now = index
        if index in records:
            _record(model, data, scene, rows)
        if index in switches:
            data.ctrl[:] = (*switches[index].force_b, *switches[index].torque_b)
    return OracleRun(**{key: np.stack(value) for key, value in rows.items()})

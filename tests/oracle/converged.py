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
    """Places of one run at the asked times; T times, world frame."""

    pos_w: np.ndarray  # of the quadrotor's centre of mass [m], shape (T, 3)
    ball_pos_w: np.ndarray  # [m], shape (T, 3)
    ball_vel_w: np.ndarray  # [m/s], shape (T, 3)


def _places(
    model: "mujoco.MjModel", data: "mujoco.MjData", scene: Scene
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the position of the vehicle, and position and velocity of the ball."""
    # After mj_step the derived fields describe the state before it.
    mujoco.mj_forward(model, data)
    last = 1 + scene.segments  # world, vehicle, segments
    direction = -data.xmat[last].reshape(3, 3)[:, 2]
    reach = scene.segment_length + scene.ball_offset
    twist = np.empty(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, last, twist, 0)
    ball = data.xpos[last] + reach * direction
    ball_vel = twist[3:] + reach * np.cross(twist[:3], direction)
    return data.qpos[:3].copy(), ball, ball_vel


def run_converged(
    scene: Scene,
    step: float = CONVERGED_STEP,
    times: np.ndarray | None = None,
    armature: float = 0.0,
    integrator: str = "RK4",
) -> OracleRun:
    """Run a scene in MuJoCo C with universal joints, damped inside MuJoCo, and a fixed step.

    Args:
        scene: the scene; each switch of its schedule must fall on a step edge.
        step: integration step [s].
        times: times to record at [s], ascending multiples of the step; by default the end.
        armature: of the hinges [kg m^2].
        integrator: ``RK4`` or ``implicitfast``.

    Returns:
        The recorded places.
    """
    model = build_attached(*vehicle_and_rope(scene), "universal")
    model.dof_armature[6:] = armature  # of the hinges, behind the free joint
    model.opt.timestep = step
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    data = initial_data(model, scene)
    instants = (scene.duration,) if times is None else times
    records = [round(t / step) for t in instants]
    switches = {round(w.t_start / step): w for w in scene.schedule}
    rows = []
    now = 0
    for index in sorted(set(records) | {s for s in switches if s <= max(records)}):
        mujoco.mj_step(model, data, index - now)
        now = index
        if index in records:
            rows.append(_places(model, data, scene))
        if index in switches:
            data.ctrl[:] = (*switches[index].force_b, *switches[index].torque_b)
    return OracleRun(*map(np.stack, zip(*rows)))

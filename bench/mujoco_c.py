"""MuJoCo C on the rope of a scene, at full speed: the reference for the batched simulator's timing.

Contacts and constraints are off, nothing is recorded, and no Python runs within a stretch of
``mj_step``."""

import dataclasses
from collections.abc import Callable

import mujoco

from sim.reference.model import build_attached
from tests.oracle.start import initial_data, vehicle_and_rope
from tests.plants import SCENES
from tests.scenes import Scene, load_scene

HARD_THROW = load_scene(SCENES / "hard_throw.toml")
"""2.2 times the total weight along body z, the rope straight but far from hanging."""

ARMATURE = 2e-7
"""Reflected inertia of the hinges that lets implicitfast stand 2 ms [kg m^2]."""
IMPLICIT_STEP = 2e-3


@dataclasses.dataclass(frozen=True)
class BenchScene:
    """A rope that runs in C."""

    name: str
    step: float  # [s]
    advance: Callable[[int], None]  # so many steps; starts the scene anew whenever it has ended


def start_scene(
    scene: Scene, step: float, integrator: str, armature: float
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """MuJoCo's model and data at the start of a scene, whose first wrench acts throughout.

    Args:
        scene: the rope and its start.
        step: [s]. integrator: RK4 or implicitfast. armature: of the hinges [kg m^2].
    """
    model = build_attached(*vehicle_and_rope(scene), "universal")
    model.dof_armature[6:] = armature  # of the hinges, behind the free joint
    model.opt.timestep = step
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    data = initial_data(model, scene)
    first = scene.schedule[0]
    data.ctrl[:] = (*first.force_b, *first.torque_b)
    return model, data


def time_scene(
    scene: Scene, name: str, step: float, integrator: str = "RK4", armature: float = 0.0
) -> BenchScene:
    """A rope that runs in C; arguments as of :func:`start_scene`."""
    model, data = start_scene(scene, step, integrator, armature)
    start = data.qpos.copy(), data.qvel.copy()
    length = round(scene.duration / step)
    done = 0

    def advance(count: int) -> None:
        nonlocal done
        while count > 0:
            if done == length:
                data.qpos[:] = start[0]
                data.qvel[:] = start[1]
                data.time = 0.0
                done = 0
            stretch = min(count, length - done)
            mujoco.mj_step(model, data, stretch)
            done += stretch
            count -= stretch

    return BenchScene(name, step, advance)

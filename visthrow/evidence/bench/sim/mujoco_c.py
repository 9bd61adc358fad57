"""MuJoCo C on the rope of a scene, as fast as it goes: what the batched simulator is timed against.

Contacts and constraints are off, nothing is recorded, and no Python runs within a stretch of ``mj_step``.
"""

import dataclasses
from collections.abc import Callable

import mujoco

from sim.reference.model import build_attached
from sim.reference.oracle import initial_data, rope_from_scene
from sim.reference.scene import Scene

ARMATURE = 2e-7
"""Reflected inertia of the hinges that lets implicitfast stand 2 ms [kg m^2]."""
IMPLICIT_STEP = 2e-3


@dataclasses.dataclass(frozen=True)
class BenchScene:
    """A rope that runs in C."""

    name: str
    step: float  # [s]
    advance: Callable[[int], None]  # so many steps; starts the scene anew whenever it has ended


def _build(scene: Scene, name: str, step: float, integrator: int, armature: float) -> BenchScene:
    model = build_attached(rope_from_scene(scene), "universal", armature)
    model.opt.timestep, model.opt.integrator = step, integrator
    data = initial_data(model, scene)
    start = data.qpos.copy(), data.qvel.copy()
    first = scene.schedule[0]
    length, done = round(scene.duration / step), 0

    def advance(count: int) -> None:
        nonlocal done
        while count > 0:
            if done == length:
                data.qpos[:], data.qvel[:], data.time, done = start[0], start[1], 0.0, 0
            stretch = min(count, length - done)
            mujoco.mj_step(model, data, stretch)
            done += stretch
            count -= stretch

    data.ctrl[:] = (*first.force_b, *first.torque_b)
    return BenchScene(name, step, advance)


def rk4_scene(scene: Scene, step: float) -> BenchScene:
    """Return the physical rope with MuJoCo's RK4; the schedule's first wrench acts throughout.

    Args:
        scene: the rope and its start.
        step: [s]; for a fair figure the longest that is accurate, see :mod:`visthrow.evidence.bench.sim.cpu`.
    """
    return _build(scene, f"MuJoCo C, RK4, {step * 1e3:g} ms", step, mujoco.mjtIntegrator.mjINT_RK4, 0.0)


def implicitfast_scene(scene: Scene, step: float = IMPLICIT_STEP, armature: float = ARMATURE) -> BenchScene:
    """Return the rope with armature and MuJoCo's implicitfast: fast, and about a centimetre off in the hard throw."""
    name = f"MuJoCo C, implicitfast, armature {armature:g}, {step * 1e3:g} ms"
    return _build(scene, name, step, mujoco.mjtIntegrator.mjINT_IMPLICITFAST, armature)

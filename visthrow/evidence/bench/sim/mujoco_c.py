"""MuJoCo C on the rope of a scene, as fast as it goes: what the batched simulator is timed against.

Contacts and constraints are off, nothing is recorded, and no Python runs within a stretch of ``mj_step``.
"""

import dataclasses
from collections.abc import Callable

import mujoco
import numpy as np

from sim.reference.model import build_attached
from sim.reference.oracle import converged, initial_data, rope_from_scene
from sim.reference.scene import Scene

ARMATURE = 2e-7
"""Reflected inertia of the hinges that lets implicitfast stand 2 ms [kg m^2]."""
IMPLICIT_STEP = 2e-3
CANDIDATES = (1000, 800, 625, 500, 400, 250, 200, 125, 100, 50)
"""Steps that a search tries, longest first [us]; all divide 0.5 s, and the schedules' switches where it matters."""


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


def largest_accurate_step(scene: Scene, tolerance: float = 1e-3) -> float:
    """Return the longest RK4 step [s] of ``CANDIDATES`` that ends a scene within ``tolerance`` [m] of a converged run.

    Raises:
        ValueError: no candidate does.
    """
    truth = converged(scene)
    for microseconds in CANDIDATES:
        step = microseconds / 1e6
        if any(abs(t - step * round(t / step)) > 1e-9 for t in (scene.duration, *(w.t_start for w in scene.schedule))):
            continue
        run = converged(scene, step)
        errors = (run.ball_pos_w - truth.ball_pos_w)[-1], (run.pos_w - truth.pos_w)[-1]
        if all(np.linalg.norm(error) <= tolerance for error in errors):
            return step
    raise ValueError(f"bench: no RK4 step of {CANDIDATES} us ends the scene within {tolerance} m")


def rk4_scene(scene: Scene, step: float) -> BenchScene:
    """Return the physical rope with MuJoCo's RK4; the schedule's first wrench acts throughout.

    Args:
        scene: the rope and its start.
        step: [s]; for a fair figure ``largest_accurate_step(scene)``.
    """
    return _build(scene, f"MuJoCo C, RK4, {step * 1e3:g} ms", step, mujoco.mjtIntegrator.mjINT_RK4, 0.0)


def implicitfast_scene(scene: Scene, step: float = IMPLICIT_STEP, armature: float = ARMATURE) -> BenchScene:
    """Return the rope with armature and MuJoCo's implicitfast: fast, and about a centimetre off in the hard throw."""
    name = f"MuJoCo C, implicitfast, armature {armature:g}, {step * 1e3:g} ms"
    return _build(scene, name, step, mujoco.mjtIntegrator.mjINT_IMPLICITFAST, armature)

"""Scenes, read from files: a quadrotor, a rope and a schedule of wrenches, which every plant of the
project flies.
"""

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sim.params import GRAVITY


@dataclass(frozen=True)
class Wrench:
    """One entry of a schedule: a constant body wrench from ``t_start`` to the next entry's."""

    t_start: float  # [s]
    force_b: tuple[float, float, float]  # at the centre of mass, body frame [N]
    torque_b: tuple[float, float, float]  # about the centre of mass, body frame [N m]


@dataclass(frozen=True)
class Scene:
    """A bare rigid quadrotor with a straight rope of equal rigid segments, a ball on its end and a
    wrench schedule.

    The same rope as ``sim.params.RopeParams`` describes. Gravity acts along -z with
    ``sim.params.GRAVITY``; no air.
    """

    mass: float  # of the quadrotor [kg]
    inertia: tuple[float, float, float]  # principal moments about the centre of mass [kg m^2]
    pos_w: tuple[float, float, float]  # of the centre of mass [m]
    quat_wb: tuple[float, float, float, float]  # xyzw
    vel_w: tuple[float, float, float]  # [m/s]
    rate_b: tuple[float, float, float]  # [rad/s]
    mount: tuple[float, float, float]  # rope attachment, body frame [m]
    segments: int  # L
    segment_length: float  # [m]
    # of one segment, centre of mass in its middle, transverse inertia m l^2 / 12 [kg]
    segment_mass: float
    ball_mass: float  # [kg]
    ball_inertia: float  # transverse, about the ball's centre [kg m^2]
    ball_offset: float  # ball's centre past the end of the last segment [m]
    # of the whole rope from the mount outwards, world frame, any length
    direction: tuple[float, float, float]
    # angular velocity of the whole rope, world frame [rad/s]; axial part ignored
    cable_rate_w: tuple[float, float, float]
    joint_damping: float  # [N m s]
    duration: float  # [s]
    schedule: tuple[Wrench, ...]

    @property
    def total_mass(self) -> float:
        """Mass of quadrotor, rope and ball [kg]."""
        return self.mass + self.segments * self.segment_mass + self.ball_mass

    def cable_dir_w(self) -> np.ndarray:
        """Unit directions of the segments from the mount outwards, shape (L, 3), world frame."""
        direction = np.asarray(self.direction, dtype=np.float64)
        return np.tile(direction / np.linalg.norm(direction), (self.segments, 1))

    def cable_vel_w(self) -> np.ndarray:
        """Time derivatives of the directions [1/s], shape (L, 3), world frame."""
        return np.cross(np.asarray(self.cable_rate_w, dtype=np.float64), self.cable_dir_w())


def wrench_at(scene: Scene, time: float) -> Wrench:
    """Return the entry that acts at ``time`` [s]; a switch acts from its ``t_start`` on."""
    active = scene.schedule[0]
    for entry in scene.schedule:
        if entry.t_start <= time + 1e-9:
            active = entry
    return active


def load_scene(path: str | Path) -> Scene:
    """Read a scene from a TOML file with every field of ``Scene``; ``schedule`` is an array of
    tables. A ``force_b`` may be given as ``thrust_weights`` instead: a force along body z in units
    of the total weight.
    """
    raw = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    entries = raw.pop("schedule")
    scene = Scene(**with_tuples(raw), schedule=())
    schedule = []
    for entry in entries:
        lift = entry.pop("thrust_weights", 0.0) * scene.total_mass * GRAVITY
        schedule.append(Wrench(**{"force_b": (0.0, 0.0, lift)} | with_tuples(entry)))
    return replace(scene, schedule=tuple(schedule))


def with_tuples(table: dict) -> dict:
    """Return a table with tuples for its lists."""
    return {key: tuple(value) if isinstance(value, list) else value for key, value in table.items()}

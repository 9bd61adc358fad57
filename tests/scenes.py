"""Scenes: a quadrotor, a rope and a schedule of wrenches, which every plant of the project flies;
from files, and what acts when.
"""

import itertools
import tomllib
from dataclasses import dataclass, fields
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

    Raises:
        ValueError: a vector of the wrong length, no segment, or a schedule that does not start at 0
            or does not ascend.
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

    def __post_init__(self) -> None:
        lengths = dict.fromkeys(
            ("inertia", "pos_w", "vel_w", "rate_b", "mount", "direction", "cable_rate_w"), 3
        ) | {"quat_wb": 4}
        for name, size in lengths.items():
            if len(getattr(self, name)) != size:
                raise ValueError(
                    f"scene: {name} has {len(getattr(self, name))} numbers, expected {size}"
                )
        if self.segments < 1:
            raise ValueError(f"scene: segments is {self.segments}, expected at least 1")
        starts = [entry.t_start for entry in self.schedule]
        if not starts or starts[0] != 0.0 or any(b <= a for a, b in itertools.pairwise(starts)):
            raise ValueError(
                f"scene: schedule starts at {starts}, expected 0 and then ascending times"
            )

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
    """Read a scene from a TOML file.

    Args:
        path: file with every field of ``Scene``; ``schedule`` as an array of tables. A ``force_b``
            may be given as ``thrust_weights`` instead: a force along body z in units of the total
            weight.

    Raises:
        ValueError: unknown or missing key; the message names file and key.
    """
    with open(path, "rb") as file:
        raw = tomllib.load(file)
    known = {f.name for f in fields(Scene)}
    if raw.keys() != known:
        raise ValueError(
            f"{path}: unknown keys {sorted(raw.keys() - known)}, missing keys"
            f" {sorted(known - raw.keys())}"
        )
    entries = raw.pop("schedule")
    values = {key: tuple(value) if isinstance(value, list) else value for key, value in raw.items()}
    weight = (
        values["mass"] + values["segments"] * values["segment_mass"] + values["ball_mass"]
    ) * GRAVITY
    schedule = []
    for entry in entries:
        allowed = {"t_start", "torque_b", "thrust_weights"}, {"t_start", "torque_b", "force_b"}
        if entry.keys() not in allowed:
            raise ValueError(
                f"{path}: schedule entry has {sorted(entry)}, expected t_start, torque_b and"
                " force_b or thrust_weights"
            )
        force = (
            entry["force_b"] if "force_b" in entry else (0.0, 0.0, entry["thrust_weights"] * weight)
        )
        schedule.append(Wrench(float(entry["t_start"]), tuple(force), tuple(entry["torque_b"])))
    return Scene(**values, schedule=tuple(schedule))

"""Scenes from files, and what acts in them when."""

import tomllib
from dataclasses import fields
from pathlib import Path

from sim.params import GRAVITY
from sim.reference.scene import Scene, Wrench


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
        path: file with every field of ``Scene``; ``schedule`` as an array of tables. A ``force_b`` may be given as
            ``thrust_weights`` instead: a force along body z in units of the total weight.

    Raises:
        ValueError: unknown or missing key; the message names file and key.
    """
    with open(path, "rb") as file:
        raw = tomllib.load(file)
    known = {f.name for f in fields(Scene)}
    if raw.keys() != known:
        raise ValueError(
            f"{path}: unknown keys {sorted(raw.keys() - known)}, missing keys {sorted(known - raw.keys())}"
        )
    entries = raw.pop("schedule")
    values = {key: tuple(value) if isinstance(value, list) else value for key, value in raw.items()}
    weight = (values["mass"] + values["segments"] * values["segment_mass"] + values["ball_mass"]) * GRAVITY
    schedule = []
    for entry in entries:
        allowed = {"t_start", "torque_b", "thrust_weights"}, {"t_start", "torque_b", "force_b"}
        if entry.keys() not in allowed:
            raise ValueError(
                f"{path}: schedule entry has {sorted(entry)}, expected t_start, torque_b and force_b or thrust_weights"
            )
        force = entry["force_b"] if "force_b" in entry else (0.0, 0.0, entry["thrust_weights"] * weight)
        schedule.append(Wrench(float(entry["t_start"]), tuple(force), tuple(entry["torque_b"])))
    return Scene(**values, schedule=tuple(schedule))

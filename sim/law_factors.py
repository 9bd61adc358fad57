"""Factors of laws outside the catalogue, and the definitions of their quantities, which kernels and
diagnosis share.
"""

import tomllib
from pathlib import Path

LAW_FACTORS = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
"""``groups`` of quantities; ``scalars`` and, for each block, ``vectors``: name -> symbol, unit,
quantity and the measured or simulated quantities that it is computed from.
"""

UNITS = {
    "unit_x": (1.0, 0.0, 0.0),
    "unit_y": (0.0, 1.0, 0.0),
    "unit_z": (0.0, 0.0, 1.0),
    "unit_down": (0.0, 0.0, -1.0),
}
"""Unit vectors, in the world frame for forces and in the body frame for torques."""

QUANTITIES = {
    "axis_x": ("to_world", "quat_wb", "unit_x"),
    "axis_y": ("to_world", "quat_wb", "unit_y"),
    "axis_z": ("to_world", "quat_wb", "unit_z"),
    "axis_down": ("to_world", "quat_wb", "unit_down"),
    "rate_w": ("to_world", "quat_wb", "rate_b"),
    "vel_b": ("to_body", "quat_wb", "vel_w"),
    "cable_dir_b": ("to_body", "quat_wb", "cable_dir_w"),
    "swing_b": ("to_body", "quat_wb", "swing"),
    "|slope|": ("absolute", "slope"),
    "along": ("inner", "vel_w", "axis_z"),
    "across": ("normal_part", "vel_w", "axis_z"),
    "speed_across_squared": ("inner", "across", "across"),
    "rate_yaw": ("inner", "rate_b", "unit_z"),
    "height": ("inner", "pos_w", "unit_z"),
    "inverse_height": ("inverse", "height"),
    "payload_vel": ("difference", "payload_vel_w", "vel_w"),  # against the vehicle
    "swing": ("normal_part", "payload_vel", "cable_dir_w"),
    "under": ("inner", "cable_dir_w", "axis_down"),
    "sideways": ("normal_part", "cable_dir_w", "axis_z"),
    "mount_arm": ("to_world", "quat_wb", "mount_b"),
    "mount_pos_w": ("sum", "pos_w", "mount_arm"),
    "reach_w": ("difference", "payload_pos_w", "mount_pos_w"),  # from the mount to the payload
    "mount_turn": ("to_world", "quat_wb", "rate_b x mount_b"),
    "mount_vel_w": ("sum", "vel_w", "mount_turn"),
    "reach_vel": ("difference", "payload_vel_w", "mount_vel_w"),
    "rope_rate": ("turn_rate", "reach_w", "reach_vel"),
    "rope_rate_b": ("to_body", "quat_wb", "rope_rate"),
    "joint_rate_b": ("difference", "rope_rate_b", "rate_b"),  # of the rope against the vehicle
    "friction": ("saturated", "joint_rate_b"),
    "apart": ("difference", "pos_w", "neighbour_pos_w"),
    "inverse_distance": ("inverse", "|apart|"),
    "neighbour": ("scaled", "inverse_distance", "apart"),
    "distance_upright": ("inner", "neighbour", "unit_z"),
}
"""Quantities computed from measured or simulated ones: name -> operation and its arguments.

``sim/kernels/laws.py`` and ``diagnose/models/law_terms.py`` implement the operations."""


def definition(name: str) -> tuple[str, ...]:
    """Return the operation that computes a quantity, and its arguments.

    ``name``: of :data:`QUANTITIES`, ``|a|`` for a norm, or ``a x b`` for a cross product. Raises
    KeyError: an unknown quantity.
    """
    if name in QUANTITIES:
        return QUANTITIES[name]
    first, crossed, second = name.partition(" x ")
    if crossed:
        return "cross", first, second
    if name.startswith("|"):
        return "size", name.strip("|")
    raise KeyError(name)

"""Named conditions on a setting's blocks, and changes of their kinds, for ``configs/effects``."""

import math
from collections.abc import Callable
from typing import Any

from sim.effects.setting import AERODYNAMICS, Setting
from sim.params import GRAVITY, change_values

SEGMENTS = 15  # segments of a flexible rope (the paper, Sec. III-B)
# time constant of Betaflight's default iterm_relax_cutoff, 15 Hz [s]
RELAX = 1.0 / (2.0 * math.pi * 15.0)
# shortest rope to which the effect of the payload's offset applies [m]: the offset, at most 0.1 m,
# is subtracted from its length
LONGEST_OFFSET = 0.12


def _replace_in_vehicle(setting: Setting, values: dict[str, Any]) -> Setting:
    """Return a setting with new values of its vehicle; ``values``: path in the vehicle -> value."""
    return change_values(
        setting, {f"plant.vehicle.{path}": value for path, value in values.items()}
    )


def _lagging(setting: Setting) -> Setting:
    tau = setting.plant.vehicle.motor.time_constant
    return _replace_in_vehicle(
        setting, {"motor.kind": "asymmetric", "motor.time_constant_down": tau}
    )


def _kind(block: str, *kinds: str) -> Callable[[Setting], bool]:
    """Return the condition that a block of a setting's vehicle is of one of the given kinds."""
    return lambda setting: getattr(setting.plant.vehicle, block).kind in kinds


PID = _kind("controller", "betaflight", "motor_mixing")


def _motor_mixing(setting: Setting) -> Setting:
    """Return the setting with the controller ``motor_mixing``: the same gains in hover, iterm_relax
    of 15 Hz instead of the set-point filter, and no feed-forward.
    """
    plant = setting.plant
    controller = {
        "kind": "motor_mixing",
        "mix_thrust": 0.25 * plant.total_mass * GRAVITY,
        "setpoint_time_constant": RELAX,
        "feedforward_gain": (0.0, 0.0, 0.0),
        "calibration_voltage": plant.vehicle.battery.reference_voltage,
    }
    return _replace_in_vehicle(
        setting, {f"controller.{name}": value for name, value in controller.items()}
    )


CONDITIONS: dict[str, Callable[[Setting], bool]] = {
    "always": lambda s: True,
    "aerodynamics": _kind("aero", "rotor_drag"),
    "no aerodynamics": lambda s: (
        not any(getattr(s.plant.vehicle.aero, name) for name in AERODYNAMICS)
    ),
    "PID controller": PID,
    "proportional controller": _kind("controller", "geometric"),
    "thrust mixing": _kind("controller", "betaflight"),
    "motor mixing": _kind("controller", "motor_mixing"),
    "feed-forward": lambda s: PID(s) and any(s.plant.vehicle.controller.feedforward_gain),
    "integral limit": lambda s: PID(s) and all(s.plant.vehicle.controller.integral_limit),
    "motor lag": _kind("motor", "first_order", "asymmetric"),
    "motor lag of two": _kind("motor", "asymmetric"),
    "no motor lag": _kind("motor", "instant"),
    "rotor inertia": lambda s: s.plant.vehicle.rotors.inertia > 0.0,
    "battery": _kind("battery", "sag"),
    "payload inertia": lambda s: s.plant.rope.payload_inertia > 0.0,
    "long rope": lambda s: s.plant.rope.length > LONGEST_OFFSET,
    "flexible rope": lambda s: s.plant.rope.segments > 1,
    "rigid rope": lambda s: s.plant.rope.segments == 1,
    "camera": lambda s: s.camera is not None,
}
"""Name -> condition that a setting must meet for an effect to apply."""

SWITCHES: dict[str, Callable[[Setting], Setting]] = {
    "PID controller": lambda s: _replace_in_vehicle(s, {"controller.kind": "betaflight"}),
    "motor mixing": _motor_mixing,
    "proportional controller": lambda s: _replace_in_vehicle(s, {"controller.kind": "geometric"}),
    "motor lag": _lagging,
    "no motor lag": lambda s: _replace_in_vehicle(s, {"motor.kind": "instant"}),
    "flexible rope": lambda s: change_values(s, {"plant.rope.segments": SEGMENTS}),
    "rigid rope": lambda s: change_values(s, {"plant.rope.segments": 1}),
}
"""Name -> function that replaces a block of a setting by another kind."""

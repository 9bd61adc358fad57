"""What is right or wrong as a whole: which blocks there are at all. theta is 0 or 1, anything above a half counts as 1."""

import dataclasses
from collections.abc import Callable
from typing import Any

from visthrow.diagnose.catalogue.entry import PAYLOAD, POSE, Entry, Key, Setting, entry

SEGMENTS = 15
"""Of a rope that turns out to be flexible (the paper, Sec. III-B)."""
AERO = {
    "drag_x": 0.06,
    "drag_y": 0.06,
    "drag_z": 0.03,
    "parasitic": 0.004,
    "inflow": 0.03,
    "torque_inflow": 0.02,
    "translational_lift": 0.002,
    "flapping": 2e-4,
}
"""Aerodynamics of a quadrotor of 0.2 kg: the values of configs/vehicle/paper.toml, with their sources there."""


def _vehicle(setting: Setting, **parts: dict[str, Any]) -> Setting:
    vehicle = setting.plant.vehicle
    changed = {name: dataclasses.replace(getattr(vehicle, name), **values) for name, values in parts.items()}
    return dataclasses.replace(
        setting, plant=dataclasses.replace(setting.plant, vehicle=dataclasses.replace(vehicle, **changed))
    )


def _segments(setting: Setting, count: int) -> Setting:
    rope = dataclasses.replace(setting.plant.rope, segments=count)
    return dataclasses.replace(setting, plant=dataclasses.replace(setting.plant, rope=rope))


def _lagging(setting: Setting) -> Setting:
    tau = setting.plant.vehicle.motor.time_constant
    return _vehicle(setting, motor={"kind": "asymmetric", "time_constant_down": tau})


def _airless(setting: Setting) -> bool:
    return not any(getattr(setting.plant.vehicle.aero, name) for name in AERO)


def _switch(
    name: str,
    cause: str,
    equation: str,
    block: str,
    channels: tuple[str, ...],
    applies: Callable[[Setting], bool],
    switch: Callable[[Setting], Setting],
    simpler: bool = False,
) -> Entry:
    return entry(
        name,
        cause,
        equation,
        "1",
        block,
        (0.0, 1.0),
        1.0,
        0.1,
        channels,
        "the paper, Table I and its ablations",
        (),
        manoeuvres=("rate doublets", "throws"),
        applies=applies,
        switch=switch,
        simpler=simpler,
    )


ENTRIES: tuple[Entry, ...] = (
    entry(
        "aerodynamics",
        "The vehicle feels the air as a quadrotor of its size does",
        "theta times usual drag, inflow, lift, flapping",
        "1",
        "aerodynamics",
        (0.0, 4.0),
        1.0,
        0.03,
        POSE,
        "configs/vehicle/paper.toml",
        [Key(f"plant.vehicle.aero.{key}", factor=value) for key, value in AERO.items()],
        confused=("rotor_drag",),
        manoeuvres=("speed sweep to 5 m/s",),
        applies=_airless,
    ),
    _switch(
        "controller_kind",
        "The rate controller has filters, integral and feed-forward",
        "the PID in place of the proportional law",
        "rate controller",
        POSE,
        lambda s: s.plant.vehicle.controller.kind == "geometric",
        lambda s: _vehicle(s, controller={"kind": "betaflight"}),
    ),
    _switch(
        "motor_lag",
        "The motors lag",
        "Omega' = (Omega* - Omega) / tau_m in place of Omega = Omega*",
        "motor",
        POSE,
        lambda s: s.plant.vehicle.motor.kind == "instant",
        _lagging,
    ),
    _switch(
        "rope_flexible",
        "The rope bends",
        f"{SEGMENTS} segments in place of one",
        "rope",
        POSE + PAYLOAD,
        lambda s: s.plant.rope.segments == 1,
        lambda s: _segments(s, SEGMENTS),
    ),
    _switch(
        "controller_simple",
        "The rate controller is a plain proportional one",
        "k J (w_cmd - w) in place of the PID",
        "rate controller",
        POSE,
        lambda s: s.plant.vehicle.controller.kind == "betaflight",
        lambda s: _vehicle(s, controller={"kind": "geometric"}),
        simpler=True,
    ),
    _switch(
        "motor_instant",
        "The motors follow at once",
        "Omega = Omega*",
        "motor",
        POSE,
        lambda s: s.plant.vehicle.motor.kind != "instant",
        lambda s: _vehicle(s, motor={"kind": "instant"}),
        simpler=True,
    ),
    _switch(
        "rope_rigid",
        "The rope is a rigid rod",
        "one segment in place of many",
        "rope",
        POSE + PAYLOAD,
        lambda s: s.plant.rope.segments > 1,
        lambda s: _segments(s, 1),
        simpler=True,
    ),
)
"""Switches to a simpler block are not in the default catalogue: each is a kernel of its own to compile."""

"""Setting of a simulated flight, and its generalisation, in which effects change only numbers."""

import dataclasses
from dataclasses import dataclass
from typing import Any

from sim.params import PlantParams, SensingParams, change_values

AERODYNAMICS = (
    "drag_x",
    "drag_y",
    "drag_z",
    "parasitic",
    "inflow",
    "torque_inflow",
    "translational_lift",
    "flapping",
)
"""Coefficients of the vehicle's aerodynamics; all are zero for a vehicle without air forces."""


@dataclass(frozen=True)
class Setting:
    """Setting of a replay: the plant, the sensors' errors, and the step."""

    plant: PlantParams
    sensing: SensingParams = dataclasses.field(default_factory=SensingParams)
    # square of the ratio of integration step to requested step, to which errors are proportional
    step_square: float = 1.0
    # camera.params.CameraParams of the keypoints in the logs, not used by the simulator; or None
    camera: Any = None


def generalise(setting: Setting) -> Setting:
    """Return the same plant with the most general kinds of blocks.

    Missing aerodynamics become zero coefficients; a first-order motor becomes one with two equal
    time constants."""
    vehicle = setting.plant.vehicle
    values: dict[str, Any] = {}
    if vehicle.aero.kind == "none":
        values["aero.kind"] = "rotor_drag"
        values |= {f"aero.{name}": 0.0 for name in AERODYNAMICS}
    if vehicle.motor.kind == "first_order":
        values["motor.kind"] = "asymmetric"
        values["motor.time_constant_down"] = vehicle.motor.time_constant
    return change_values(
        setting, {f"plant.vehicle.{path}": value for path, value in values.items()}
    )


def specialise(plant: PlantParams, before: PlantParams) -> PlantParams:
    """Return the plant with the kinds of blocks that it had before it was generalised, wherever
    they are still equivalent.
    """
    motor = plant.vehicle.motor
    aero = plant.vehicle.aero
    values: dict[str, Any] = {}
    even = motor.time_constant == motor.time_constant_down
    if before.vehicle.motor.kind != "asymmetric" and even:
        kind = "first_order" if motor.kind == "asymmetric" else motor.kind
        values |= {"vehicle.motor.kind": kind, "vehicle.motor.time_constant_down": 0.0}
    if before.vehicle.aero.kind == "none" and not any(getattr(aero, name) for name in AERODYNAMICS):
        values["vehicle.aero"] = before.vehicle.aero
    return change_values(plant, values)

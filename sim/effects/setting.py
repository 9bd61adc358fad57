"""What a simulated flight is described by, and the description in which every effect is a change of
numbers.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

from sim.params import PlantParams, SensingParams, VehicleParams

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
"""Coefficients of the vehicle's aerodynamics; all zero is a vehicle that feels no air."""


@dataclass(frozen=True)
class Setting:
    """The setting of a replay: the plant that training reads too, the sensors, and the step."""

    plant: PlantParams
    sensing: SensingParams = dataclasses.field(default_factory=SensingParams)
    step_square: float = (
        1.0  # of the integration step against the one asked for: errors grow with it
    )
    # camera.params.CameraParams whose keypoints the logs hold, which the simulator knows nothing
    # of; or None
    camera: Any = None


def generalised(setting: Setting) -> Setting:
    """Return the same plant in the kinds of block that have most numbers.

    A plant without aerodynamics becomes one with zero coefficients, a first-order motor one of two
    equal lags."""
    vehicle = setting.plant.vehicle
    if vehicle.aero.kind == "none":
        frozen = dataclasses.replace(
            vehicle.aero, kind="rotor_drag", **dict.fromkeys(AERODYNAMICS, 0.0)
        )
        vehicle = dataclasses.replace(vehicle, aero=frozen)
    if vehicle.motor.kind == "first_order":
        even = dataclasses.replace(
            vehicle.motor, kind="asymmetric", time_constant_down=vehicle.motor.time_constant
        )
        vehicle = dataclasses.replace(vehicle, motor=even)
    return dataclasses.replace(setting, plant=dataclasses.replace(setting.plant, vehicle=vehicle))


def specialised(plant: PlantParams, before: PlantParams) -> PlantParams:
    """Return the plant with the kinds that it had before it was generalised, wherever they still
    say the same.
    """
    vehicle: VehicleParams = plant.vehicle
    motor = vehicle.motor
    aero = vehicle.aero
    if (
        before.vehicle.motor.kind != "asymmetric"
        and motor.time_constant == motor.time_constant_down
    ):
        kind = "first_order" if motor.kind == "asymmetric" else motor.kind
        vehicle = dataclasses.replace(
            vehicle, motor=dataclasses.replace(motor, kind=kind, time_constant_down=0.0)
        )
    if before.vehicle.aero.kind == "none" and not any(getattr(aero, name) for name in AERODYNAMICS):
        vehicle = dataclasses.replace(vehicle, aero=before.vehicle.aero)
    return dataclasses.replace(plant, vehicle=vehicle)

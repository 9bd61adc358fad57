"""A plant described so that every effect is a change of numbers, and back: a kind that is off becomes one with zeros."""

import dataclasses

from sim.params import PlantParams, VehicleParams
from visthrow.diagnose.catalogue import Setting

AIRLESS = ("drag_x", "drag_y", "drag_z", "parasitic", "inflow", "torque_inflow", "translational_lift", "flapping")


def opened(setting: Setting) -> Setting:
    """The same plant: without aerodynamics as with zero coefficients, a first-order motor as one of two equal lags."""
    vehicle = setting.plant.vehicle
    if vehicle.aero.kind == "none":
        still = dataclasses.replace(vehicle.aero, kind="rotor_drag", **dict.fromkeys(AIRLESS, 0.0))
        vehicle = dataclasses.replace(vehicle, aero=still)
    if vehicle.motor.kind == "first_order":
        even = dataclasses.replace(vehicle.motor, kind="asymmetric", time_constant_down=vehicle.motor.time_constant)
        vehicle = dataclasses.replace(vehicle, motor=even)
    return dataclasses.replace(setting, plant=dataclasses.replace(setting.plant, vehicle=vehicle))


def closed(plant: PlantParams, before: PlantParams) -> PlantParams:
    """The plant with the kinds that it had before it was opened, wherever they still say the same."""
    vehicle: VehicleParams = plant.vehicle
    motor, aero = vehicle.motor, vehicle.aero
    if before.vehicle.motor.kind != "asymmetric" and motor.time_constant == motor.time_constant_down:
        kind = "first_order" if motor.kind == "asymmetric" else motor.kind
        vehicle = dataclasses.replace(vehicle, motor=dataclasses.replace(motor, kind=kind, time_constant_down=0.0))
    if before.vehicle.aero.kind == "none" and not any(getattr(aero, name) for name in AIRLESS):
        vehicle = dataclasses.replace(vehicle, aero=before.vehicle.aero)
    return dataclasses.replace(plant, vehicle=vehicle)

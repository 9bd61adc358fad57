"""Other units of length, mass and time for the same plant: what makes vehicles of any size
comparable.

With a unit of time that is the square root of the unit of length, gravity keeps its number, so that
a plant in other units is flown by the same equations with the same gravity. Volts stay volts."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from sim.params import PlantParams

Value = TypeVar("Value")
Dimension = tuple[int, int, int]
"""Exponents of length, mass and time."""

NONE = (0, 0, 0)
LENGTH = (1, 0, 0)
MASS = (0, 1, 0)
TIME = (0, 0, 1)
RATE = (0, 0, -1)
SPEED = (1, 0, -1)
FORCE = (1, 1, -2)
TORQUE = (2, 1, -2)
INERTIA = (2, 1, 0)
POWER = (2, 1, -3)
ANGULAR_DAMPING = (2, 1, -1)
DAMPING = (0, 1, -1)
AREA_DRAG = (-1, 1, 0)
PER_SPEED = (-1, 0, 1)

PLANT: dict[str, dict[Dimension, str]] = {
    "BodyParams": {MASS: "mass", INERTIA: "inertia", LENGTH: "com"},
    "RotorParams": {LENGTH: "x y z radius", NONE: "spin", INERTIA: "inertia"},
    "QueueParams": {TIME: "delay"},
    "ControllerParams": {
        NONE: "kind voltage_compensation calibration_voltage gyro_share",
        ANGULAR_DAMPING: "p_gain",
        TORQUE: "i_gain integral_limit",
        INERTIA: "d_gain feedforward_gain",
        TIME: "setpoint_time_constant gyro_time_constant",
        FORCE: "min_thrust max_thrust mix_thrust",
        RATE: "geometric_gain relax_threshold",
    },
    "MotorParams": {NONE: "kind", TIME: "time_constant time_constant_down"},
    "BatteryParams": {
        NONE: "kind ocv efficiency reference_voltage",
        (2, 1, -2): "capacity",
        (-2, -1, 3): "resistance",
        TIME: "time_constant",
        POWER: "idle_power",
    },
    "ThrustParams": {
        (1, 1, 0): "k_f",
        (1, 1, -1): "k_1",
        NONE: "voltage_coefficient gain torque_gain",
        LENGTH: "torque_ratio",
    },
    "AeroParams": {
        NONE: "kind",
        DAMPING: "drag_x drag_y drag_z",
        AREA_DRAG: "parasitic",
        PER_SPEED: "inflow torque_inflow",
        (-2, 0, 2): "translational_lift",
        TIME: "flapping",
    },
    "VehicleParams": {LENGTH: "collision_radius"},
    "RopeParams": {
        NONE: "segments downwash",
        LENGTH: "length payload_offset payload_radius mount payload_sides cables_apart",
        MASS: "rope_mass payload_mass gripper_mass",
        INERTIA: "payload_inertia",
        ANGULAR_DAMPING: "joint_damping mount_damping",
        DAMPING: "swing_damping",
        AREA_DRAG: "payload_drag payload_side payload_lift",
        (0, -1, 2): "compliance",
    },
    "ReleaseParams": {
        NONE: "threshold clearance_samples rope_tail",
        TIME: "lag",
        LENGTH: "landing_height clearance_margin",
        (-1, -1, 3): "lag_tension",
        SPEED: "kick_w kick_along",
    },
    "SimParams": {TIME: "control_period substep", NONE: "gamma max_turn precision solver"},
    "AirParams": {SPEED: "wind_w", NONE: "ground_effect"},
    "PlantParams": {},
}
"""Dimensions of all fields of a plant that are no table themselves, a table of `sim.params` each.
"""


@dataclass(frozen=True)
class Units:
    """Units of length [m] and mass [kg]; that of time [s] follows from gravity."""

    length: float
    mass: float

    @property
    def time(self) -> float:
        """Unit of time [s]."""
        return math.sqrt(self.length)

    def size(self, dimension: Dimension) -> float:
        """Size of the unit of a dimension in SI units."""
        length, mass, time = dimension
        return self.length**length * self.mass**mass * self.time**time

    @property
    def inverse(self) -> "Units":
        """Units that lead back."""
        return Units(1.0 / self.length, 1.0 / self.mass)


def in_units(
    value: Value, units: Units, dimensions: Mapping[str, Mapping[Dimension, str]] = PLANT
) -> Value:
    """Dataclass of SI values with its numbers stated in other units, tables in it too.

    Raises ValueError: a field whose dimension is not told, or a plant with laws, whose coefficients
    have none of their own."""
    if isinstance(value, PlantParams) and value.laws:
        raise ValueError(
            f"a plant with {len(value.laws)} laws in other units; expected none, their coefficients"
            " have no dimension"
        )
    kinds = dimensions.get(type(value).__name__, {})
    dimension_of = {name: dimension for dimension, names in kinds.items() for name in names.split()}

    def stated(name: str, item: Any) -> Any:
        if dataclasses.is_dataclass(item) and not isinstance(item, type):
            return in_units(item, units, dimensions)
        if item == ():
            return item
        if name not in dimension_of:
            raise ValueError(
                f"{type(value).__name__}.{name}: no dimension told; there are"
                f" {sorted(dimension_of)}"
            )
        if dimension_of[name] == NONE:
            return item
        size = units.size(dimension_of[name])
        return tuple(x / size for x in item) if isinstance(item, tuple) else item / size

    fields = {f.name: stated(f.name, getattr(value, f.name)) for f in dataclasses.fields(value)}  # type: ignore[arg-type]
    return type(value)(**fields)

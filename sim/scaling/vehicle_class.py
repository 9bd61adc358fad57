"""A class of vehicles: a known vehicle scaled to another size, with random deviations.

For vehicles of equal shape, density and Froude number, the arm is proportional to the cube root of
the mass, thrust to the mass, inertia to mass times arm squared, and times to the square root of the
arm. The known vehicle is scaled in this way by :class:`sim.scaling.units.Units`, then multiplied by
random factors. The delays of links and sensors do not depend on size and stay in seconds."""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from camera.field_bounds import BoundedFields, Positive
from sim.params import GRAVITY, PlantParams, VehicleParams, change_values
from sim.scaling.units import Units, convert_units

Range = tuple[float, float]

SCALES: dict[str, dict[str, str]] = tomllib.loads(
    Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")
)
"""Table -> path of a number -> its factors."""


@dataclass(frozen=True)
class FleetParams(BoundedFields):
    """Ranges of the log-uniform distributions of vehicle, rope and release. Factors are relative to
    the known vehicle after scaling.

    The task and the numerics of an experiment with a fleet are in units of ``rope_length`` and
    ``total_mass``: for each vehicle, ``rope_length`` metres there equal its rope's length."""

    count: int  # number of vehicles; 0: only the experiment's vehicle, in SI units
    first: int  # number of the first vehicle; vehicle k is the same in every draw
    seed: int
    rope_length: Positive  # [m]
    total_mass: Positive  # of vehicle, rope and payload [kg]
    # smallest ratio of full thrust to total weight, which limits the payload's mass [-]
    least_thrust: Positive
    mass: Range  # of the vehicle [kg]
    thrust: Range  # factor of the full thrust
    arm: Range  # factor
    inertia: Range  # factor, in addition to the arm squared
    yaw_inertia: Range  # factor of the inertia about z, in addition to inertia
    motor_lag: Range  # factor
    propeller: Range  # factor of the radius, in addition to the arm
    torque_ratio: Range  # factor, in addition to those of the radius
    rotor_inertia: Range  # factor, in addition to the radius squared
    # factor; all gains are proportional to the inertia, p_gain inversely to the motor's lag
    p_gain: Range
    i_gain: Range  # factor
    d_gain: Range  # factor
    feedforward: Range  # factor
    filters: Range  # factor of the controller's time constants
    delay: Range  # of commands [s]
    resistance: Range  # factor of the battery's
    compensation: Range  # of the voltage [-]
    drag: Range  # factor of all aerodynamic coefficients
    rope: Range  # factor of the length
    payload: Range  # factor of the mass, limited by least_thrust
    payload_size: Range  # factor of the radius
    rope_mass: Range  # factor of the mass per length
    mount: Range  # factor of the mount's distance from the centre of mass
    lag: Range  # of the release [s]
    yaw_loop: Positive | None = (
        # largest ratio of :func:`yaw_rate` to the known vehicle's, to which yaw gains are reduced
        None
    )

    def __post_init__(self) -> None:
        """Raise ValueError for invalid ranges."""
        super().__post_init__()
        if self.count < 0 or self.first < 0 or self.seed < 0:
            raise ValueError(
                f"fleet.count is {self.count}, first {self.first}, seed {self.seed}; expected 0 or"
                " more of each"
            )
        for name, (low, high) in self.ranges.items():
            if not 0.0 < low <= high < math.inf:
                raise ValueError(
                    f"fleet.{name} is {low} to {high}; expected an ascending range above 0"
                )

    @property
    def ranges(self) -> dict[str, Range]:
        """Name -> range, in the order of the fields."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.type == Range}

    def units_of(self, plant: PlantParams) -> Units:
        """Return the units in which a plant's rope length and total mass are this class's."""
        return Units(plant.rope.length / self.rope_length, plant.total_mass / self.total_mass)


def draw(fleet: FleetParams, nominal: PlantParams, number: int) -> PlantParams:
    """Draw the vehicle of a number with its rope and release, in SI units. Numerics and air are the
    known plant's.
    """
    low, high = np.log(list(fleet.ranges.values())).T
    factors = np.exp(np.random.default_rng((fleet.seed, number)).uniform(low, high))
    x = dict(zip(fleet.ranges, factors.tolist()))
    ratio = nominal.vehicle.body.mass / x["mass"]
    # scales the known vehicle to the mass that was drawn
    alike = Units(ratio ** (1 / 3), ratio)
    usual = convert_units(nominal.vehicle, alike)
    rope = convert_units(nominal.rope, alike)
    vehicle = _vehicle(usual, x)
    if fleet.yaw_loop is not None:
        vehicle = _calm(vehicle, fleet.yaw_loop * yaw_rate(usual) / yaw_rate(vehicle))
    bare_mass = vehicle.body.mass + rope.rope_mass * x["rope"] * x["rope_mass"]
    margin = 4.0 * vehicle.controller.max_thrust / (fleet.least_thrust * GRAVITY) - bare_mass
    x["payload"] = min(x["payload"], margin / rope.payload_mass)
    return replace(
        nominal,
        vehicle=vehicle,
        rope=replace(rope, **_multiply(rope, "rope", x)),
        release=replace(nominal.release, lag=x["lag"]),
    )


def yaw_rate(v: VehicleParams) -> float:
    """Return the bandwidth of the yaw loop due to the rotors' inertia alone [1/s], in hover.

    The acceleration of a rotor causes an immediate reaction torque on the body, proportional to
    ``J_r`` over the motor's lag. On many vehicles it exceeds the change of drag torque. If this
    bandwidth exceeds the flight controller's update rate, yaw becomes unstable."""
    speed = math.sqrt(v.body.mass * GRAVITY / (4.0 * v.thrust.k_f))
    push = v.rotors.inertia / (
        2.0 * v.thrust.k_f * speed * v.motor.time_constant * v.thrust.torque_ratio
    )
    return push * v.controller.p_gain[2] / v.body.inertia[2]


def _calm(v: VehicleParams, share: float) -> VehicleParams:
    """Return the vehicle with its yaw gains multiplied by ``share``, if that is below 1."""
    c = v.controller
    share = min(share, 1.0)
    names = ("p_gain", "i_gain", "feedforward_gain")
    gains = {name: (*getattr(c, name)[:2], share * getattr(c, name)[2]) for name in names}
    return change_values(v, {f"controller.{name}": gain for name, gain in gains.items()})


def _product(factors: str, x: Mapping[str, float]) -> float:
    """Return the product of factors such as ``arm^2 inertia``."""
    product = 1.0
    for factor in factors.split():
        name, _, power = factor.partition("^")
        product *= x[name] ** int(power or 1)
    return product


def _multiply(owner: Any, table: str, x: Mapping[str, float]) -> dict[str, Any]:
    """Return path -> value for the numbers in a table of :data:`SCALES`, multiplied by its
    factors.
    """
    values: dict[str, Any] = {}
    for path, factors in SCALES[table].items():
        value = attrgetter(path)(owner)
        factor = _product(factors, x)
        many = isinstance(value, tuple)
        values[path] = tuple(factor * v for v in value) if many else factor * value
    return values


def _vehicle(v: VehicleParams, x: dict[str, float]) -> VehicleParams:
    """Return the vehicle multiplied by the factors that were drawn."""
    values = _multiply(v, "vehicle", x)
    for path, factors in SCALES["yaw"].items():
        *level, about_z = values[path]
        values[path] = (*level, about_z * _product(factors, x))
    values["queue.delay"] = x["delay"]
    values["controller.voltage_compensation"] = x["compensation"]
    return change_values(v, values)

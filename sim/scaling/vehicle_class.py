"""A class of vehicles: one that is known, made larger or smaller as real ones are, and changed at
random about that.

Vehicles of one shape and density whose motion looks alike (equal Froude number) have arms as the
cube root of the mass, thrust as the mass, inertia as mass times arm squared, and times as the
square root of the arm: this is :class:`sim.scaling.units.Units` applied to the known vehicle. Every
factor multiplies what that gives. What does not follow size, links and sensors, stays in
seconds."""

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
"""Table -> path of a number -> factors that it is multiplied by."""


@dataclass(frozen=True)
class FleetParams(BoundedFields):
    """Ranges that vehicle, rope and release are drawn from, log-uniform; factors are relative to
    the known vehicle made to size.

    The task and the numerics of an experiment with a fleet are stated in units of ``rope_length``
    and ``total_mass``: what is 0.33 m there is a rope's length for each."""

    count: int  # vehicles drawn; 0: the experiment's own, which is stated in SI units
    first: int  # number of the first one: vehicle k is the same in every draw
    seed: int
    rope_length: Positive  # [m]
    total_mass: Positive  # vehicle and all that hangs on it [kg]
    # full thrust over the weight of all, of the heaviest payload that a vehicle is given [-]
    least_thrust: Positive
    mass: Range  # of the vehicle [kg]
    thrust: Range  # factor of the full thrust
    arm: Range  # factor
    inertia: Range  # factor, besides the arm squared
    yaw_inertia: Range  # factor of the inertia about z, besides the last one
    motor_lag: Range  # factor
    propeller: Range  # factor of the radius
    torque_ratio: Range  # factor, besides the propeller's
    rotor_inertia: Range  # factor, besides the propeller's radius squared
    p_gain: Range  # factor; the gains follow the inertia, p_gain the motor's lag too
    i_gain: Range  # factor
    d_gain: Range  # factor
    feedforward: Range  # factor
    filters: Range  # factor of the controller's time constants
    delay: Range  # of commands [s]
    resistance: Range  # factor of the battery's
    compensation: Range  # of the voltage [-]
    drag: Range  # factor of all aerodynamic coefficients
    rope: Range  # factor of the length
    payload: Range  # factor of the mass, at most what least_thrust leaves
    payload_size: Range  # factor of the radius
    rope_mass: Range  # factor of the mass for a length
    mount: Range  # factor of the mount's distance from the centre of mass
    lag: Range  # of the release [s]
    yaw_loop: Positive | None = (
        # with it, yaw gains are turned down until :func:`yaw_rate` is this times the known
        # vehicle's at most
        None
    )

    def __post_init__(self) -> None:
        """Raise ValueError for ranges that nothing can be drawn from."""
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
        """Ranges by name, in their order."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.type == Range}

    def units_of(self, plant: PlantParams) -> Units:
        """Units in which a plant's rope and total mass have this class's numbers."""
        return Units(plant.rope.length / self.rope_length, plant.total_mass / self.total_mass)


def draw(fleet: FleetParams, nominal: PlantParams, number: int) -> PlantParams:
    """Vehicle of that number with its rope and release, SI units; numerics and air are those of the
    known plant.
    """
    low, high = np.log(list(fleet.ranges.values())).T
    factors = np.exp(np.random.default_rng((fleet.seed, number)).uniform(low, high))
    x = dict(zip(fleet.ranges, factors.tolist()))
    ratio = nominal.vehicle.body.mass / x["mass"]
    # in these units the known vehicle has the mass that was drawn
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
    """Bandwidth of the yaw loop by its rotors' inertia alone [1/s], in hover.

    A rotor that is made to turn faster pushes the body at once, by ``J_r`` over the motor's lag: on
    many vehicles more than by its drag. Where that is faster than a flight controller's clock, yaw
    swings up."""
    speed = math.sqrt(v.body.mass * GRAVITY / (4.0 * v.thrust.k_f))
    push = v.rotors.inertia / (
        2.0 * v.thrust.k_f * speed * v.motor.time_constant * v.thrust.torque_ratio
    )
    return push * v.controller.p_gain[2] / v.body.inertia[2]


def _calm(v: VehicleParams, share: float) -> VehicleParams:
    """Return the vehicle with its yaw gains turned down to a share of them, if that is below 1."""
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
    """Return the numbers of a dataclass that a table of :data:`SCALES` names, times its factors."""
    values: dict[str, Any] = {}
    for path, factors in SCALES[table].items():
        value = attrgetter(path)(owner)
        factor = _product(factors, x)
        many = isinstance(value, tuple)
        values[path] = tuple(factor * v for v in value) if many else factor * value
    return values


def _vehicle(v: VehicleParams, x: dict[str, float]) -> VehicleParams:
    """Return a vehicle with the factors drawn."""
    values = _multiply(v, "vehicle", x)
    for path, factors in SCALES["yaw"].items():
        *level, about_z = values[path]
        values[path] = (*level, about_z * _product(factors, x))
    values["queue.delay"] = x["delay"]
    values["controller.voltage_compensation"] = x["compensation"]
    return change_values(v, values)

"""A plant in other units of length, mass and time flies the same flight: the dimension of every
field is right.
"""

from dataclasses import replace

import numpy as np
from pytest import mark, raises

from sim.hybrid import HybridSim
from sim.params import PlantParams
from sim.scaling.units import Units, convert_units
from tests.configs import load_experiment
from tests.plants import EVERYTHING, plain_vehicle
from visthrow.task import TaskParams, plant_of
from visthrow.task.fleet import TASK

UNITS = Units(2.5, 0.3)
ROUNDING = 1e-7
"""Of a difference after half a second in float64, whose operations round differently in other
units; the landing is iterated to 1e-9 m.
"""


def plant() -> PlantParams:
    """The shipped plant in float64, with a number in every field of the usual blocks that is 0
    there.
    """
    p = plant_of(load_experiment("state"))
    rope = replace(
        p.rope,
        payload_drag=2e-3,
        mount_damping=1e-4,
        swing_damping=2e-3,
        downwash=0.05,
        payload_side=1e-4,
        payload_lift=2e-4,
        compliance=1e-3,
    )
    release = replace(
        p.release, lag_tension=2e-3, kick_w=(0.1, 0.05, 0.02), kick_along=0.1, rope_tail=0.3
    )
    air = replace(p.air, wind_w=(0.5, -0.3, 0.1), ground_effect=1.0)
    thrust = replace(p.vehicle.thrust, k_1=2e-5)
    body = replace(p.vehicle.body, com=(1e-3, -2e-3, 1e-3))
    vehicle = replace(p.vehicle, thrust=thrust, body=body)
    return replace(
        p,
        vehicle=vehicle,
        rope=rope,
        release=release,
        air=air,
        sim=replace(p.sim, precision="float64"),
    )


def fly_hard_throw(p: PlantParams, units: Units) -> dict[str, np.ndarray]:
    """A hard throw of a plant that is stated in these units; all that comes of it in SI units."""
    sim = HybridSim(p, 1, extensions=EVERYTHING)
    sim.place(np.array([[0.0, 0.0, 2.0]]) / units.length)
    force, rate = units.size((1, 1, -2)), 1.0 / units.time
    rng = np.random.default_rng(0)
    for k in range(30):
        thrust, rates = rng.uniform(1.0, 9.0), rng.uniform(-6.0, 6.0, 3)
        sim.set_command(np.array([[thrust / force, *(rates / rate)]]), [k >= 18])
        sim.step()
    sizes = {
        "pos_w": units.length,
        "vel_w": units.length / units.time,
        "rate_b": rate,
        "quat_wb": 1.0,
        "motor_speed": rate,
        "voltage": 1.0,
        "charge_used": 1.0,
        "landing_w": units.length,
        "time_to_impact": units.time,
        "clearance": units.length,
        "separation_time": units.time,
    }
    assert sim.get("attached")[0] == 0
    return {name: sim.get(name) * size for name, size in sizes.items()}


@mark.parametrize("kind", ["betaflight", "motor_mixing"])
def test_a_plant_in_other_units_flies_the_same_flight(kind):
    p = plant()
    if kind == "motor_mixing":  # on a kernel of the oracle's tests
        vehicle = plain_vehicle(p.vehicle, controller=kind)
        p = replace(p, vehicle=vehicle, rope=replace(p.rope, segments=1))
    usual, other = (
        fly_hard_throw(p, Units(1.0, 1.0)),
        fly_hard_throw(convert_units(p, UNITS), UNITS),
    )
    for name, value in usual.items():
        np.testing.assert_allclose(other[name], value, rtol=ROUNDING, atol=ROUNDING, err_msg=name)


def test_every_field_of_plant_and_task_has_a_dimension():
    task = load_experiment("any").task
    assert isinstance(convert_units(task, UNITS, TASK), TaskParams)
    missing = (
        r"control_period has no dimension; .*dimensions.toml, table \[SimParams\], under .*time"
    )
    with raises(ValueError, match=missing):
        convert_units(plant().sim, UNITS, {})

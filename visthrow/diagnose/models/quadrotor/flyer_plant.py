"""The simulator's plant of a setup's quadrotor, with effects of given sizes.

A cable is a massless rod on joints: it pulls, and pushes where a cable would be slack."""

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from numpy import ndarray

from sim.effects.setting import AERODYNAMICS
from sim.params import LawParams, PlantParams, RopeParams, SensingParams, change_values
from visthrow.common.errors import LogError
from visthrow.diagnose.models.catalogue import effects_of
from visthrow.diagnose.models.quadrotor.flyer_params import CableParams, FlyerParams, TorqueParams
from visthrow.task import load_experiment, plant_of

ARM = 1e-3  # lever arm of rotors whose torques are not simulated [m]
# radius of gyration of a vehicle with imposed attitude [m], so large that torques do not turn it
UNTURNED = 100.0
ALMOST_NONE = 1e-9  # instead of 0, where the simulator needs a positive number
AMPLE_LIFT = 1e3  # largest thrust in weights, which is never reached
NO_CABLE = CableParams(1.0, 1.0)  # placeholder for a vehicle without payload


@cache
def _neutral_plant() -> PlantParams:
    """Return a plant for the parameters without effect when thrusts and attitudes are imposed."""
    return plant_of(load_experiment("state"))


def plant_for(params: FlyerParams, laws: tuple[LawParams, ...]) -> PlantParams:
    """Return the plant of a setup without effects; its commands are the motors' current thrusts."""
    base = _neutral_plant()
    torque = params.torque or TorqueParams(
        (params.mass * UNTURNED**2,) * 3, ARM, ARM, ALMOST_NONE, (1.0, -1.0, -1.0, 1.0)
    )
    x, y = torque.arm_x, torque.arm_y
    values: dict[str, Any] = {f"aero.{name}": 0.0 for name in AERODYNAMICS}
    values |= {
        "aero.kind": "rotor_drag",
        "aero.drag_x": params.drag_xy,
        "aero.drag_y": params.drag_xy,
        "aero.drag_z": params.drag_z,
        "battery.kind": "ideal",
        "body.inertia": torque.inertia,
        "body.mass": params.mass,
        "controller.max_thrust": AMPLE_LIFT * params.mass * params.gravity,
        "motor.kind": "instant",
        "queue.delay": 0.0,
        "rotors.inertia": 0.0,
        "rotors.radius": np.sqrt(max(torque.inertia) / params.mass),
        "rotors.spin": torque.spin,
        "rotors.x": (x, x, -x, -x),
        "rotors.y": (y, -y, y, -y),
        "rotors.z": 0.0,
        "thrust.k_1": 1.0,
        "thrust.k_f": ALMOST_NONE,
        "thrust.torque_ratio": max(torque.torque_ratio, ALMOST_NONE),
        "thrust.voltage_coefficient": 0.0,
    }
    cable = params.cable or NO_CABLE
    rope = RopeParams(
        segments=1,
        length=cable.length,
        rope_mass=ALMOST_NONE * cable.mass,
        payload_mass=cable.mass,
        payload_inertia=0.0,
        payload_offset=0.0,
        payload_radius=0.0,
        joint_damping=0.0,
        mount=cable.mount,
    )
    return PlantParams(change_values(base.vehicle, values), rope, base.release, base.sim, laws=laws)


@cache
def _replay(params: FlyerParams, laws: tuple[LawParams, ...]) -> Any:
    """Return the replay of a setup's vehicle (``sim.kernels.replay.lanes.Replay``).

    Raises LogError: the simulator refuses the vehicle or the laws."""
    from sim.kernels.replay.lanes import Replay

    try:
        plants, sensings = [plant_for(params, laws)], [SensingParams()]
        return Replay(plants, sensings, gravity=params.gravity, imposed=True)
    except ValueError as error:
        raise LogError(f"the model cannot fly: {error}") from error


def replay_of(
    params: FlyerParams, laws: tuple[LawParams, ...], sizes: Mapping[str, ndarray]
) -> Any:
    """Return the replay of a setup's vehicle with one plant for each row of effect sizes.

    ``sizes``: effect -> sizes, shape (rows,), for all effects of the model.
    """
    replay = _replay(params, laws)
    count = len(sizes["mass_quad"])
    rows = {name: np.repeat(only, count) for name, only in replay.rows.items()}
    for effect in effects_of("flyer", params):
        for change in effect.changes:
            sign = -1.0 if change.startswith("-") else 1.0
            _number(rows, change.strip("-")).T[:] += sign * sizes[effect.name]
    if params.torque is not None:
        inertia = rows["vehicles"]["body"]["inertia"]
        inertia[:, :2] *= 1.0 + sizes["inertia_xy"][:, None]
        inertia[:, 2] *= 1.0 + sizes["inertia_z"]
    rope = rows["ropes"]
    rope["last_inertia"] = rope["last_mass"] * rope["last_center"] ** 2
    return replay.with_rows(rows)


def _number(rows: Mapping[str, ndarray], path: str) -> ndarray:
    """Return the parameter at a dotted path in all rows of plants and sensors."""
    group, *names = path.split(".")
    number = rows[group]
    for name in names:
        number = number[:, int(name)] if name.isdigit() else number[name]
    return number

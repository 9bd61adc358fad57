"""State of a batch of plants, and inputs and outputs of a control step, as Warp arrays.

E: number of environments, L: number of rope segments. Rope arrays have the segment first, (L, E),
so that neighbouring threads read neighbouring memory."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import warp as wp
from numpy import ndarray

from sim.kernels.structs import QUAD_STATE, Types, make_struct

LEVEL = np.array([0.0, 0.0, 0.0, 1.0])  # attitude of a level vehicle, xyzw

NONFINITE = 1
"""Status bit: the state became non-finite or exceeded :data:`SPEED_LIMIT`, and the environment was
reset to its last valid state; or the command was not finite, and the last one was held.
"""
# status bit: a rod turned faster than a substep resolves; that step has first order only
FALLBACK = 2
COLLISION = 4  # status bit: the payload came closer to the vehicle than both radii
ROPE_IN_ROTOR = 8  # status bit: a joint of the rope passed through a propeller disc

ROPE_FIELDS = {
    "cable_dir_w": "vec3[]",
    "cable_vel_w": "vec3[]",
    "stiffness": "real[]",
}

STATE_FIELDS = {  # types with [] have a row for each segment, that of the queue for each slot
    **QUAD_STATE,
    "mass_scale": "real",
    **ROPE_FIELDS,
    "queue": "vec4[]",  # (D, E) commands, newest first
    "release_timer": "real",  # time to separation [s]; negative: not latched
    "attached": "int",
    "status": "int",
    "force_w": "vec3",  # external force [N]; needs the extension "push"
    "torque_b": "vec3",  # external torque [N m] about the centre of mass, likewise
}

INPUT_FIELDS = {
    "command": "vec4",
    "release": "int",  # non-zero: release the payload
    "mask": "int",  # non-zero: advance this plant
}
"""Inputs of a step. They form a struct, as Warp compiles a kernel for CPUs twice if it has arrays
as arguments, once for contiguous ones.
"""

OUTPUT_FIELDS = {
    "payload_pos_w": "vec3",
    "payload_vel_w": "vec3",  # at the end of the step, or at separation once released
    "separated": "int",  # non-zero: the payload separated within this step
    "landing_w": "vec3",
    "time_to_impact": "real",
    "clearance": "real",
    "separation_time": "real",  # valid once released
    "release_pos_w": "vec3",  # vehicle at separation
}


def array_struct(t: Types, name: str, fields: dict[str, str]) -> type:
    """Return a Warp struct of arrays; ``fields``: name -> type of :class:`Types`, with ``[]`` for
    arrays of two dimensions.
    """
    arrays = {}
    for field, kind in fields.items():
        dtype = wp.int32 if kind == "int" else getattr(t, kind.removesuffix("[]"))
        arrays[field] = wp.array(dtype=dtype, ndim=2 if kind.endswith("[]") else 1)
    return make_struct(name, arrays)


def allocate(struct: Any, count: int, device: str, rows: Mapping[str, int] = MappingProxyType({})):
    """Return an instance of ``struct`` with zeroed arrays of shape (E,) or (rows[name], E)."""
    out = struct()
    for name, field in struct.vars.items():
        shape = (rows[name], count) if field.type.ndim == 2 else count
        setattr(out, name, wp.zeros(shape, dtype=field.type.dtype, device=device))
    return out


def put(
    t: Types, struct, initial: Mapping[str, tuple[ndarray | None, ndarray]], count: int
) -> None:
    """Copy host arrays, with the environment first, into arrays of a struct, where rope arrays have
    the segment first.

    Raises ValueError: values have another shape.

    Args:
        t: types of the arrays.
        struct: of :func:`allocate`, or any object with arrays of these names.
        initial: name -> (values, default): values of shape (E, ...), None for the default in every
            environment; default of shape (...).
        count: E.
    """
    real = np.float32 if t.real is wp.float32 else np.float64
    for name, (value, default) in initial.items():
        value = (
            np.broadcast_to(default, (count, *np.shape(default)))
            if value is None
            else np.asarray(value, dtype=float)
        )
        if value.shape != (count, *np.shape(default)):
            raise ValueError(
                f"{name} of shape {value.shape}; expected {(count, *np.shape(default))}"
            )
        getattr(struct, name).assign(
            (np.swapaxes(value, 0, 1) if value.ndim == 3 else value).astype(real)
        )


def fetch(array: wp.array) -> ndarray:
    """Return a copy of a device array with the environment first."""
    value = array.numpy()  # on the CPU a view of the simulator's memory
    return np.array(np.swapaxes(value, 0, 1) if array.ndim == 2 else value)


SPEED_LIMIT = 1000.0  # limit of `size` [m/s], [rad/s]: a state above it is invalid


@wp.func
def size(s: Any):
    """Return a weighted sum of the norms of a vehicle's state; NaN if a part of it is NaN."""
    milli = type(s.voltage)(1.0e-3)
    total = (
        wp.length(s.vel_w) + wp.length(s.rate_b) + wp.length(s.quat_wb) + wp.length(s.pos_w) * milli
    )
    total += wp.abs(s.voltage) + wp.length(s.motor_speed) * milli
    return (
        total
        + wp.length(s.setpoint)
        + wp.length(s.gyro)
        + wp.length(s.integral)
        + wp.abs(s.charge_used)
    )


@wp.func
def vehicle_of(plants: Any, state: Any, env: int):
    """Return the parameters of an environment's vehicle, with its mass scaled."""
    p = plants.vehicles[env % plants.vehicles.shape[0]]
    p.body.mass = p.body.mass * state.mass_scale[env]
    return p


@wp.func
def rope_of(plants: Any, env: int):
    """Return the parameters of an environment's rope."""
    return plants.ropes[env % plants.ropes.shape[0]]


@wp.func
def release_of(plants: Any, env: int):
    """Return the parameters of an environment's release."""
    return plants.releases[env % plants.releases.shape[0]]


@wp.func
def air_of(plants: Any, state: Any, env: int):
    """Return the parameters of an environment's air, with the external wrench added."""
    air = plants.airs[env % plants.airs.shape[0]]
    air.push_w = air.push_w + state.force_w[env]
    air.twist_b = air.twist_b + state.torque_b[env]
    return air


def build_access(t: Types, State: type):
    """Return Warp functions ``load(state, env) -> t.QuadState`` and ``store(state, env, s)`` for a
    struct of arrays.
    """
    QuadState = t.QuadState

    @wp.func
    def load(state: State, env: int):
        s = QuadState()
        s.pos_w = state.pos_w[env]
        s.quat_wb = state.quat_wb[env]
        s.vel_w = state.vel_w[env]
        s.rate_b = state.rate_b[env]
        s.motor_speed = state.motor_speed[env]
        s.integral = state.integral[env]
        s.setpoint = state.setpoint[env]
        s.gyro = state.gyro[env]
        s.charge_used = state.charge_used[env]
        s.voltage = state.voltage[env]
        return s

    @wp.func
    def store(state: State, env: int, s: QuadState):
        state.pos_w[env] = s.pos_w
        state.quat_wb[env] = s.quat_wb
        state.vel_w[env] = s.vel_w
        state.rate_b[env] = s.rate_b
        state.motor_speed[env] = s.motor_speed
        state.integral[env] = s.integral
        state.setpoint[env] = s.setpoint
        state.gyro[env] = s.gyro
        state.charge_used[env] = s.charge_used
        state.voltage[env] = s.voltage

    return load, store


def build_rope_access(t: Types, segments: int):
    """Return Warp functions ``load_rope(state, env, n, u, stiffness)`` and ``store_rope``, which
    copy the arrays of :data:`ROPE_FIELDS` of a struct to local arrays and back.
    """
    Vectors = t.Vectors
    Reals = t.Reals

    @wp.func
    def load_rope(state: Any, env: int, n: Vectors, u: Vectors, stiffness: Reals):
        for i in range(segments):
            n[i] = state.cable_dir_w[i, env]
            u[i] = state.cable_vel_w[i, env]
            stiffness[i] = state.stiffness[i, env]

    @wp.func
    def store_rope(state: Any, env: int, n: Vectors, u: Vectors, stiffness: Reals):
        for i in range(segments):
            state.cable_dir_w[i, env] = n[i]
            state.cable_vel_w[i, env] = u[i]
            state.stiffness[i, env] = stiffness[i]

    return load_rope, store_rope

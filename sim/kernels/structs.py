"""Warp structs of the parameters and of the vehicle's state, for one floating-point precision.

Parameters are declared only in the dataclasses of :mod:`sim.params`. :class:`Types` derives a Warp
struct from the annotations of each, so a field added there is available in kernels under the same
name."""

import dataclasses
import typing
from collections.abc import Iterable, Sequence
from functools import lru_cache

import numpy as np
import warp as wp
from numpy import ndarray

from sim import params as P


def make_struct(name: str, fields: dict[str, type]) -> type:
    return wp.struct(type(name, (), {"__annotations__": fields, "__module__": __name__}))


ROPE_NUMBERS = (
    "segment_length",
    "segment_mass",
    "segment_inertia",
    "last_mass",
    "last_center",
    "last_inertia",
    "payload_offset",
    "payload_radius",
    "payload_arm",
    "payload_mass",
    "payload_drag",
    "joint_damping",
    "mount_damping",
    "swing_damping",
    "downwash",
    "payload_side",
    "payload_lift",
    "compliance",
    "strain",  # current strain of an elastic rope
    "strain_rate",  # [1/s]
    "stretched_share",  # displacement of the last rod's centre of mass per elongation of the rod
    "total_mass",
)
"""Scalars of the struct of a rope, in addition to the vector ``mount``."""


NUMERICS = ("control_period", "substep", "gamma", "max_turn")
"""Numbers of :class:`sim.params.SimParams` that kernels read."""

QUAD_STATE = {
    "pos_w": "vec3",
    "quat_wb": "quat",
    "vel_w": "vec3",
    "rate_b": "vec3",
    "motor_speed": "vec4",
    "integral": "vec3",
    "setpoint": "vec3",
    "gyro": "vec3",
    "charge_used": "real",
    "voltage": "real",
}
"""State of a quadrotor: name -> type."""
QUAD_RATE = QUAD_STATE | {"acting": "vec4", "force_b": "vec3", "torque_b": "vec3"}
"""Time derivative of the state, with the acting motor speeds and the wrench of the blocks."""


class Types:
    """Scalar, vector and struct types of one precision.

    Attributes:
        real, vec3, vec4, quat: Warp types.
        Vehicle: struct of :class:`sim.params.VehicleParams`, with the mixer's columns added under
            ``mixer``.
        Rope: struct of :class:`sim.params.RopeParams` per segment (``segment_length``,
            ``segment_mass``, ...).
        Air: struct of :class:`sim.params.AirParams` with the coefficients of the plant's ``laws``
            and external forces during a step: ``push_w`` [N] on the vehicle, ``twist_b`` [N m]
            about its centre of mass, ``payload_push_w`` [N]. For laws of a replay also the measured
            ``neighbour_pos_w`` [m], and ``thrust_rate`` [N/s] if attitudes are imposed.
        Plants: parameters of a batch: arrays of ``vehicles``, ``ropes``, ``releases`` and ``airs``,
            with one entry per environment or one for all, and the numerics. rows: types of these
            arrays.
        Vectors, Reals: arrays of ``vec3`` and ``real``, for annotations.
        QuadState, QuadRate: state of the quadrotor alone, and :data:`QUAD_RATE`.
    """

    def __init__(self, real: type):
        self.real = real
        self.vec3 = wp.types.vector(3, real)
        self.vec4 = wp.types.vector(4, real)
        self.quat = wp.types.quaternion(real)
        self.Mixer = make_struct("Mixer", {"roll": self.vec4, "pitch": self.vec4, "yaw": self.vec4})
        self.Vehicle = self.from_dataclass(P.VehicleParams, {"mixer": self.Mixer})
        self.Release = self.from_dataclass(P.ReleaseParams, {})
        self.Randomization = self.from_dataclass(P.RandomizationParams, {})
        pushes = {
            "laws": self.vec4,
            "push_w": self.vec3,
            "twist_b": self.vec3,
            "payload_push_w": self.vec3,
            "neighbour_pos_w": self.vec3,
            "thrust_rate": real,
        }
        self.Air = self.from_dataclass(P.AirParams, pushes)
        self.Rope = make_struct("Rope", {"mount": self.vec3, **dict.fromkeys(ROPE_NUMBERS, real)})
        self.rows = {
            "vehicles": self.Vehicle,
            "ropes": self.Rope,
            "releases": self.Release,
            "airs": self.Air,
        }
        arrays = {name: wp.array(dtype=row) for name, row in self.rows.items()}
        self.Plants = make_struct(
            "Plants",
            arrays | dict.fromkeys((*NUMERICS, "gravity"), real) | {"gravity_w": self.vec3},
        )
        self.Vectors = wp.array(dtype=self.vec3)
        self.Reals = wp.array(dtype=real)
        self.QuadState = self.from_names("QuadState", QUAD_STATE)
        self.QuadRate = self.from_names("QuadRate", QUAD_RATE)

    def from_names(self, name: str, fields: dict[str, str]) -> type:
        """Return a struct; ``fields``: name -> name of an attribute of this class, the type."""
        return make_struct(name, {field: getattr(self, kind) for field, kind in fields.items()})

    def _field_type(self, annotation) -> type | None:
        if annotation is float:
            return self.real
        if annotation is int:
            return wp.int32
        if typing.get_origin(annotation) is tuple:
            return {3: self.vec3, 4: self.vec4}[len(typing.get_args(annotation))]
        if dataclasses.is_dataclass(annotation):
            return self.from_dataclass(annotation, {})
        return None  # kinds of blocks are chosen when the kernel is built

    def from_dataclass(self, schema: type, extra: dict[str, type]) -> type:
        hints = typing.get_type_hints(schema)
        fields = {f.name: self._field_type(hints[f.name]) for f in dataclasses.fields(schema)}
        return make_struct(
            schema.__name__, {k: v for k, v in fields.items() if v is not None} | extra
        )


@lru_cache
def types(precision: str) -> Types:
    """Return the types of ``"float32"`` or ``"float64"``, cached, so that all kernels of a
    precision share their structs.

    Raises ValueError: another precision."""
    if precision not in ("float32", "float64"):
        raise ValueError(f"precision {precision!r}; expected 'float32' or 'float64'")
    return Types(wp.float32 if precision == "float32" else wp.float64)


@lru_cache
def _numpy_type(struct: type) -> np.dtype:
    """Return the NumPy type of a struct's rows, cached, as Warp derives it anew at each call."""
    return struct.numpy_dtype()


def _fill(row: np.void, value) -> None:
    for f in dataclasses.fields(value):
        if f.name not in row.dtype.names:
            continue
        item = getattr(value, f.name)
        if dataclasses.is_dataclass(item):
            _fill(row[f.name], item)
        else:
            row[f.name] = item


def kinds_of(vehicle: P.VehicleParams) -> tuple[str, str, str, str]:
    """Return the kinds of controller, motor, battery and aerodynamics, for which a kernel is
    built.
    """
    return vehicle.controller.kind, vehicle.motor.kind, vehicle.battery.kind, vehicle.aero.kind


EXTENSIONS = {
    "ground_effect": "ground_effect",  # thrust near the ground
    "payload_drag": "payload_drag",  # air drag of the payload
    "mount_damping": "mount_damping",  # friction of the rope's mount
    "swing_damping": "swing_damping",  # friction across the rope
    "downwash": "downwash",  # the rotors' jet on the payload
    "payload_spin": "payload_side payload_lift",  # side force and lift of a payload in flight
    "compliance": "compliance",  # elastic rope
    "lag_tension": "lag_tension",  # release lag that depends on the rope's tension
    "rope_tail": "rope_tail",  # rope that leaves with the payload
    "push": "",  # external forces
}
"""Optional part of the blocks -> fields of rope, air or release that need it if they are not zero.

A kernel holds only the parts for which it was built. The parts of the release are in every kernel,
as they cost nothing."""


def extensions_of(
    ropes: Iterable[P.RopeParams],
    airs: Iterable[P.AirParams] = (),
    releases: Iterable[P.ReleaseParams] = (),
    laws: Sequence[P.LawParams] = (),
) -> frozenset[str]:
    """Return the names of :data:`EXTENSIONS` that these plants need."""
    needed = {"push"} if laws else set()
    for part in (*ropes, *airs, *releases):
        for name, fields in EXTENSIONS.items():
            values = [getattr(part, field, 0.0) for field in fields.split()]
            if any(value not in (0.0, (0.0, 0.0, 0.0)) for value in values):
                needed.add(name)
    return frozenset(needed)


def pack_vehicle(
    t: Types, vehicles: list[P.VehicleParams], kinds: tuple[str, str, str, str]
) -> ndarray:
    """Return a structured array of shape (1,) or (E,) for ``wp.array(dtype=t.Vehicle)``, for a
    kernel of blocks of these kinds.

    Raises ValueError: a vehicle has other kinds of blocks, or rotors without drag torque, with
    which a mixer cannot control yaw."""
    rows = pack(t.Vehicle, *vehicles)
    for row, vehicle in zip(rows, vehicles, strict=True):
        if kinds_of(vehicle) != kinds:
            raise ValueError(
                f"vehicle of the kinds {kinds_of(vehicle)} in a batch of {kinds}; expected the same"
                " blocks"
            )
        rotors = vehicle.rotors
        thrust = vehicle.thrust
        if not thrust.torque_ratio:  # the mixer divides by it
            raise ValueError("vehicle.thrust.torque_ratio is 0.0; expected above 0")
        # Thrust of each rotor [N] that makes 1 N m about x, y and z without changing the sum; each
        # of shape (4,).
        x = np.asarray(rotors.x)
        y = np.asarray(rotors.y)
        spin = np.asarray(rotors.spin)
        row["mixer"]["roll"] = y / (4 * np.mean(y**2))
        row["mixer"]["pitch"] = -x / (4 * np.mean(x**2))
        row["mixer"]["yaw"] = spin / (4 * thrust.torque_ratio)
        # Arms about the centre of mass, and the true drag torque: the controller's mixer uses the
        # nominal one.
        for name, com in zip("xyz", vehicle.body.com, strict=True):
            row["rotors"][name] = np.asarray(getattr(rotors, name)) - com
        row["thrust"]["torque_ratio"] = thrust.torque_ratio * thrust.torque_gain
    return rows


def pack(struct: type, *values) -> ndarray:
    """Return a structured array for ``wp.array(dtype=struct)``, with a row for each of the
    dataclass instances ``values``.
    """
    rows = np.zeros(len(values), dtype=_numpy_type(struct))
    for row, value in zip(rows, values, strict=True):
        _fill(row, value)
    return rows


def pack_air(t: Types, airs: list[P.AirParams], laws: list[tuple[P.LawParams, ...]]) -> ndarray:
    """Return a structured array for ``wp.array(dtype=t.Air)``, with a row for each air and the
    coefficients of its plant's laws.
    """
    rows = pack(t.Air, *airs)
    for row, row_laws in zip(rows, laws, strict=True):
        row["laws"][: len(row_laws)] = [law.coefficient for law in row_laws]
    return rows


def ropes_on(vehicles: list[P.VehicleParams], ropes: list[P.RopeParams]) -> list[P.RopeParams]:
    """Return the ropes with their mounts relative to their vehicles' centres of mass.

    Raises ValueError: centres of mass differ, but there is not one rope, or one for each vehicle.
    """
    coms = [v.body.com for v in vehicles]
    if len(set(coms)) > 1:
        if len(ropes) not in (1, len(vehicles)):
            raise ValueError(
                f"{len(ropes)} ropes on {len(vehicles)} vehicles of different centres of mass;"
                " expected one rope, or one each"
            )
        ropes = ropes * len(vehicles) if len(ropes) == 1 else ropes
    else:
        coms = coms[:1] * len(ropes)
    return [
        dataclasses.replace(rope, mount=tuple(m - c for m, c in zip(rope.mount, com)))
        for rope, com in zip(ropes, coms, strict=True)
    ]


def pack_rope(t: Types, ropes: list[P.RopeParams]) -> ndarray:
    """Return a structured array of shape (1,) or (E,) for ``wp.array(dtype=t.Rope)``.

    Mass, centre and transverse inertia (about the upper joint) of the last rod include the payload.
    """
    rows = pack(t.Rope, *ropes)
    for row, rope in zip(rows, ropes, strict=True):
        length = rope.segment_length
        mass = rope.segment_mass
        ball = length + rope.payload_offset
        last_mass = mass + rope.payload_mass
        row["segment_length"] = length
        row["segment_mass"] = mass
        row["segment_inertia"] = mass * length**2 / 3
        row["last_mass"] = last_mass
        row["last_center"] = (mass * length / 2 + rope.payload_mass * ball) / last_mass
        row["last_inertia"] = (
            mass * length**2 / 3 + rope.payload_inertia + rope.payload_mass * ball**2
        )
        row["payload_arm"] = ball
        row["stretched_share"] = (mass / 2 + rope.payload_mass) / last_mass
        row["total_mass"] = rope.hanging_mass
    return rows


def pack_plants(
    t: Types,
    like: P.PlantParams,
    vehicles: list[P.VehicleParams],
    ropes: list[P.RopeParams],
    airs: list[P.AirParams],
    releases: list[P.ReleaseParams],
    laws: list[tuple[P.LawParams, ...]] | None = None,
) -> dict[str, ndarray]:
    """Return structured arrays for :func:`plants_on`, for a kernel of the blocks of ``like``.

    ``laws``: of the plant of each of ``airs``; by default those of ``like``."""
    return {
        "vehicles": pack_vehicle(t, vehicles, kinds_of(like.vehicle)),
        "ropes": pack_rope(t, ropes),
        "airs": pack_air(t, airs, laws or [like.laws] * len(airs)),
        "releases": pack(t.Release, *releases),
    }


def plants_on(
    t: Types, rows: dict[str, ndarray], sim: P.SimParams, gravity: float, device: str
) -> typing.Any:
    """Return a struct ``t.Plants`` on a device; ``rows``: of :func:`pack_plants`; ``gravity``:
    [m/s^2].
    """
    plants = t.Plants()
    for name, packed in rows.items():
        setattr(plants, name, wp.array(packed, dtype=t.rows[name], device=device))
    for name in NUMERICS:
        setattr(plants, name, getattr(sim, name))
    plants.gravity = gravity
    plants.gravity_w = t.vec3(0.0, 0.0, -gravity)
    return plants

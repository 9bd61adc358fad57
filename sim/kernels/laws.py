"""Force laws of a diagnosis as blocks of the fused kernel: a coefficient times up to two scalars
times a vector.

A law is plain data (:class:`sim.params.LawParams`). :func:`build_laws` composes the functions of
its factors into a kernel. The coefficient is a run-time parameter, so one kernel serves all sizes
of a law. The factors are those of ``sim/law_factors.toml``, composed of the quantities of
``sim/law_factors.py``; ``visthrow.diagnose.models.law_terms`` computes them in NumPy. A law's force
is evaluated at the start of an integration step and held during the step.

A torque M in the rope's joint acts on the vehicle, and -M on the rope. The latter is replaced by
the equivalent pair of forces on a straight rope of length l and direction n: (-M x n) / l on the
payload, and the opposite force at the mount. So momentum is conserved."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from sim.kernels.quadrotor.rigid_body import mount_position, mount_velocity
from sim.kernels.quadrotor.thrust import rotor_thrust_scaled
from sim.kernels.structs import Types
from sim.law_factors import LAW_FACTORS, UNITS, definition
from sim.params import LOWEST, SLOWEST, LawParams

MOST_LAWS = 4

AROUND = {
    "pos_w": "vec3",
    "vel_w": "vec3",
    "rate_b": "vec3",
    "quat_wb": "quat",
    "payload_pos_w": "vec3",
    "payload_vel_w": "vec3",
    "cable_dir_w": "vec3",
    "mount_b": "vec3",
    "thrust": "real",
    "thrust_rate": "real",
    "tension": "real",
    "neighbour_pos_w": "vec3",
}
"""Quantities of which factors are composed: name -> type."""


@wp.func
def pos(a: Any):
    return a.pos_w


@wp.func
def vel(a: Any):
    return a.vel_w


@wp.func
def rate(a: Any):
    return a.rate_b


@wp.func
def attitude(a: Any):
    return a.quat_wb


@wp.func
def payload_pos(a: Any):
    return a.payload_pos_w


@wp.func
def payload_vel(a: Any):
    return a.payload_vel_w


@wp.func
def cable(a: Any):
    return a.cable_dir_w


@wp.func
def mount(a: Any):
    return a.mount_b


@wp.func
def thrust(a: Any):
    return a.thrust


@wp.func
def thrust_rate(a: Any):
    return a.thrust_rate


@wp.func
def tension(a: Any):
    return a.tension


@wp.func
def neighbour(a: Any):
    return a.neighbour_pos_w


STATES = {
    "pos_w": pos,
    "vel_w": vel,
    "rate_b": rate,
    "quat_wb": attitude,
    "payload_pos_w": payload_pos,
    "payload_vel_w": payload_vel,
    "cable_dir_w": cable,
    "mount_b": mount,
    "thrust": thrust,
    "slope": thrust_rate,
    "tension": tension,
    "neighbour_pos_w": neighbour,
}
"""Name of a quantity -> the function that reads it."""


@wp.func
def normal_part(vector: Any, axis: Any):
    return vector - wp.dot(vector, axis) * axis


@wp.func
def inverse(value: Any):
    return type(value)(1.0) / wp.max(value, type(value)(LOWEST))


@wp.func
def saturated(vector: Any):
    square = wp.dot(vector, vector)
    return vector / wp.sqrt(square + type(square)(SLOWEST * SLOWEST))


@wp.func
def scaled(factor: Any, vector: Any):
    return factor * vector


@wp.func
def turn_rate(arm: Any, arm_vel: Any):
    return wp.cross(arm, arm_vel) / wp.dot(arm, arm)


OPERATIONS = {
    "to_world": wp.quat_rotate,
    "to_body": wp.quat_rotate_inv,
    "cross": wp.cross,
    "inner": wp.dot,
    "size": wp.length,
    "absolute": wp.abs,
    "sum": wp.add,
    "difference": wp.sub,
    "normal_part": normal_part,
    "scaled": scaled,
    "inverse": inverse,
    "saturated": saturated,
    "turn_rate": turn_rate,
}
"""Operations of :data:`sim.law_factors.QUANTITIES`."""


def _unit(x: float, y: float, z: float):
    @wp.func
    def unit(a: Any):
        return type(a.vel_w)(type(a.thrust)(x), type(a.thrust)(y), type(a.thrust)(z))

    return unit


def _compose_one(operation, first):
    @wp.func
    def single(a: Any):
        return operation(first(a))

    return single


def _compose_two(operation, first, second):
    @wp.func
    def pair(a: Any):
        return operation(first(a), second(a))

    return pair


@cache
def quantity(name: str):
    """Return the function that evaluates a quantity, read from the state or derived from it."""
    if name in STATES:
        return STATES[name]
    if name in UNITS:
        return _unit(*UNITS[name])
    operation, *names = definition(name)
    compose = _compose_one if len(names) == 1 else _compose_two
    return compose(OPERATIONS[operation], *map(quantity, names))


def _functions(rows):
    return {name: quantity(row[2]) for name, row in rows.items()}


MEASURED = LAW_FACTORS["measured"]  # factors of quantities that only a log has

SCALARS = _functions(LAW_FACTORS["scalars"] | MEASURED["scalars"])
"""Scalar factors: name -> function."""

VECTORS = {
    block: _functions(rows | MEASURED["vectors"].get(block, {}))
    for block, rows in LAW_FACTORS["vectors"].items()
}
"""Block -> vectors of its laws, name -> function; forces in the world frame, torques in the body
frame.
"""

BLOCKS = tuple(VECTORS)


def structure(laws: tuple[LawParams, ...]) -> tuple:
    """Return the constants for which a kernel is built: the laws without their coefficients."""
    return tuple((law.block, law.factors, law.vector) for law in laws)


def check_laws(laws: tuple[LawParams, ...], measured: bool = False) -> None:
    """Raise ValueError if there are too many laws, or one needs a quantity that is not available.

    ``measured``: whether quantities that only a log has are available.
    """
    if len(laws) > MOST_LAWS:
        raise ValueError(f"{len(laws)} laws; expected at most {MOST_LAWS}")
    if measured:
        return
    for law in laws:
        scalars = LAW_FACTORS["scalars"]
        vectors = LAW_FACTORS["vectors"][law.block]
        if law.vector not in vectors or not set(law.factors) <= set(scalars):
            raise ValueError(
                f"law on {law.block}, {' '.join((*law.factors, law.vector))}: it takes a measured"
                f" neighbour, which no simulation has; expected factors of {', '.join(scalars)} and"
                f" a vector of {', '.join(vectors)}"
            )


def build_laws(t: Types, laws: tuple[LawParams, ...], flow, chain) -> SimpleNamespace:
    """Compose the laws of a plant.

    Returns a namespace of Warp functions: ``on(p, rope, air, state, n, u, stiffness, command,
    attached)`` returns the air with the laws' forces added to its pushes; ``in_flight(air, vel_w)``
    returns the force [N] on a released payload. Without laws, there are no such forces."""
    vec3 = t.vec3
    Vectors = t.Vectors
    vec4 = t.vec4
    real = t.real
    Air = t.Air
    Around = t.from_names("Around", AROUND)

    @wp.func
    def one(a: Around):
        return real(1.0)

    @wp.func
    def zero(a: Around, c: vec4):
        return vec3()

    def plus(before, law: LawParams, i: int):
        first, second = (*[SCALARS[name] for name in law.factors], one, one)[:2]
        vector = VECTORS[law.block][law.vector]

        @wp.func
        def term(a: Around, c: vec4):
            return before(a, c) + (c[i] * first(a) * second(a)) * vector(a)

        return term

    total = dict.fromkeys(BLOCKS, zero)
    for i, law in enumerate(laws):
        total[law.block] = plus(total[law.block], law, i)
    force, torque, payload_force, joint = (total[block] for block in BLOCKS)
    reach = quantity("reach_w")
    in_joint = any(law.block == "rope joint" for law in laws)

    @wp.func
    def act_in_joint(a: Around, air: Air):
        """Return the air with the torque in the rope's joint and its reactions added."""
        out = air
        on_vehicle = joint(a, air.laws)
        arm = reach(a)
        pair = -wp.cross(wp.quat_rotate(a.quat_wb, on_vehicle), arm) / wp.dot(arm, arm)
        out.payload_push_w = air.payload_push_w + pair
        out.push_w = air.push_w - pair
        out.twist_b = (
            air.twist_b + on_vehicle - wp.cross(a.mount_b, wp.quat_rotate_inv(a.quat_wb, pair))
        )
        return out

    @wp.func
    def on(
        p: t.Vehicle,
        rope: t.Rope,
        air: Air,
        s: t.QuadState,
        n: Vectors,
        u: Vectors,
        stiffness: t.Reals,
        command: vec4,
        attached: int,
    ):
        out = air
        if wp.static(len(laws) > 0):
            a = Around()
            a.pos_w = s.pos_w
            a.vel_w = s.vel_w
            a.rate_b = s.rate_b
            a.quat_wb = s.quat_wb
            a.neighbour_pos_w = air.neighbour_pos_w
            a.thrust_rate = air.thrust_rate
            f = flow(p, air, s, command)
            f0 = rotor_thrust_scaled(p, f.acting, s.voltage)
            f1 = rotor_thrust_scaled(p, f.acting + real(1.0e-3) * f.motor_speed, s.voltage)
            for i in range(4):
                a.thrust = a.thrust + f0[i]
                a.thrust_rate = a.thrust_rate + real(1.0e3) * (f1[i] - f0[i])
            if attached != 0:
                pos, vel = chain.payload(rope, vec3(), mount_velocity(rope, s), n, u)
                a.payload_pos_w = mount_position(rope, s) + pos
                a.payload_vel_w = vel
                a.cable_dir_w = wp.normalize(pos)
                a.mount_b = rope.mount
                a.tension = chain.pull(rope, stiffness, u)
            out.push_w = air.push_w + force(a, air.laws)
            out.twist_b = air.twist_b + torque(a, air.laws)
            if attached != 0:
                out.payload_push_w = air.payload_push_w + payload_force(a, air.laws)
                if wp.static(in_joint):
                    out = act_in_joint(a, out)
        return out

    @wp.func
    def in_flight(air: Air, vel_w: vec3):
        a = Around()
        a.payload_vel_w = vel_w
        return payload_force(a, air.laws)

    return SimpleNamespace(on=on, in_flight=in_flight)

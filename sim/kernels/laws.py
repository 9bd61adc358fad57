"""Laws that a diagnosis found, as blocks of the fused kernel: coefficient times up to two scalars
times one vector.

A law is plain data (:class:`sim.params.LawParams`). :func:`build_laws` composes the functions of
its factors into the kernel that is built for it; its coefficient is a number of the run, so that
one kernel serves every size of a law. The names are those of
``visthrow.diagnose.models.law_terms``. A law's force is taken at the start of an integration step
and held over it.

A torque M in the rope's joint acts on the vehicle, and -M on the rope: by the pair of forces that
does the same to a straight rope of the length l in direction n, (-M x n) / l on the payload and its
opposite at the mount. Momentum is conserved."""

from types import SimpleNamespace

import warp as wp

from sim.kernels.quadrotor.thrust import rotor_thrust_scaled
from sim.kernels.structs import Types, make_struct, types
from sim.params import LOWEST, SLOWEST, LawParams

MOST_LAWS = 4
BLOCKS = ("vehicle force", "vehicle torque", "payload force", "rope joint")


def _factors(t: Types, Around: type) -> tuple[dict, dict]:
    """Warp functions of the scalars, and of the vectors by block; forces in the world frame,
    torques in the body's.
    """
    vec3 = t.vec3
    real = t.real

    def axis(x: float, y: float, z: float):
        @wp.func
        def unit(a: Around):
            return vec3(real(x), real(y), real(z))

        return unit

    def turned(vector):
        @wp.func
        def world(a: Around):
            return wp.quat_rotate(a.quat_wb, vector(a))

        return world

    def turned_back(vector):
        @wp.func
        def body(a: Around):
            return wp.quat_rotate_inv(a.quat_wb, vector(a))

        return body

    def crossed(first, second):
        @wp.func
        def cross(a: Around):
            return wp.cross(first(a), second(a))

        return cross

    def size(vector):
        @wp.func
        def length(a: Around):
            return wp.length(vector(a))

        return length

    @wp.func
    def vel(a: Around):
        return a.vel_w

    @wp.func
    def rate(a: Around):
        return a.rate_b

    @wp.func
    def cable(a: Around):
        return a.cable_dir_w

    @wp.func
    def payload_vel(a: Around):
        return a.payload_vel_w

    @wp.func
    def thrust(a: Around):
        return a.thrust

    @wp.func
    def thrust_rate(a: Around):
        return a.thrust_rate

    @wp.func
    def tension(a: Around):
        return a.tension

    body_x = axis(1.0, 0.0, 0.0)
    body_y = axis(0.0, 1.0, 0.0)
    vertical = axis(0.0, 0.0, 1.0)
    up = turned(vertical)

    @wp.func
    def along(a: Around):
        return wp.dot(a.vel_w, up(a))

    @wp.func
    def across(a: Around):
        return a.vel_w - along(a) * up(a)

    @wp.func
    def swing(a: Around):
        relative = a.payload_vel_w - a.vel_w
        return relative - wp.dot(relative, a.cable_dir_w) * a.cable_dir_w

    @wp.func
    def under(a: Around):
        return -wp.dot(a.cable_dir_w, up(a))

    @wp.func
    def aside(a: Around):
        return a.cable_dir_w + under(a) * up(a)

    @wp.func
    def abs_thrust_rate(a: Around):
        return wp.abs(a.thrust_rate)

    @wp.func
    def speed_across_squared(a: Around):
        return wp.dot(across(a), across(a))

    @wp.func
    def rate_yaw(a: Around):
        return a.rate_b[2]

    @wp.func
    def inverse_height(a: Around):
        return real(1.0) / wp.max(a.pos_w[2], real(LOWEST))

    @wp.func
    def joint_rate(a: Around):
        reach = a.payload_pos_w - a.pos_w - wp.quat_rotate(a.quat_wb, a.mount_b)
        mount_vel = a.vel_w + wp.quat_rotate(a.quat_wb, wp.cross(a.rate_b, a.mount_b))
        rope_rate = wp.cross(reach, a.payload_vel_w - mount_vel) / wp.dot(reach, reach)
        return wp.quat_rotate_inv(a.quat_wb, rope_rate) - a.rate_b

    @wp.func
    def friction(a: Around):
        return joint_rate(a) / wp.sqrt(
            wp.dot(joint_rate(a), joint_rate(a)) + real(SLOWEST * SLOWEST)
        )

    vel_body = turned_back(vel)
    cable_body = turned_back(cable)
    swing_body = turned_back(swing)
    scalars = {
        "thrust": thrust,
        "thrust_rate": thrust_rate,
        "abs_thrust_rate": abs_thrust_rate,
        "speed": size(vel),
        "speed_across": size(across),
        "speed_across_squared": speed_across_squared,
        "speed_along": along,
        "rate": size(rate),
        "rate_yaw": rate_yaw,
        "inverse_height": inverse_height,
        "tension": tension,
        "payload_speed": size(payload_vel),
        "swing_speed": size(swing),
        "cable_under_rotors": under,
        "joint_rate": size(joint_rate),
    }
    vectors = {
        "vehicle force": {
            "body_z": up,
            "body_x": turned(body_x),
            "body_y": turned(body_y),
            "world_z": vertical,
            "vel": vel,
            "vel_across": across,
            "axis_cross_vel": crossed(up, vel),
            "rate_cross_vel": crossed(turned(rate), vel),
            "cable": cable,
            "swing_vel": swing,
        },
        "vehicle torque": {
            "body_x": body_x,
            "body_y": body_y,
            "body_z": vertical,
            "rate": rate,
            "axis_cross_rate": crossed(vertical, rate),
            "vel": vel_body,
            "axis_cross_vel": crossed(vertical, vel_body),
            "axis_cross_cable": crossed(vertical, cable_body),
            "axis_cross_swing": crossed(vertical, swing_body),
        },
        "payload force": {
            "payload_vel": payload_vel,
            "vertical_cross_vel": crossed(vertical, payload_vel),
            "world_z": vertical,
            "body_z": up,
            "cable": cable,
            "swing_vel": swing,
            "cable_cross_swing": crossed(cable, swing),
            "vel": vel,
            "sideways": aside,
        },
        "rope joint": {
            "joint_rate": joint_rate,
            "friction": friction,
            "axis_cross_cable": crossed(vertical, cable_body),
        },
    }
    return scalars, vectors


def names() -> tuple[tuple[str, ...], dict[str, tuple[str, ...]]]:
    """Scalars, and vectors by block, that a law may name."""
    t = types("float64")
    scalars, vectors = _factors(t, make_struct("Around", _around(t)))
    return tuple(scalars), {block: tuple(wanted_laws) for block, wanted_laws in vectors.items()}


def _around(t: Types) -> dict[str, type]:
    return {
        "pos_w": t.vec3,
        "vel_w": t.vec3,
        "rate_b": t.vec3,
        "quat_wb": t.quat,
        "payload_pos_w": t.vec3,
        "payload_vel_w": t.vec3,
        "cable_dir_w": t.vec3,
        "mount_b": t.vec3,
        "thrust": t.real,
        "thrust_rate": t.real,
        "tension": t.real,
    }


def structure(laws: tuple[LawParams, ...]) -> tuple:
    """The constants a kernel is built for: everything of the laws but their coefficients."""
    return tuple((law.block, law.factors, law.vector) for law in laws)


def check_laws(laws: tuple[LawParams, ...]) -> None:
    """Raise ValueError for a law that no block can be made of."""
    scalars, vectors = names() if laws else ((), {})
    if len(laws) > MOST_LAWS:
        raise ValueError(f"{len(laws)} laws; expected at most {MOST_LAWS}")
    for law in laws:
        unknown = [name for name in law.factors if name not in scalars]
        if (
            law.block not in BLOCKS
            or unknown
            or law.vector not in vectors[law.block]
            or len(law.factors) > 2
        ):
            raise ValueError(
                f"law {law}; expected a block of {BLOCKS}, up to two factors of {scalars}, and a"
                f" vector of {vectors.get(law.block, BLOCKS)}"
            )


def build_laws(
    t: Types, laws: tuple[LawParams, ...], flow, chain, mount_velocity
) -> SimpleNamespace:
    """Compose the laws of a plant.

    Returns a namespace of Warp functions ``on(p, rope, air, state, n, u, stiffness, command,
    attached)`` -> air whose pushes hold the laws' forces besides its own, and ``in_flight(air,
    vel_w)`` [N] on a payload that has left. Without laws both do nothing."""
    vec3 = t.vec3
    Vectors = t.Vectors
    Reals = t.Reals
    vec4 = t.vec4
    real = t.real
    Vehicle = t.Vehicle
    Rope = t.Rope
    Air = t.Air
    QuadState = t.QuadState
    if not laws:  # their factors take a seventh of the time in which a kernel is composed

        @wp.func
        def nothing(
            p: Vehicle,
            rope: Rope,
            air: Air,
            s: QuadState,
            n: Vectors,
            u: Vectors,
            stiffness: Reals,
            command: vec4,
            attached: int,
        ):
            return air

        @wp.func
        def no_force(air: Air, vel_w: vec3):
            return vec3()

        return SimpleNamespace(on=nothing, in_flight=no_force)
    Around = make_struct("Around", _around(t))
    scalars, vectors = _factors(t, Around)

    @wp.func
    def one(a: Around):
        return real(1.0)

    @wp.func
    def zero(a: Around, c: vec4):
        return vec3()

    def plus(before, law: LawParams, i: int):
        first, second = (*[scalars[name] for name in law.factors], one, one)[:2]
        vector = vectors[law.block][law.vector]

        @wp.func
        def term(a: Around, c: vec4):
            return before(a, c) + (c[i] * first(a) * second(a)) * vector(a)

        return term

    total = dict.fromkeys(BLOCKS, zero)
    for i, law in enumerate(laws):
        total[law.block] = plus(total[law.block], law, i)
    force, torque, payload_force, joint = (total[block] for block in BLOCKS)
    in_joint = any(law.block == "rope joint" for law in laws)

    @wp.func
    def act_in_joint(a: Around, air: Air):
        """The air whose pushes hold the torque in the rope's joint and its reactions besides."""
        out = air
        on_vehicle = joint(a, air.laws)
        reach = a.payload_pos_w - a.pos_w - wp.quat_rotate(a.quat_wb, a.mount_b)
        pair = -wp.cross(wp.quat_rotate(a.quat_wb, on_vehicle), reach) / wp.dot(reach, reach)
        out.payload_push_w = air.payload_push_w + pair
        out.push_w = air.push_w - pair
        out.twist_b = (
            air.twist_b + on_vehicle - wp.cross(a.mount_b, wp.quat_rotate_inv(a.quat_wb, pair))
        )
        return out

    @wp.func
    def on(
        p: Vehicle,
        rope: Rope,
        air: Air,
        s: QuadState,
        n: Vectors,
        u: Vectors,
        stiffness: Reals,
        command: vec4,
        attached: int,
    ):
        a = Around()
        a.pos_w = s.pos_w
        a.vel_w = s.vel_w
        a.rate_b = s.rate_b
        a.quat_wb = s.quat_wb
        f = flow(p, air, s, command)
        f0 = rotor_thrust_scaled(p, f.motor_speed, s.voltage)
        f1 = rotor_thrust_scaled(p, f.motor_speed + real(1.0e-3) * f.motor_rate, s.voltage)
        for i in range(4):
            a.thrust = a.thrust + f0[i]
            a.thrust_rate = a.thrust_rate + real(1.0e3) * (f1[i] - f0[i])
        if attached != 0:
            pos, vel = chain.payload(rope, vec3(), mount_velocity(rope, s), n, u)
            a.payload_pos_w = s.pos_w + wp.quat_rotate(s.quat_wb, rope.mount) + pos
            a.payload_vel_w = vel
            a.cable_dir_w = wp.normalize(pos)
            a.mount_b = rope.mount
            a.tension = chain.pull(rope, stiffness, u)
        out = air
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

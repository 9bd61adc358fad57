"""World P3: the payload on one rigid rod, in the direction of the rod as coordinate."""

import warp as wp

from bench.worlds.vehicle import (
    EARTH,
    REAL,
    V3,
    Body,
    Numbers,
    ball_force,
    free_motion,
    rotation,
    vehicle_load,
)


def build():
    """Warp functions of the plant: ``rates``, and positions of the ball."""
    nodes = 1

    @wp.func
    def rates(
        p: Numbers,
        b: Body,
        command: wp.vec4d,
        push: V3,
        twist: V3,
        ball_push: V3,
        tension: REAL,
        place: wp.array(dtype=V3),
        speed: wp.array(dtype=V3),
        change: wp.array(dtype=V3),
    ):
        """Derivative of the body; ``place`` is the rod's direction, ``speed`` its derivative,
        ``change`` the second one.
        """
        force, torque, thrust, d = vehicle_load(p, b, command, push, twist)
        rot = rotation(b.q)
        n = place[0]
        u = speed[0]
        arm_b = p.mount - p.com
        arm = rot * arm_b
        reach = p.length + p.ball_reach
        total = p.rope_mass + p.ball_mass
        first = REAL(0.5) * p.rope_mass * p.length + p.ball_mass * reach
        second = (
            p.rope_mass * p.length * p.length / REAL(3.0)
            + p.ball_inertia
            + p.ball_mass * reach * reach
        )
        gravity = V3(REAL(0.0), REAL(0.0), -REAL(EARTH))
        eye = wp.identity(n=3, dtype=REAL)
        flat = eye - wp.outer(n, n)
        w_world = rot * b.w
        rate = wp.cross(n, u)
        swing = rate - w_world
        couple = -p.joint_damping * swing - p.joint_damping_square * wp.length(swing) * swing
        mount_v = b.v + wp.cross(w_world, arm)
        ball_v = mount_v + reach * u
        air = ball_force(p, ball_v, rot, thrust, 1) + ball_push - p.rope_drag * (flat * ball_v)
        d = free_motion(p, b, force, torque - wp.transpose(rot) * couple, d)
        mount_a = d.v + rot * (wp.cross(d.w, arm_b) + wp.cross(b.w, wp.cross(b.w, arm_b)))
        inverse = wp.diag(
            V3(REAL(1.0) / p.inertia[0], REAL(1.0) / p.inertia[1], REAL(1.0) / p.inertia[2])
        )
        lever = rot * wp.skew(arm_b)
        mobility = eye / p.mass + lever * inverse * wp.transpose(lever)
        bare = (
            -wp.dot(u, u) * n
            + (flat * (first * gravity + reach * air) + wp.cross(couple, n)) / second
        )
        lhs = eye + mobility * (total * eye - (first * first / second) * flat)
        a = wp.inverse(lhs) * (mount_a + mobility * (total * gravity - first * bare + air))
        change[0] = bare - (first / second) * (flat * a)
        pull = total * (gravity - a) - first * change[0] + air
        d.v = d.v + pull / p.mass
        d.w = d.w + wp.cw_div(wp.cross(arm_b, wp.transpose(rot) * pull), p.inertia)
        return d, wp.dot(pull, n), thrust

    @wp.func
    def ball(p: Numbers, b: Body, place: wp.array(dtype=V3), speed: wp.array(dtype=V3)):
        rot = rotation(b.q)
        arm = rot * (p.mount - p.com)
        reach = p.length + p.ball_reach
        return b.x + arm + reach * place[0], b.v + wp.cross(rot * b.w, arm) + reach * speed[0]

    @wp.func
    def tidy(place: wp.array(dtype=V3), speed: wp.array(dtype=V3)):
        place[0] = wp.normalize(place[0])
        speed[0] = speed[0] - wp.dot(speed[0], place[0]) * place[0]

    return rates, ball, tidy, nodes

"""World P2: a string of point masses with constrained distances, bending stiffness and stretch.

Coordinates are positions of the masses. The tensions solve the tridiagonal system that keeps each
distance at its length (twice differentiated, with critically damped feedback of what is left), so
nothing here resembles a recursion over joints."""

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

PULL_BACK = 400.0
"""Natural frequency of the feedback on the distances [rad/s]."""


def build(nodes: int = 24):
    """Warp functions of the plant with ``nodes`` masses, the ball the last one."""
    N = nodes

    @wp.func
    def node_mass(p: Numbers, i: wp.int32):
        share = p.rope_mass / REAL(float(N))
        if i == N - 1:
            return REAL(0.5) * share + p.ball_mass
        return share

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
        """Derivative of the body; ``place`` and ``speed`` are positions and velocities of the
        masses, ``change`` accelerations.
        """
        pull = wp.zeros(shape=(N,), dtype=REAL)
        upper = wp.zeros(shape=(N,), dtype=REAL)
        side = wp.zeros(shape=(N,), dtype=V3)
        normal = wp.zeros(shape=(N,), dtype=V3)
        force, torque, thrust, d = vehicle_load(p, b, command, push, twist)
        rot = rotation(b.q)
        arm_b = p.mount - p.com
        mount = b.x + rot * arm_b
        w_world = rot * b.w
        mount_v = b.v + wp.cross(w_world, rot * arm_b)
        bit = p.length / REAL(float(N))
        gravity = V3(REAL(0.0), REAL(0.0), -REAL(EARTH))
        load = V3()  # of the joints' forces on the mount
        reaction = V3()  # their couple on the vehicle
        above = V3()
        above_rate = w_world + V3()
        for i in range(N):
            tail = mount
            tail_v = mount_v
            if i > 0:
                tail = place[i - 1] + V3()
                tail_v = speed[i - 1] + V3()
            d_x = place[i] - tail
            d_v = speed[i] - tail_v
            size = wp.length(d_x)
            n = d_x / size
            normal[i] = n
            rate = wp.cross(n, d_v) / size
            bend = rate - above_rate
            couple = -p.joint_damping * bend - p.joint_damping_square * wp.length(bend) * bend
            if i > 0:
                couple += (p.bending / bit) * wp.cross(n, above)
            pair = wp.cross(couple, n) / size
            side[i] = side[i] + pair
            # Joint i turns segment i one way and what is above it the other way.
            if i == 0:
                load -= pair
                reaction -= couple
            else:
                side[i - 1] = side[i - 1] - pair
                up_n = normal[i - 1]
                up_tail = mount
                if i > 1:
                    up_tail = place[i - 2] + V3()
                up_pair = wp.cross(-couple, up_n) / wp.length(place[i - 1] - up_tail)
                side[i - 1] = side[i - 1] + up_pair
                if i == 1:
                    load -= up_pair
                else:
                    side[i - 2] = side[i - 2] - up_pair
            above = n
            above_rate = rate
        last = normal[N - 1]
        ball_v = speed[N - 1]
        air = (
            ball_force(p, ball_v, rot, thrust, 1)
            + ball_push
            - p.rope_drag * (ball_v - wp.dot(ball_v, last) * last)
        )
        side[N - 1] = side[N - 1] + air

        d = free_motion(
            p,
            b,
            force + load,
            torque + wp.transpose(rot) * reaction + wp.cross(arm_b, wp.transpose(rot) * load),
            d,
        )
        mount_a = d.v + rot * (wp.cross(d.w, arm_b) + wp.cross(b.w, wp.cross(b.w, arm_b)))
        inverse = wp.diag(
            V3(REAL(1.0) / p.inertia[0], REAL(1.0) / p.inertia[1], REAL(1.0) / p.inertia[2])
        )
        lever = rot * wp.skew(arm_b)
        mobility = wp.identity(n=3, dtype=REAL) / p.mass + lever * inverse * wp.transpose(lever)

        w0 = REAL(PULL_BACK)
        below = REAL(0.0)
        for i in range(N):  # forward sweep of the tridiagonal system in the tensions
            n = normal[i]
            free_here = gravity + side[i] / node_mass(p, i)
            free_above = mount_a
            tail = mount
            tail_v = mount_v
            weight_above = wp.dot(n, mobility * n)
            coupling_above = REAL(0.0)
            if i > 0:
                free_above = gravity + side[i - 1] / node_mass(p, i - 1)
                tail = place[i - 1] + V3()
                tail_v = speed[i - 1] + V3()
                weight_above = REAL(1.0) / node_mass(p, i - 1)
                coupling_above = wp.dot(n, normal[i - 1]) / node_mass(p, i - 1)
            d_x = place[i] - tail
            d_v = speed[i] - tail_v
            size = wp.length(d_x)
            along = wp.dot(n, d_v)
            rest = bit + REAL(0.0)
            if i == N - 1:
                rest = bit + p.ball_reach
            right = wp.dot(n, free_here - free_above) + (wp.dot(d_v, d_v) - along * along) / size
            right += REAL(2.0) * w0 * along + w0 * w0 * (size - rest)
            # The rope gives, not the ball at its end.
            diagonal = (
                REAL(1.0) / node_mass(p, i)
                + weight_above
                - coupling_above * below
                + w0 * w0 * bit * p.stretch
            )
            known = right + REAL(0.0)
            if i > 0:
                known = right + coupling_above * pull[i - 1]
            next_coupling = REAL(0.0)
            if i < N - 1:
                tail_n = place[i + 1] - place[i]
                next_coupling = wp.dot(n, tail_n) / wp.length(tail_n) / node_mass(p, i)
            below = next_coupling / diagonal
            upper[i] = below
            pull[i] = known / diagonal
        for k in range(N - 1):
            i = N - 2 - k
            pull[i] = pull[i] + upper[i] * pull[i + 1]
        for i in range(N):
            total = side[i] - pull[i] * normal[i]
            if i < N - 1:
                total += pull[i + 1] * normal[i + 1]
            change[i] = gravity + total / node_mass(p, i)
        at_mount = pull[0] * normal[0]
        d.v = d.v + at_mount / p.mass
        d.w = d.w + wp.cw_div(wp.cross(arm_b, wp.transpose(rot) * at_mount), p.inertia)
        return d, pull[0], thrust

    @wp.func
    def ball(p: Numbers, b: Body, place: wp.array(dtype=V3), speed: wp.array(dtype=V3)):
        return place[N - 1], speed[N - 1]

    @wp.func
    def tidy(place: wp.array(dtype=V3), speed: wp.array(dtype=V3)):
        place[0] = place[0]

    return rates, ball, tidy, N

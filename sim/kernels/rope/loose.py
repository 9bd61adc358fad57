"""Free flight of rope and payload after the release: the chain of :mod:`sim.kernels.rope.chain`
without a vehicle.
"""

from types import SimpleNamespace

import warp as wp

from sim.kernels.quadrotor.rigid_body import mount_position, mount_velocity
from sim.kernels.rope.chain import symmetric
from sim.kernels.rope.payload import build_flight, free_force
from sim.kernels.rope.release import build_step_in_flight, kick
from sim.kernels.structs import Types, make_struct


def build_loose_step(t: Types, chain):
    """Build a ROS2 step of a rope whose upper end is free.

    The acceleration a of the upper end follows from ``A a + b = 0``, as no force acts there. As in
    the coupled step, its velocity follows from the total momentum. Returns a Warp function
    ``step(rope, air, pos_w, vel_w, n, u, stiffness, gravity, gamma, max_turn, h)`` -> position and
    velocity of the upper end; the arrays n, u and stiffness change in place."""
    vec3 = t.vec3
    Vectors = t.Vectors
    real = t.real
    vec2 = chain.vec2
    L = chain.segments

    @wp.func
    def free_root(d: vec3, o: vec3, b: vec3):
        return -(wp.inverse(symmetric(d, o)) * b)

    @wp.func
    def step(
        rope: t.Rope,
        air: t.Air,
        pos_w: vec3,
        vel_w: vec3,
        n: Vectors,
        u: Vectors,
        stiffness: t.Reals,
        gravity: vec3,
        gamma: real,
        max_turn: real,
        h: real,
    ):
        k1 = wp.zeros(L, vec3)
        n2 = wp.zeros(L, vec3)
        c1 = wp.zeros(L, vec3)
        c2 = wp.zeros(L, vec3)
        hs = wp.zeros(L, vec2)
        half = real(0.5)
        total = rope.total_mass * vel_w + chain.momentum(rope, u)
        load1 = free_force(rope, air, chain.speed(rope, vel_w, u, k1, h))
        # an upper end that turns with the first rod has no friction
        d, o, b = chain.up_first(
            rope,
            n,
            u,
            n2,
            k1,
            stiffness,
            wp.cross(n[0], u[0]),
            gravity,
            load1,
            gamma,
            h,
            c1,
            c2,
            hs,
        )
        acc = free_root(d, o, b)
        fastest = chain.down_first(rope, n, u, acc, gamma, h, c1, c2, hs, n2, k1)
        weight = rope.total_mass * gravity
        if fastest * h * h > max_turn * max_turn:
            chain.fall_back(n, u, h, n2, k1)
            vel = (total + h * (weight + load1) - chain.momentum(rope, u)) / rope.total_mass
            return pos_w + (half * h) * (vel_w + vel), vel
        predicted = vel_w + h * acc
        load2 = free_force(rope, air, chain.speed(rope, predicted, u, k1, h))
        turn = wp.cross(n2[0], u[0] + h * k1[0])
        d, o, b = chain.up_second(
            rope, n, u, n2, k1, stiffness, turn, gravity, load2, gamma, h, c1, c2, hs
        )
        acc = free_root(d, o, b)
        relative = chain.down_second(
            rope, n, u, stiffness, acc, vec3(), gravity, load2, gamma, h, c1, c2, hs, n2, k1
        )
        vel = (total + h * weight + (half * h) * (load1 + load2) - relative) / rope.total_mass
        return pos_w + (half * h) * (vel_w + vel), vel

    return step


def build_loose(
    t: Types,
    chain: SimpleNamespace,
    laws: SimpleNamespace,
) -> SimpleNamespace:
    """Build the flight of a payload, and of a rope that may leave with it, with all extensions.

    Returns a namespace of the struct ``Ball`` (payload alone, and rope with payload) and of Warp
    functions: ``let_go(r, rope, quad, n, u)`` -> ball at the separation; ``hang_below(rope, pos,
    vel, n, u)`` -> ball with a payload at this position and velocity; ``fly(ball, rope, r, air, n,
    u, stiffness, gravity, gamma, max_turn, h)`` -> ball after h seconds; ``payload(r, ball)`` ->
    position and velocity of the payload, a mean of both weighted by ``rope_tail``."""
    vec3 = t.vec3
    real = t.real
    Vectors = t.Vectors
    Rope = t.Rope
    Release = t.Release
    last = chain.segments - 1
    names = ("pos", "vel", "root", "root_vel", "tail", "tail_vel")
    Ball = make_struct("Ball", dict.fromkeys(names, vec3))
    step = build_loose_step(t, chain)
    fly_ball = build_step_in_flight(t, build_flight(t, laws))

    @wp.func
    def let_go(r: Release, rope: Rope, s: t.QuadState, n: Vectors, u: Vectors):
        ball = Ball()
        ball.root = mount_position(rope, s)
        ball.root_vel = mount_velocity(rope, s)
        pos, vel = chain.payload(rope, ball.root, ball.root_vel, n, u)
        ball.pos = pos
        ball.vel = kick(r, vel, n[last])
        ball.root_vel = ball.root_vel + (ball.vel - vel)
        ball.tail = pos
        ball.tail_vel = ball.vel
        return ball

    @wp.func
    def hang_below(rope: Rope, pos: vec3, vel: vec3, n: Vectors, u: Vectors):
        ball = Ball()
        ball.pos = pos
        ball.vel = vel
        arm, arm_vel = chain.payload(rope, vec3(), vec3(), n, u)
        ball.root = pos - arm
        ball.root_vel = vel - arm_vel
        ball.tail = pos
        ball.tail_vel = vel
        return ball

    @wp.func
    def fly(
        ball: Ball,
        rope: Rope,
        r: Release,
        air: t.Air,
        n: Vectors,
        u: Vectors,
        stiffness: t.Reals,
        gravity: vec3,
        gamma: real,
        max_turn: real,
        h: real,
    ):
        out = ball
        pos, vel = fly_ball(rope, air, ball.pos, ball.vel, gravity, h)
        out.pos = pos
        out.vel = vel
        if r.rope_tail > real(0.0):
            root, root_vel = step(
                rope, air, ball.root, ball.root_vel, n, u, stiffness, gravity, gamma, max_turn, h
            )
            tail, tail_vel = chain.payload(rope, root, root_vel, n, u)
            out.root = root
            out.root_vel = root_vel
            out.tail = tail
            out.tail_vel = tail_vel
        return out

    @wp.func
    def payload_state(r: Release, ball: Ball):
        pos = ball.pos + r.rope_tail * (ball.tail - ball.pos)
        return pos, ball.vel + r.rope_tail * (ball.tail_vel - ball.vel)

    return SimpleNamespace(
        Ball=Ball,
        let_go=let_go,
        hang_below=hang_below,
        fly=fly,
        payload=payload_state,
    )

"""Rope and payload in free flight after the release: the chain of :mod:`sim.kernels.rope.chain`
without a vehicle.
"""

import warp as wp

from sim.kernels.structs import Types


def build_loose_step(t: Types, chain, payload):
    """One ROS2 step of a rope that nothing holds.

    The root's acceleration a follows from ``A a + b = 0``: nothing pulls at the upper end. As in
    the coupled step the root's velocity follows from the total momentum. Returns a Warp function
    ``step(rope, air, pos_w, vel_w, n, u, stiffness, gravity, gamma, max_turn, h)`` -> position and
    velocity of the upper end; the arrays n, u and stiffness change in place."""
    vec3 = t.vec3
    Vectors = t.Vectors
    Reals = t.Reals
    mat33 = t.mat33
    real = t.real
    Rope = t.Rope
    Air = t.Air
    vec2 = chain.vec2
    L = chain.segments

    @wp.func
    def free_root(d: vec3, o: vec3, b: vec3):
        return -(wp.inverse(mat33(d[0], o[0], o[1], o[0], d[1], o[2], o[1], o[2], d[2])) * b)

    @wp.func
    def step(
        rope: Rope,
        air: Air,
        pos_w: vec3,
        vel_w: vec3,
        n: Vectors,
        u: Vectors,
        stiffness: Reals,
        gravity: vec3,
        gamma: real,
        max_turn: real,
        h: real,
    ):
        k1 = wp.zeros(shape=(L,), dtype=vec3)
        n2 = wp.zeros(shape=(L,), dtype=vec3)
        c1 = wp.zeros(shape=(L,), dtype=vec3)
        c2 = wp.zeros(shape=(L,), dtype=vec3)
        hs = wp.zeros(shape=(L,), dtype=vec2)
        half = real(0.5)
        total = rope.total_mass * vel_w + chain.momentum(rope, u)
        load1 = payload.free(rope, air, chain.speed_first(rope, vel_w, u, k1, h))
        # a root that turns with the first rod rubs on nothing
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
        load2 = payload.free(rope, air, chain.speed_second(rope, predicted, u, k1, h))
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

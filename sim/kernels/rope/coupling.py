"""Integration step of vehicle and chain as one system: root solve, ROS2 stages, momentum,
fall-back.
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from sim.kernels.quadrotor.integrators import build_quad_step
from sim.kernels.quadrotor.rigid_body import (
    angular_acceleration,
    blend,
    mount_position,
    mount_velocity,
)
from sim.kernels.rope.chain import symmetric
from sim.kernels.rope.payload import LOADS, hanging_force
from sim.kernels.structs import Types


@wp.func
def root(
    p: Any, rope: Any, s: Any, force_b: Any, torque_b: Any, d: Any, o: Any, b: Any, gravity: Any
):
    """Solve for the vehicle's acceleration, given apparent mass (``d``, ``o``) and force ``b`` of
    the chain at the mount (``sim.kernels.rope.chain``).

    Returns the acceleration of the centre of mass [m/s^2, world], the angular acceleration
    [rad/s^2, body], the acceleration of the mount [world] and the force on the chain [N, world]."""
    one = type(p.body.mass)(1.0)
    r = rope.mount
    rot = wp.quat_to_matrix(s.quat_wb)
    inv_mass = one / p.body.mass
    alpha = angular_acceleration(p, s.rate_b, torque_b)
    acc = inv_mass * (rot * force_b) + gravity
    free = acc + rot * (wp.cross(alpha, r) + wp.cross(s.rate_b, wp.cross(s.rate_b, r)))
    arm = rot * wp.skew(r)
    ones = type(r)(one, one, one)
    inv_inertia = wp.cw_div(ones, p.body.inertia)
    mobility = wp.diag(inv_mass * ones) + arm * wp.diag(inv_inertia) * wp.transpose(arm)
    mass = symmetric(d, o)
    mount_acc = wp.inverse(wp.diag(ones) + mobility * mass) * (free - mobility * b)
    pull = mass * mount_acc + b
    reaction_b = -(wp.transpose(rot) * pull)
    alpha = alpha + wp.cw_mul(inv_inertia, wp.cross(r, reaction_b))
    return acc - inv_mass * pull, alpha, mount_acc, pull


def build_coupled_step(
    t: Types,
    flow,
    advance,
    chain: SimpleNamespace,
    extensions: frozenset[str],
    integrator: str = "heun",
    hanging=hanging_force,
):
    """Build a step of h seconds of vehicle and chain.

    The vehicle advances by Heun's method and the chain by ROS2, both from the same two solves. The
    vehicle's velocity follows from the total linear momentum, which only external forces change. So
    momentum is conserved to round-off. If a rod turns by more than ``max_turn`` in the step, only
    the first stage (linearly implicit Euler) is used. Returns a namespace of Warp functions
    ``step`` (new state, new total momentum, whether it fell back to the first stage; the arrays n,
    u and stiffness change in place), ``step_alone`` (the vehicle without the rope, by the
    ``integrator``), ``momentum`` (total linear momentum [N s]) and ``payload`` (position and
    velocity of its centre, world frame). ``hanging``: function of the force on the payload."""
    vec3 = t.vec3
    Vectors = t.Vectors
    real = t.real
    Vehicle = t.Vehicle
    Rope = t.Rope
    Air = t.Air
    QuadState = t.QuadState
    vec2 = chain.vec2
    L = chain.segments
    loaded = bool(extensions & LOADS)

    @wp.func
    def payload_state(rope: Rope, s: QuadState, n: Vectors, u: Vectors):
        return chain.payload(rope, mount_position(rope, s), mount_velocity(rope, s), n, u)

    @wp.func
    def load(
        rope: Rope,
        air: Air,
        s: QuadState,
        f: t.QuadRate,
        n: Vectors,
        u: Vectors,
        k1: Vectors,
        h: real,
    ):
        """Return the force on the payload [N], world frame."""
        if wp.static(loaded):
            jet = wp.quat_rotate(s.quat_wb, vec3(real(0.0), real(0.0), -f.force_b[2]))
            vel = chain.speed(rope, mount_velocity(rope, s), u, k1, h)
            return hanging(rope, air, vel, n[L - 1], jet)
        else:
            return vec3()

    @wp.func
    def momentum(p: Vehicle, rope: Rope, s: QuadState, u: Vectors):
        return (
            p.body.mass * s.vel_w
            + rope.total_mass * mount_velocity(rope, s)
            + chain.momentum(rope, u)
        )

    @wp.func
    def root_velocity(p: Vehicle, rope: Rope, s: QuadState, total: vec3, relative: vec3):
        """Return the velocity of the vehicle from the total momentum and the chain's momentum
        relative to the mount.
        """
        turn = wp.quat_rotate(s.quat_wb, wp.cross(s.rate_b, rope.mount))
        return (total - rope.total_mass * turn - relative) / (p.body.mass + rope.total_mass)

    @wp.func
    def damping_torque(rope: Rope, s: QuadState, rate_w: vec3, n: vec3, u: vec3):
        """Return the torque of the uppermost joint on the vehicle [N m], body frame."""
        damping = rope.joint_damping + rope.mount_damping
        return damping * wp.quat_rotate_inv(s.quat_wb, wp.cross(n, u) - rate_w)

    @wp.func
    def step(
        p: Vehicle,
        rope: Rope,
        air: Air,
        s: QuadState,
        total: vec3,
        command: t.vec4,
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
        weight = (p.body.mass + rope.total_mass) * gravity

        f1 = flow(p, air, s, command)
        rate_w = wp.quat_rotate(s.quat_wb, s.rate_b)
        load1 = load(rope, air, s, f1, n, u, k1, h)
        d, o, b = chain.up_first(
            rope, n, u, n2, k1, stiffness, rate_w, gravity, load1, gamma, h, c1, c2, hs
        )
        torque = f1.torque_b + damping_torque(rope, s, rate_w, n[0], u[0])
        acc_w, alpha_b, mount_acc, pull = root(p, rope, s, f1.force_b, torque, d, o, b, gravity)
        f1.vel_w = acc_w
        f1.rate_b = alpha_b
        fastest = chain.down_first(rope, n, u, mount_acc, gamma, h, c1, c2, hs, n2, k1)
        push1 = wp.quat_rotate(s.quat_wb, f1.force_b)
        s2 = advance(s, f1, h)
        fell_back = fastest * h * h > max_turn * max_turn
        if fell_back:
            chain.fall_back(n, u, h, n2, k1)
            new_total = total + h * (push1 + weight)
            if wp.static(loaded):
                new_total += (half * h) * (load1 + load1)
            s2.vel_w = root_velocity(p, rope, s2, new_total, chain.momentum(rope, u))
            return s2, new_total, fell_back

        f2 = flow(p, air, s2, command)
        rate_w = wp.quat_rotate(s2.quat_wb, s2.rate_b)
        load2 = load(rope, air, s2, f2, n2, u, k1, h)
        d, o, b = chain.up_second(
            rope, n, u, n2, k1, stiffness, rate_w, gravity, load2, gamma, h, c1, c2, hs
        )
        torque = f2.torque_b + damping_torque(rope, s2, rate_w, n2[0], u[0] + h * k1[0])
        acc_w, alpha_b, mount_acc, pull = root(p, rope, s2, f2.force_b, torque, d, o, b, gravity)
        f2.vel_w = acc_w
        f2.rate_b = alpha_b
        relative = chain.down_second(
            rope, n, u, stiffness, mount_acc, pull, gravity, load2, gamma, h, c1, c2, hs, n2, k1
        )
        out = advance(s, blend(f2, half, f1, half), h)
        new_total = (
            total + (half * h) * (push1 + wp.quat_rotate(s2.quat_wb, f2.force_b)) + h * weight
        )
        if wp.static(loaded):
            new_total += (half * h) * (load1 + load2)
        out.vel_w = root_velocity(p, rope, out, new_total, relative)
        return out, new_total, fell_back

    return SimpleNamespace(
        step=step,
        step_alone=build_quad_step(t, flow, advance, integrator),
        momentum=momentum,
        payload=payload_state,
    )

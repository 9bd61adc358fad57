"""Rope and payload as a chain of slender rods below the vehicle: O(n) recursion with 3x3 matrices, linearly implicit.

A slender rod on a frictionless universal joint passes a force and no moment. Seen from its upper joint, everything below
rod i therefore asks for a force ``A a + b`` (A: symmetric apparent mass, a: acceleration of the joint). For rod i with
direction n (from the upper joint outwards), ``u = dn/dt``, length l, mass m, centre of mass c along n, transverse
inertia J about the upper joint, external force f at its centre, joint couples tau, and ``A, b`` of what hangs at its end,
with ``dn'/dt = beta - |u|^2 n``:

    (J I + l^2 P A P) beta = P [g - B a],   B = c m I + l A,   g = c f - l b + l^2 |u|^2 A n + tau x n
    A' = m I + A - B Q B,   b' = b - f - |u|^2 B n + B Q g

where Q is the inverse of the left matrix in the plane normal to n. Each rod is solved in a tangent basis (e1, e2) of n:
with ``b_k = B e_k`` and the 2x2 inverse q, ``c_k = sum_j q_kj b_j`` gives ``B Q B = sum_k b_k c_k^T`` and
``beta = sum_k e_k (h_k - c_k . a)``. Derivation: Newton and Euler for one rod about its upper joint (Featherstone,
*Rigid Body Dynamics Algorithms*, ch. 7, with a 2-dof joint that transmits no moment).

Time integration (ROS2 of Verwer et al., SIAM J. Sci. Comput. 20, 1999, as a W-method): the Jacobian is approximated rod
by rod by its geometric stiffness K (tension times arm) and its joint damping D, which only adds
``gamma h D + gamma^2 h^2 K`` to J; any approximation keeps second order. With k1 the first stage and z the solution of
the same recursion at the predicted state plus the terms of :func:`implicit_terms`, ``u+ = u + h/2 (k1 + z)``.
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from sim.params import GRAVITY
from sim.structs import Types


@wp.func
def sym_mul(d: Any, o: Any, v: Any):
    """Product of the symmetric matrix with diagonal ``d`` and off-diagonals ``o = (xy, xz, yz)`` and a vector."""
    return type(v)(
        d[0] * v[0] + o[0] * v[1] + o[1] * v[2], o[0] * v[0] + d[1] * v[1] + o[2] * v[2], o[1] * v[0] + o[2] * v[1] + d[2] * v[2]
    )


@wp.func
def tangent_basis(n: Any):
    """Two unit vectors that complete the unit vector n. Source: Duff et al., JCGT 6(1), 2017."""
    one = type(n[0])(1.0)
    sign = one
    if n[2] < n[2] - n[2]:
        sign = -one
    a = -one / (sign + n[2])
    b = n[0] * n[1] * a
    return type(n)(one + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), type(n)(b, sign + n[1] * n[1] * a, -n[1])


@wp.func
def implicit_terms(stiffness: Any, damping: Any, u: Any, k1: Any, gh: Any, h: Any, stage: int):
    """Right-hand side that the W-method adds to a rod's moment balance; ``gh`` is gamma h, k1 the first stage.

    First stage: ``-gh K u``. Second, from ``(I - gh J) k2 = f2 - 2 k1`` with ``z = k2 + 2 k1``:
    ``gh K u2 + (2 gh K (2 gh - h) + 2 gh D) k1``.
    """
    two = type(h)(2.0)
    if stage == 0:
        return -gh * stiffness * u
    return gh * stiffness * u + two * gh * (stiffness * (two * gh - h) + damping) * k1


def build_chain(t: Types, segments: int) -> SimpleNamespace:
    """Recursion for a fixed number of segments.

    Returns:
        Namespace of Warp functions ``up`` (leaf to root: apparent mass and force of the whole chain at the mount), ``down``
        (root to leaf: accelerations and the rods' stiffness), ``payload`` (position and velocity of the payload's
        centre), ``momentum`` (linear momentum relative to the mount).
    """
    L = segments
    real, vec3, Rope = t.real, t.vec3, t.Rope
    vec2 = wp.types.vector(2, real)
    weight = vec3(0.0, 0.0, -GRAVITY)

    @wp.func
    def rod(rope: Rope, i: int):
        """Mass, centre along n, transverse inertia about the upper joint of rod i; the last one carries the payload."""
        if i == L - 1:
            return rope.last_mass, rope.last_center, rope.last_inertia
        return rope.segment_mass, real(0.5) * rope.segment_length, rope.segment_inertia

    @wp.func
    def joint_couple(
        rope: Rope, n: wp.array(dtype=vec3), u: wp.array(dtype=vec3), root_rate_w: vec3, i: int
    ):
        """Viscous couples of rod i's joints, crossed into n, and the rod's own damping coefficient."""
        above = root_rate_w
        if i > 0:
            above = wp.cross(n[i - 1], u[i - 1])
        d = rope.joint_damping
        couple = d * (wp.cross(above, n[i]) - u[i])
        own = d
        if i < L - 1:
            couple += d * (wp.cross(wp.cross(n[i + 1], u[i + 1]), n[i]) - u[i])
            own += d
        return couple, own

    @wp.func
    def up(
        rope: Rope, n: wp.array(dtype=vec3), u: wp.array(dtype=vec3), k1: wp.array(dtype=vec3),
        stiffness: wp.array(dtype=real), root_rate_w: vec3, gravity: vec3, gamma: real, h: real, stage: int,
        c1: wp.array(dtype=vec3), c2: wp.array(dtype=vec3), hs: wp.array(dtype=vec2),
    ):
        l = rope.segment_length
        gh = gamma * h
        d = vec3()  # apparent mass of what hangs below: diagonal
        o = vec3()  # and off-diagonal (xy, xz, yz)
        b = vec3()
        for step in range(L):
            i = L - 1 - step
            m, c, inertia = rod(rope, i)
            ni = n[i]
            couple, damping = joint_couple(rope, n, u, root_rate_w, i)
            speed2 = wp.dot(u[i], u[i])
            a_n = sym_mul(d, o, ni)
            f = m * gravity
            g = c * f - l * b + (l * l * speed2) * a_n + couple
            g += implicit_terms(stiffness[i], damping, u[i], k1[i], gh, h, stage)
            e1, e2 = tangent_basis(ni)
            a_e1 = sym_mul(d, o, e1)
            a_e2 = sym_mul(d, o, e2)
            effective = inertia + gh * damping + gh * gh * stiffness[i]
            s11 = effective + l * l * wp.dot(e1, a_e1)
            s12 = l * l * wp.dot(e1, a_e2)
            s22 = effective + l * l * wp.dot(e2, a_e2)
            inv = real(1.0) / (s11 * s22 - s12 * s12)
            b1 = (c * m) * e1 + l * a_e1
            b2 = (c * m) * e2 + l * a_e2
            q1 = inv * (s22 * b1 - s12 * b2)
            q2 = inv * (s11 * b2 - s12 * b1)
            g1 = wp.dot(e1, g)
            g2 = wp.dot(e2, g)
            h1 = inv * (s22 * g1 - s12 * g2)
            h2 = inv * (s11 * g2 - s12 * g1)
            b = b - f - speed2 * ((c * m) * ni + l * a_n) + h1 * b1 + h2 * b2
            d = d + vec3(m, m, m) - wp.cw_mul(b1, q1) - wp.cw_mul(b2, q2)
            o = o - vec3(
                b1[0] * q1[1] + b2[0] * q2[1], b1[0] * q1[2] + b2[0] * q2[2], b1[1] * q1[2] + b2[1] * q2[2]
            )
            c1[i] = q1
            c2[i] = q2
            hs[i] = vec2(h1, h2)
        return d, o, b

    @wp.func
    def down(
        rope: Rope, n: wp.array(dtype=vec3), u: wp.array(dtype=vec3), mount_acc_w: vec3, mount_force_w: vec3, gravity: vec3,
        c1: wp.array(dtype=vec3), c2: wp.array(dtype=vec3), hs: wp.array(dtype=vec2),
        acc: wp.array(dtype=vec3), stiffness: wp.array(dtype=real),
    ):
        """Fill ``acc`` with du/dt of every rod; ``stiffness`` with its geometric stiffness for the next step.

        ``mount_force_w`` is the force that the vehicle exerts on the chain.
        """
        a = mount_acc_w
        pull = mount_force_w
        l = rope.segment_length
        for i in range(L):
            m, c, inertia = rod(rope, i)
            ni = n[i]
            e1, e2 = tangent_basis(ni)
            beta = e1 * (hs[i][0] - wp.dot(c1[i], a)) + e2 * (hs[i][1] - wp.dot(c2[i], a))
            k = beta - wp.dot(u[i], u[i]) * ni
            f = m * gravity
            pull = pull + f - m * (a + c * k)
            stiffness[i] = wp.max(wp.dot(ni, c * (f - m * a) - l * pull), real(0.0))
            acc[i] = k
            a = a + l * k

    @wp.func
    def payload(rope: Rope, mount_pos_w: vec3, mount_vel_w: vec3, n: wp.array(dtype=vec3), u: wp.array(dtype=vec3)):
        pos = mount_pos_w
        vel = mount_vel_w
        for i in range(L):
            pos += rope.segment_length * n[i]
            vel += rope.segment_length * u[i]
        return pos + rope.payload_offset * n[L - 1], vel + rope.payload_offset * u[L - 1]

    @wp.func
    def momentum(rope: Rope, u: wp.array(dtype=vec3)):
        """Linear momentum [N s] of the chain in a frame that moves with the mount."""
        below = rope.last_mass
        total = rope.last_mass * rope.last_center * u[L - 1]
        for step in range(L - 1):
            i = L - 2 - step
            total += (below * rope.segment_length + real(0.5) * rope.segment_mass * rope.segment_length) * u[i]
            below += rope.segment_mass
        return total

    return SimpleNamespace(up=up, down=down, payload=payload, momentum=momentum, weight=weight, segments=L, vec2=vec2)

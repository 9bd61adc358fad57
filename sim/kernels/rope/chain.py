"""Rope and payload as a chain of slender rods below the vehicle.

The recursion is of O(n) with 3x3 matrices, and linearly implicit.

A slender rod on a frictionless universal joint transmits a force and no moment. So the force at the
upper joint that accelerates rod i and everything below it is ``A a + b`` (A: symmetric apparent
mass, a: acceleration of the joint). For rod i with direction n (from the upper joint outwards),
``u = dn/dt``, length l, mass m, centre of mass c along n, transverse inertia J about the upper
joint, external force f at its centre, joint couples tau, and ``A, b`` of the chain at its lower
end, with ``du/dt = beta - |u|^2 n``:

    (J I + l^2 P A P) beta = P [g - B a],
        B = c m I + l A,
        g = c f - l b + l^2 |u|^2 A n + tau x n
    A' = m I + A - B Q B,   b' = b - f - |u|^2 B n + B Q g

where Q is the inverse of the left matrix in the plane normal to n. Each rod is solved in a tangent
basis (e1, e2) of n: with ``b_k = B e_k`` and the 2x2 inverse q, ``c_k = sum_j q_kj b_j`` gives ``B
Q B = sum_k b_k c_k^T`` and ``beta = sum_k e_k (h_k - c_k . a)``. Derivation: Newton-Euler equations
of one rod about its upper joint (Featherstone, *Rigid Body Dynamics Algorithms*, ch. 7, with a
2-dof joint that transmits no moment).

Time integration (ROS2 of Verwer et al., SIAM J. Sci. Comput. 20, 1999, as a W-method): the Jacobian
of each rod is approximated by its geometric stiffness K (tension times arm) and its joint damping
D, which only adds ``gamma h D + gamma^2 h^2 K`` to J. The order is 2 for any approximation. Let k1
be the first stage, ``n2 = n + h (u + gamma h k1)``, ``u2 = u + h k1`` the predicted state, and z
the solution of the same recursion there. From ``(I - gh J) k2 = f2 - 2 k1``, with ``z = k2 + 2 k1``
and gh = gamma h, follow::

    u+ = u + h/2 (k1 + z),   n+ = n + h/2 (u + u2 + gamma h (z - k1))

The rods of an elastic rope lengthen with the tension at the mount (equations:
:class:`sim.params.RopeParams`). With length l of a rod and its rate l', the velocity of the lower
end relative to the upper one is ``l u + l' n``. The additional (Coriolis) acceleration ``2 l' u``
acts on the chain below and on the rod's mass."""

from types import SimpleNamespace
from typing import Any

import warp as wp

from sim.kernels.rope.payload import LOADS
from sim.kernels.structs import Types


@wp.func
def sym_mul(d: Any, o: Any, v: Any):
    """Return the product of a vector and the symmetric matrix with diagonal ``d`` and off-diagonals
    ``o = (xy, xz, yz)``.
    """
    return type(v)(
        d[0] * v[0] + o[0] * v[1] + o[1] * v[2],
        o[0] * v[0] + d[1] * v[1] + o[2] * v[2],
        o[1] * v[0] + o[2] * v[1] + d[2] * v[2],
    )


@wp.func
def symmetric(d: Any, o: Any):
    """Return the symmetric matrix with diagonal ``d`` and off-diagonals ``o = (xy, xz, yz)``."""
    x = type(d)(d[0], o[0], o[1])
    y = type(d)(o[0], d[1], o[2])
    return wp.matrix_from_rows(x, y, type(d)(o[1], o[2], d[2]))


@wp.func
def tangent_basis(n: Any):
    """Return two unit vectors normal to the unit vector n and to each other.

    Source: Duff et al., JCGT 6(1), 2017."""
    one = type(n[0])(1.0)
    sign = one
    if n[2] < n[2] - n[2]:
        sign = -one
    a = -one / (sign + n[2])
    b = n[0] * n[1] * a
    return type(n)(one + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), type(n)(
        b, sign + n[1] * n[1] * a, -n[1]
    )


@wp.func
def growing(rope: Any, u: Any):
    """Return the Coriolis acceleration ``2 l' u`` of the lower end of a rod that lengthens."""
    return (type(rope.strain_rate)(2.0) * rope.strain_rate * rope.segment_length) * u


def build_rods(t: Types, segments: int, extensions: frozenset[str]) -> SimpleNamespace:
    """Return a namespace of Warp functions of a rod's index, ``segments`` and the type ``vec2``."""
    L = segments
    real = t.real
    vec3 = t.vec3
    Rope = t.Rope
    last = L - 1
    loaded = bool(extensions & LOADS)
    giving = "compliance" in extensions

    @wp.func
    def with_load(i: int, part: vec3, arm: real, load: vec3):
        """Return the force (arm 1) or moment (arm [m]) on rod i; that of the last rod with the
        force ``load`` on the payload added.
        """
        if wp.static(loaded):
            if i == last:
                return part + arm * load
        return part

    @wp.func
    def upper_damping(rope: Rope, i: int):
        """Return the damping of the upper joint of rod i [N m s]; that of the first includes the
        mount's friction.
        """
        if wp.static("mount_damping" in extensions):
            if i == 0:
                return rope.joint_damping + rope.mount_damping
        return rope.joint_damping

    @wp.func
    def centre_share(rope: Rope, i: int):
        """Return the displacement of a rod's centre of mass per elongation of the rod."""
        if i == last:
            return rope.stretched_share
        return real(0.5)

    @wp.func
    def tip(rope: Rope, acc: vec3, u: vec3):
        """Return the acceleration of a rod's lower end; ``acc``: without the Coriolis part."""
        return acc + growing(rope, u) if wp.static(giving) else acc

    @wp.func
    def rod(rope: Rope, i: int):
        """Return mass, centre of mass along n, and transverse inertia about the upper joint of rod
        i; those of the last one include the payload.
        """
        if i == L - 1:
            return rope.last_mass, rope.last_center, rope.last_inertia
        return rope.segment_mass, real(0.5) * rope.segment_length, rope.segment_inertia

    @wp.func
    def below(rope: Rope, i: int):
        """Return the mass below the lower joint of rod i [kg]; 0 for the last one."""
        if i == L - 1:
            return real(0.0)
        return rope.last_mass + real(float(L - 2 - i)) * rope.segment_mass

    return SimpleNamespace(
        with_load=with_load,
        upper_damping=upper_damping,
        centre_share=centre_share,
        tip=tip,
        rod=rod,
        below=below,
        segments=L,
        vec2=wp.types.vector(2, real),
    )


def build_stage(t: Types, rods: SimpleNamespace, extensions: frozenset[str], second: bool):
    """Build the recursion ``up`` from the last rod to the mount, at the state or, with ``second``,
    at the predicted state.
    """
    L = rods.segments
    real = t.real
    vec3 = t.vec3
    Vectors = t.Vectors
    vec2 = rods.vec2
    giving = "compliance" in extensions

    @wp.func
    def direction(n: Vectors, n2: Vectors, i: int):
        return n2[i] if wp.static(second) else n[i]

    @wp.func
    def rate(u: Vectors, k1: Vectors, h: real, i: int):
        return u[i] + h * k1[i] if wp.static(second) else u[i]

    @wp.func
    def up(
        rope: t.Rope,
        n: Vectors,
        u: Vectors,
        n2: Vectors,
        k1: Vectors,
        stiffness: t.Reals,
        root_rate_w: vec3,
        gravity: vec3,
        load: vec3,
        gamma: real,
        h: real,
        c1: Vectors,
        c2: Vectors,
        hs: wp.array(dtype=vec2),
    ):
        l = rope.segment_length
        l2 = l * l
        gh = gamma * h
        two = real(2.0)
        d = vec3()  # apparent mass of what hangs below: diagonal
        o = vec3()  # and off-diagonal (xy, xz, yz)
        b = vec3()
        ni = direction(n, n2, L - 1)
        ui = rate(u, k1, h, L - 1)
        spin = wp.cross(ni, ui)
        spin_below = spin  # no friction at the free end
        for step in range(L):
            i = L - 1 - step
            m, c, inertia = rods.rod(rope, i)
            n_above = ni
            u_above = ui
            spin_above = root_rate_w
            if i > 0:
                n_above = direction(n, n2, i - 1)
                u_above = rate(u, k1, h, i - 1)
                spin_above = wp.cross(n_above, u_above)
            couple = wp.cross(spin_above + spin_below, ni) - two * ui
            damping = rods.upper_damping(rope, i)
            if i < L - 1:
                damping += rope.joint_damping
            speed2 = wp.dot(ui, ui)
            tip_acc = -(l * speed2) * ni  # of the lower end, without the parts of a and beta
            f = m * gravity
            cm = c * m
            if wp.static(giving):
                if rope.compliance != real(0.0):  # lanes of a replay differ in it
                    growth = growing(rope, ui)
                    tip_acc += growth
                    f -= (m * rods.centre_share(rope, i)) * growth
            b += sym_mul(d, o, tip_acc)
            g = c * f - l * b + rope.joint_damping * couple
            if wp.static(second):
                g += (
                    gh * stiffness[i] * ui
                    + two * gh * (stiffness[i] * (two * gh - h) + damping) * k1[i]
                )
            else:
                g += -gh * stiffness[i] * ui
            g = rods.with_load(i, g, rope.payload_arm, load)
            if wp.static("mount_damping" in extensions):
                if i == 0:
                    g += rope.mount_damping * (wp.cross(root_rate_w, ni) - ui)
            e1, e2 = tangent_basis(ni)
            a_e1 = sym_mul(d, o, e1)
            a_e2 = sym_mul(d, o, e2)
            effective = inertia + gh * (damping + gh * stiffness[i])
            s11 = effective + l2 * wp.dot(e1, a_e1)
            s12 = l2 * wp.dot(e1, a_e2)
            s22 = effective + l2 * wp.dot(e2, a_e2)
            inv = real(1.0) / (s11 * s22 - s12 * s12)
            b1 = cm * e1 + l * a_e1
            b2 = cm * e2 + l * a_e2
            # multiplied by the determinant, so that the division is not waited for
            q1 = s22 * b1 - s12 * b2
            q2 = s11 * b2 - s12 * b1
            g1 = wp.dot(e1, g)
            g2 = wp.dot(e2, g)
            h1 = inv * (s22 * g1 - s12 * g2)
            h2 = inv * (s11 * g2 - s12 * g1)
            b += h1 * b1 + h2 * b2 - (cm * speed2) * ni - rods.with_load(i, f, real(1.0), load)
            d = d + vec3(m, m, m) - inv * (wp.cw_mul(b1, q1) + wp.cw_mul(b2, q2))
            o = o - inv * vec3(
                b1[0] * q1[1] + b2[0] * q2[1],
                b1[0] * q1[2] + b2[0] * q2[2],
                b1[1] * q1[2] + b2[1] * q2[2],
            )
            q1 *= inv
            q2 *= inv
            c1[i] = q1
            c2[i] = q2
            hs[i] = vec2(h1, h2)
            spin_below = spin
            spin = spin_above
            ni = n_above
            ui = u_above
        return d, o, b

    return up


def build_descent(t: Types, rods: SimpleNamespace, extensions: frozenset[str]):
    """Build ``down_first``, ``down_second`` and ``fall_back``, which advance the rods from the
    mount to the last one.
    """
    L = rods.segments
    real = t.real
    vec3 = t.vec3
    Vectors = t.Vectors
    Rope = t.Rope
    vec2 = rods.vec2
    giving = "compliance" in extensions

    @wp.func
    def acceleration(ni: vec3, ui: vec3, a: vec3, c1: vec3, c2: vec3, hs: vec2):
        """Return du/dt of a rod from the acceleration of its upper joint."""
        e1, e2 = tangent_basis(ni)
        return e1 * (hs[0] - wp.dot(c1, a)) + e2 * (hs[1] - wp.dot(c2, a)) - wp.dot(ui, ui) * ni

    @wp.func
    def down_first(
        rope: Rope,
        n: Vectors,
        u: Vectors,
        mount_acc_w: vec3,
        gamma: real,
        h: real,
        c1: Vectors,
        c2: Vectors,
        hs: wp.array(dtype=vec2),
        n2: Vectors,
        k1: Vectors,
    ):
        """Fill k1 and n2; return the largest squared rate [1/s^2] of the state and the predicted
        state.
        """
        a = mount_acc_w
        fastest = real(0.0)
        for i in range(L):
            ni = n[i]
            ui = u[i]
            k = acceleration(ni, ui, a, c1[i], c2[i], hs[i])
            u2 = ui + h * k
            k1[i] = k
            n2[i] = wp.normalize(ni + h * (ui + (gamma * h) * k))
            fastest = wp.max(fastest, wp.max(wp.dot(ui, ui), wp.dot(u2, u2)))
            a = rods.tip(rope, a + rope.segment_length * k, ui)
        return fastest

    @wp.func
    def down_second(
        rope: Rope,
        n: Vectors,
        u: Vectors,
        stiffness: t.Reals,
        mount_acc_w: vec3,
        mount_force_w: vec3,
        gravity: vec3,
        load: vec3,
        gamma: real,
        h: real,
        c1: Vectors,
        c2: Vectors,
        hs: wp.array(dtype=vec2),
        n2: Vectors,
        k1: Vectors,
    ):
        """Advance n, u and stiffness, and return the new momentum; ``mount_force_w``: force of the
        vehicle on the chain.
        """
        a = mount_acc_w
        pull = mount_force_w
        l = rope.segment_length
        gh = gamma * h
        half = real(0.5) * h
        total = vec3()
        for i in range(L):
            m, c, inertia = rods.rod(rope, i)
            ni = n2[i]
            old_u = u[i]
            first = k1[i]
            ui = old_u + h * first
            k = acceleration(ni, ui, a, c1[i], c2[i], hs[i])
            f = m * gravity
            centre = a + c * k
            if wp.static(giving):
                centre += rods.centre_share(rope, i) * growing(rope, ui)
            pull = pull + rods.with_load(i, f, real(1.0), load) - m * centre
            moment = rods.with_load(i, c * (f - m * a) - l * pull, rope.payload_arm, load)
            stiffness[i] = wp.max(wp.dot(ni, moment), real(0.0))
            a = rods.tip(rope, a + l * k, ui)
            new_n = wp.normalize(n[i] + half * (old_u + ui + gh * (k - first)))
            new_u = old_u + half * (first + k)
            new_u = new_u - new_n * wp.dot(new_n, new_u)
            n[i] = new_n
            u[i] = new_u
            total += (rods.below(rope, i) * l + c * m) * new_u
        return total

    @wp.func
    def fall_back(
        n: Vectors,
        u: Vectors,
        h: real,
        n2: Vectors,
        k1: Vectors,
    ):
        """Advance n and u by the first stage only (linearly implicit Euler), with unchanged
        stiffness.
        """
        for i in range(L):
            new_u = u[i] + h * k1[i]
            n[i] = n2[i]
            u[i] = new_u - n2[i] * wp.dot(n2[i], new_u)

    return down_first, down_second, fall_back


def build_chain(t: Types, segments: int, extensions: frozenset[str]) -> SimpleNamespace:
    """Build the recursion for a fixed number of segments.

    Args:
        t: types of the precision.
        segments: L.
        extensions: names of :data:`sim.kernels.structs.EXTENSIONS` to build in.

    Returns:
        Namespace of Warp functions. ``up_first``, ``up_second`` (last rod to mount: apparent mass
        and force of the whole chain at the mount, at the state and at the predicted state),
        ``down_first`` (mount to last rod: first stage k1 and predicted directions n2),
        ``down_second`` (new n, u and stiffness in place, and the new momentum), ``fall_back`` (the
        first stage only), ``payload`` (position and velocity of the payload's centre), ``speed``
        (that velocity [m/s] as predicted by ``k1``, which is zero before the first stage),
        ``momentum`` and ``com_velocity`` (linear momentum relative to the mount, velocity of the
        centre of mass), ``pull`` (tension at the mount), ``stretched(natural, before, stiffness, u,
        h)`` (the rope under its tension; ``before``: the rope h seconds before; h = 0: the length
        is constant).
    """
    L = segments
    real = t.real
    vec3 = t.vec3
    Vectors = t.Vectors
    Reals = t.Reals
    Rope = t.Rope
    giving = "compliance" in extensions
    rods = build_rods(t, segments, extensions)
    up_first = build_stage(t, rods, extensions, second=False)
    up_second = build_stage(t, rods, extensions, second=True)
    down_first, down_second, fall_back = build_descent(t, rods, extensions)

    @wp.func
    def payload(
        rope: Rope,
        mount_pos_w: vec3,
        mount_vel_w: vec3,
        n: Vectors,
        u: Vectors,
    ):
        pos = mount_pos_w
        vel = mount_vel_w
        for i in range(L):
            pos += rope.segment_length * n[i]
            vel += rope.segment_length * u[i]
            if wp.static(giving):
                vel += (rope.strain_rate * rope.segment_length) * n[i]
        return pos + rope.payload_offset * n[L - 1], vel + rope.payload_offset * u[L - 1]

    @wp.func
    def speed(rope: Rope, mount_vel_w: vec3, u: Vectors, k1: Vectors, h: real):
        vel = mount_vel_w
        for i in range(L):
            vel += rope.segment_length * (u[i] + h * k1[i])
        return vel + rope.payload_offset * (u[L - 1] + h * k1[L - 1])

    @wp.func
    def momentum(rope: Rope, u: Vectors):
        """Return the linear momentum [N s] of the chain in a frame that moves with the mount."""
        total = vec3()
        for i in range(L):
            m, c, inertia = rods.rod(rope, i)
            total += (rods.below(rope, i) * rope.segment_length + c * m) * u[i]
        return total

    @wp.func
    def com_velocity(rope: Rope, mount_vel_w: vec3, u: Vectors):
        """Return the velocity [m/s] of the centre of mass of rope and payload, world frame."""
        return mount_vel_w + momentum(rope, u) * (real(1.0) / rope.total_mass)

    @wp.func
    def pull(rope: Rope, stiffness: Reals, u: Vectors):
        """Return the tension [N] at the mount.

        With several rods it follows from the geometric stiffness of the first (tension times
        length), which neglects half of that rod's weight and centripetal force. With a single rod
        it is the weight of rod and payload along the rope plus their centripetal force."""
        if wp.static(L > 1):
            return stiffness[0] / rope.segment_length
        else:
            return stiffness[0] / rope.last_center + rope.last_mass * rope.last_center * wp.dot(
                u[0], u[0]
            )

    @wp.func
    def stretched(natural: Rope, before: Rope, stiffness: Reals, u: Vectors, h: real):
        if wp.static(giving):
            if natural.compliance != real(0.0):
                out = natural
                one = real(1.0)
                tension = wp.max(pull(before, stiffness, u), real(0.0))
                out.strain = (
                    natural.compliance * tension / (natural.segment_length * real(float(L)))
                )
                if h > real(0.0):
                    out.strain_rate = (out.strain - before.strain) / (h * (one + out.strain))
                out.segment_length = natural.segment_length * (one + out.strain)
                longer = out.segment_length - natural.segment_length
                rope_part = (
                    natural.segment_mass
                    * natural.segment_length
                    * natural.segment_length
                    / real(3.0)
                )
                out.segment_inertia = (
                    natural.segment_inertia * (one + out.strain) * (one + out.strain)
                )
                out.payload_arm = natural.payload_arm + longer
                out.last_center = natural.last_center + natural.stretched_share * longer
                ball = natural.payload_mass * (
                    out.payload_arm * out.payload_arm - natural.payload_arm * natural.payload_arm
                )
                out.last_inertia = (
                    natural.last_inertia
                    + rope_part * ((one + out.strain) * (one + out.strain) - one)
                    + ball
                )
                return out
        return before

    return SimpleNamespace(
        up_first=up_first,
        up_second=up_second,
        down_first=down_first,
        down_second=down_second,
        fall_back=fall_back,
        payload=payload,
        speed=speed,
        momentum=momentum,
        com_velocity=com_velocity,
        pull=pull,
        stretched=stretched,
        segments=L,
        vec2=rods.vec2,
    )

"""Simulate several vehicles, each with a cable to one load, as a tree of rods with the load at its
root.

Starting at the load, a cable is a chain of slender rods with a vehicle at its outer end. For an
acceleration a of its inner joint, every part requires a force ``A a + b`` there (equations:
:mod:`sim.kernels.rope.chain`). At the outermost joint A is the inverse of the mount's mobility, and
b is -A times the mount's acceleration without a cable. The sum over the cables yields the
acceleration of the load; a second pass yields those of rods and vehicles.

Integration: half a step of drift, accelerations in the middle, a step of kick, half a step of
drift. The accelerations are solved twice, the second time with the velocities in the middle.
``h / 2 D + h^2 / 4 K`` is added to a rod's inertia, with its damping D and its stiffness K under
the tension of the last step, so that a snap of the cable remains stable."""

from typing import Any

import warp as wp

from sim.kernels.quadrotor.rigid_body import angular_acceleration, quat_rate
from sim.kernels.rope.chain import tangent_basis
from sim.solvers import World


@wp.func
def vehicle_of(vehicles: Any, state: Any, row: int):
    p = vehicles[row % vehicles.shape[0]]
    p.body.mass = p.body.mass * state.mass_scale[row]
    return p


@wp.func
def diagonal(like: Any, x: Any):
    return wp.diag(type(like)(x, x, x))


@wp.func
def mobility(p: Any, rope: Any, rot: Any):
    """Return the matrix from a force at the mount to its acceleration, world frame [1/kg]."""
    one = type(p.body.mass)(1.0)
    arm = rot * wp.skew(rope.mount)
    inverse = wp.cw_div(type(rope.mount)(one, one, one), p.body.inertia)
    turning = arm * wp.diag(inverse) * wp.transpose(arm)
    return diagonal(rope.mount, one / p.body.mass) + turning


@wp.func
def free(p: Any, rope: Any, rot: Any, w: Any, force_b: Any, torque_b: Any, g: Any):
    """Return the acceleration of the mount without a cable, world frame."""
    turn = angular_acceleration(p, w, torque_b)
    spin = wp.cross(turn, rope.mount) + wp.cross(w, wp.cross(w, rope.mount))
    return rot * (force_b / p.body.mass + spin) + g


@wp.func
def damping_of(c: Any, n: Any, u: Any, neighbour_n: Any, neighbour_u: Any):
    """Return the damping of the joint to a neighbouring rod, as a generalised force on ``n' =
    u``.
    """
    return c * (wp.cross(wp.cross(neighbour_n, neighbour_u), n) - u)


class TreeSolver:
    """A solver of the bodies of W worlds for :class:`sim.solvers.Exchange`; row ``w * team + v`` is
    vehicle v of world w.

    A rope's ``payload_mass`` is the vehicle's share of the load. The load is a point mass at which
    all cables end. After separation the cable stays with the vehicle.

    Attributes:
        load_pos_w: positions of the loads [m], shape (W,) of vec3. load_vel_w: their velocities
            [m/s], shape (W,) of vec3.
    """

    capturable = True

    def __init__(self, world: World, team: int):
        self.world = world
        self.team = team
        self.worlds = world.count // team
        vec3 = world.types.vec3
        self.load_pos_w = wp.zeros(self.worlds, dtype=vec3, device=world.device)
        self.load_vel_w = wp.zeros_like(self.load_pos_w)
        self._place, self._advance = _kernels(world, team)

    def place(self, mask) -> None:
        w = self.world
        inputs = [w.state, mask, w.bodies, self.load_pos_w, self.load_vel_w]
        wp.launch(self._place, self.worlds, inputs, device=self.world.device)

    def advance(self, duration: float) -> None:
        w = self.world
        state = [w.state, self.load_pos_w, self.load_vel_w, w.bodies, w.wrench]
        inputs = [w.plants, duration, *state]
        wp.launch(self._advance, self.worlds, inputs, device=w.device, block_dim=64)


def _kernels(world: World, team: int) -> tuple[wp.Kernel, wp.Kernel]:
    """Return the kernels that place and advance the bodies, with one thread for each world."""
    t = world.types
    L = world.params.rope.segments
    V = team
    N = V * L
    real = t.real
    vec3 = t.vec3
    State = world.kernels.State
    Wrench = world.kernels.Wrench
    Bodies = world.kernels.Bodies

    @wp.kernel(module="unique", enable_backward=False)
    def place(
        # In:
        state: State,
        mask: wp.array(dtype=wp.int32),
        bodies: Bodies,
        # Out:
        load_pos: wp.array(dtype=vec3),
        load_vel: wp.array(dtype=vec3),
    ):
        world = wp.tid()
        for k in range(V):
            row = world * V + k
            if mask[row] != 0 and state.attached[row] != 0:
                load_pos[world] = bodies.payload_pos_w[row]
                load_vel[world] = bodies.payload_vel_w[row]

    @wp.func
    def rotation_after(bodies: Bodies, row: int, time: real):
        """Return the rotation of a vehicle after a time [s] at its present rate."""
        q = bodies.quat_wb[row]
        return wp.quat_to_matrix(wp.normalize(q + quat_rate(q, bodies.rate_b[row]) * time))

    # with loops unrolled it would take ten times as long to compile
    @wp.kernel(module="unique", enable_backward=False, module_options={"max_unroll": 1})
    def advance(
        # Params:
        plants: t.Plants,
        h: real,
        # State in:
        state: State,
        load_pos: wp.array(dtype=vec3),
        load_vel: wp.array(dtype=vec3),
        bodies: Bodies,
        # In:
        wrench: Wrench,
    ):
        world = wp.tid()
        ropes = plants.ropes
        g = plants.gravity_w
        half = real(0.5) * h
        first = world * V
        load_mass = real(0.0)
        n = wp.zeros(N, vec3)  # in the middle
        u = wp.zeros(N, vec3)
        swing = wp.zeros(N, vec3)  # second derivative of n
        c1 = wp.zeros(N, vec3)
        c2 = wp.zeros(N, vec3)
        h1 = wp.zeros(N, real)
        h2 = wp.zeros(N, real)
        turn = wp.zeros(V, vec3)  # angular acceleration, body frame
        for k in range(V):
            row = first + k
            load_mass += ropes[row % ropes.shape[0]].payload_mass
            for i in range(L):
                rate = bodies.cable_vel_w[i, row]
                rod = k * L + i
                n[rod] = wp.normalize(bodies.cable_dir_w[i, row] + half * rate)
                u[rod] = rate

        acc = vec3()
        for _ in range(2):
            A_all = diagonal(g, load_mass)
            b_all = -load_mass * g
            for k in range(V):
                row = first + k
                if state.attached[row] == 0:
                    continue
                p = vehicle_of(plants.vehicles, state, row)
                rope = ropes[row % ropes.shape[0]]
                m = rope.segment_mass
                length = rope.segment_length
                w = bodies.rate_b[row] + half * turn[k]
                rot = rotation_after(bodies, row, half)
                A = wp.inverse(mobility(p, rope, rot))
                b = -(A * free(p, rope, rot, w, wrench.force_b[row], wrench.torque_b[row], g))
                for i in range(L):
                    rod = k * L + i
                    d = -n[rod]
                    rate = -(u[rod] + half * swing[rod])
                    e1, e2 = tangent_basis(d)
                    a_d = A * d
                    a1 = A * e1
                    a2 = A * e2
                    c = real(0.5) * length
                    joint = rope.joint_damping
                    damping = vec3()
                    friction = real(0.0)
                    if i > 0:
                        damping += damping_of(joint, n[rod], u[rod], n[rod - 1], u[rod - 1])
                        friction += joint
                    if i < L - 1:
                        damping += damping_of(joint, n[rod], u[rod], n[rod + 1], u[rod + 1])
                        friction += joint
                    tension = wp.max(wp.dot(wrench.pull_w[row], n[rod]), real(0.0))
                    J = (
                        m * length * length / real(3.0)
                        + half * friction
                        + half * half * tension * length
                    )
                    s11 = J + length * length * wp.dot(e1, a1)
                    s12 = length * length * wp.dot(e1, a2)
                    s22 = J + length * length * wp.dot(e2, a2)
                    det = real(1.0) / (s11 * s22 - s12 * s12)
                    square = wp.dot(rate, rate)
                    push = (c * m) * g - length * b + (length * length * square) * a_d - damping
                    g1 = wp.dot(e1, push)
                    g2 = wp.dot(e2, push)
                    b1 = (c * m) * e1 + length * a1
                    b2 = (c * m) * e2 + length * a2
                    c1[rod] = det * (s22 * b1 - s12 * b2)
                    c2[rod] = det * (s11 * b2 - s12 * b1)
                    h1[rod] = det * (s22 * g1 - s12 * g2)
                    h2[rod] = det * (s11 * g2 - s12 * g1)
                    b = (
                        b
                        - m * g
                        - square * ((c * m) * d + length * a_d)
                        + h1[rod] * b1
                        + h2[rod] * b2
                    )
                    A = A + diagonal(g, m) - wp.outer(b1, c1[rod]) - wp.outer(b2, c2[rod])
                A_all += A
                b_all += b
            acc = -(wp.inverse(A_all) * b_all)

            for k in range(V):
                row = first + k
                if state.attached[row] == 0:
                    continue
                p = vehicle_of(plants.vehicles, state, row)
                rope = ropes[row % ropes.shape[0]]
                a = acc
                for j in range(L):
                    rod = k * L + (L - 1 - j)
                    d = -n[rod]
                    rate = u[rod] + half * swing[rod]
                    e1, e2 = tangent_basis(d)
                    beta = e1 * (h1[rod] - wp.dot(c1[rod], a)) + e2 * (h2[rod] - wp.dot(c2[rod], a))
                    outward = beta - wp.dot(rate, rate) * d
                    swing[rod] = -outward
                    a += rope.segment_length * outward
                w = bodies.rate_b[row] + half * turn[k]
                rot = rotation_after(bodies, row, half)
                torque = wrench.torque_b[row]
                lack = a - free(p, rope, rot, w, wrench.force_b[row], torque, g)
                pull = wp.inverse(mobility(p, rope, rot)) * lack
                torque += wp.cross(rope.mount, wp.transpose(rot) * pull)
                turn[k] = angular_acceleration(p, w, torque)

        vel = load_vel[world] + h * acc
        pos = load_pos[world] + half * (load_vel[world] + vel)
        load_pos[world] = pos
        load_vel[world] = vel
        for k in range(V):
            row = first + k
            bodies.payload_pos_w[row] = pos
            bodies.payload_vel_w[row] = vel
            if state.attached[row] == 0:
                continue
            rope = ropes[row % ropes.shape[0]]
            out_pos = pos
            out_vel = vel
            for i in range(L):
                rod = k * L + i
                rate = u[rod] + h * swing[rod]
                direction = wp.normalize(bodies.cable_dir_w[i, row] + half * (u[rod] + rate))
                rate = rate - direction * wp.dot(direction, rate)
                bodies.cable_dir_w[i, row] = direction
                bodies.cable_vel_w[i, row] = rate
                out_pos -= rope.segment_length * direction
                out_vel -= rope.segment_length * rate
            w = bodies.rate_b[row] + h * turn[k]
            mean = real(0.5) * (bodies.rate_b[row] + w)
            q = wp.normalize(bodies.quat_wb[row] + quat_rate(bodies.quat_wb[row], mean) * half)
            q = wp.normalize(bodies.quat_wb[row] + quat_rate(q, mean) * h)
            bodies.quat_wb[row] = q
            bodies.rate_b[row] = w
            bodies.pos_w[row] = out_pos - wp.quat_rotate(q, rope.mount)
            bodies.vel_w[row] = out_vel - wp.quat_rotate(q, wp.cross(w, rope.mount))

    return place, advance

"""The rope as rods on joints with two angles, for rigid-body engines."""

import warp as wp

from sim.kernels.runtime import Ints, unique_kernel
from sim.solvers import World

vec3 = wp.vec3f
quat = wp.quatf
Table = wp.array2d(dtype=float)

AXIAL_INERTIA = 1e-8
"""Inertia of a rod about its axis [kg m^2]. The joints transmit the vehicle's yaw, unlike a cord,
so it must be negligible for the vehicle; 1e-9 and 1e-10 give the same motion."""


@wp.func
def read(table: Table, row: int, column: int):
    """Return the vector in three columns of a row."""
    return vec3(table[row, column], table[row, column + 1], table[row, column + 2])


@wp.func
def write(table: Table, row: int, column: int, vector: vec3):
    """Write a vector to three columns of a row."""
    for k in range(3):
        table[row, column + k] = vector[k]


def build_place(world: World, hinges: bool) -> wp.Kernel:
    """Build the kernel that converts state arrays to an engine's coordinates where a mask is not 0.

    It writes poses (E, 7) and velocities (E, 6) of the roots, and joint angles and their rates
    (E, 2 L). A joint's two angles are a rotation vector in its x-y plane, and their rates are in
    this plane of the lower rod; quaternions are xyzw, angular velocities in the world frame. With
    ``hinges``, MuJoCo's convention, a rod is rotated about y, then about x; quaternions are wxyz
    and the roots' angular velocities in the body frame. Environment ``rows[r]`` has row r.
    """
    L = world.params.rope.segments
    State = world.kernels.State
    first = 1 if hinges else 0

    @wp.func
    def turned(d: vec3):
        """Return the joint's angles that rotate -z into a direction, and the rotation."""
        if wp.static(hinges):
            b = wp.asin(wp.clamp(d[1], -1.0, 1.0))
            a = wp.atan2(-d[0], -d[2])
            about_y = wp.quat_from_axis_angle(vec3(0.0, 1.0, 0.0), a)
            return a, b, about_y * wp.quat_from_axis_angle(vec3(1.0, 0.0, 0.0), b)
        else:
            axis = vec3(d[1], -d[0], 0.0)
            size = wp.length(axis)
            angle = wp.atan2(size, -d[2])
            axis = wp.normalize(axis)
            return axis[0] * angle, axis[1] * angle, wp.quat_from_axis_angle(axis, angle)

    @unique_kernel
    def place(
        # In:
        state: State,
        mask: Ints,
        rows: Ints,
        # Out:
        pose: Table,
        velocity: Table,
        angles: Table,
        rates: Table,
    ):
        row = wp.tid()
        env = rows[row]
        if mask[env] == 0:
            return
        q = state.quat_wb[env]
        rate_b = state.rate_b[env]
        w = wp.quat_rotate(q, rate_b)
        spin_root = w
        if wp.static(hinges):
            spin_root = rate_b
        write(pose, row, 0, state.pos_w[env])
        write(velocity, row, 0, state.vel_w[env])
        write(velocity, row, 3, spin_root)
        for k in range(4):
            pose[row, 3 + (k + first) % 4] = q[k]
        for i in range(L):
            n = state.cable_dir_w[i, env]
            u = state.cable_vel_w[i, env]
            x, y, turn = turned(wp.quat_rotate_inv(q, n))
            angles[row, 2 * i] = x
            angles[row, 2 * i + 1] = y
            above = wp.quat_rotate_inv(turn, wp.quat_rotate_inv(q, w))
            q = q * turn
            rate = wp.quat_rotate_inv(q, wp.cross(n, u)) - above
            spin = above[2]
            if wp.static(hinges):
                rates[row, 2 * i] = rate[1] / wp.cos(y)
                rates[row, 2 * i + 1] = rate[0]
                spin -= rate[1] * wp.tan(y)
            else:
                rates[row, 2 * i] = rate[0]
                rates[row, 2 * i + 1] = rate[1]
            w = wp.cross(n, u) - spin * n

    return place

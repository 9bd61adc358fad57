"""Start of an episode on the device: initialisation of the actuators, and the paper's
randomisation.

The release's lag is not drawn here: it is constant in a plant, and drawn with each vehicle of a
fleet (:mod:`sim.scaling.vehicle_class`).

Random numbers depend only on the seed, the environment and the number of its resets. So a masked
reset does not affect other environments, and an environment draws the same numbers in any batch."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from sim.kernels.quadrotor.steady_hover import build_steady_hover
from sim.kernels.runtime import Ints, unique_kernel
from sim.kernels.state import rope_of, vehicle_of
from sim.kernels.structs import Types
from sim.params import PlantParams


@dataclass(frozen=True)
class ResetKernels:
    """Kernels that start an episode."""

    place: wp.Kernel
    randomize: wp.Kernel


def build_reset(t: Types, params: PlantParams, State: type, hangs: bool) -> ResetKernels:
    """Build the reset kernels; ``hangs``: whether the vehicle carries a rope."""
    real = t.real
    vec3 = t.vec3
    Plants = t.Plants
    L = params.rope.segments
    set_steady_hover = build_steady_hover(t, params.vehicle, State)
    attached = int(hangs)
    x_axis, y_axis, z_axis = (vec3(*row) for row in np.eye(3))

    @wp.func
    def uniform(size: vec3, rng: wp.uint32):
        """Return uniform random numbers within +-``size``, and the generator's next state."""
        x = size[0] * real(wp.randf(rng, -1.0, 1.0))
        y = size[1] * real(wp.randf(rng, -1.0, 1.0))
        z = size[2] * real(wp.randf(rng, -1.0, 1.0))
        return vec3(x, y, z), rng

    @wp.func
    def settle(plants: Plants, state: State, env: int, used: real):
        """Set motors, controller, battery, queue, rope and release as in hover."""
        p = vehicle_of(plants, state, env)
        rope = rope_of(plants, env)
        gravity = plants.gravity
        mass = p.body.mass
        if wp.static(hangs):
            mass = mass + rope.total_mass
        set_steady_hover(p, state, env, mass * gravity, used)
        below = rope.last_mass * rope.last_center
        state.stiffness[L - 1, env] = below * gravity
        hanging = rope.last_mass
        for step in range(L - 1):
            i = L - 2 - step
            state.stiffness[i, env] = (
                (hanging + real(0.5) * rope.segment_mass) * rope.segment_length * gravity
            )
            hanging += rope.segment_mass
        state.release_timer[env] = real(-1.0)
        state.attached[env] = attached
        state.status[env] = 0

    @unique_kernel
    def place_kernel(
        # Params:
        plants: Plants,
        # State in:
        state: State,
        # In:
        mask: Ints,
        used: t.Reals,
    ):
        env = wp.tid()
        if mask[env] != 0:
            settle(plants, state, env, used[env])

    @unique_kernel
    def randomize_kernel(
        # Params:
        first: int,
        plants: Plants,
        spreads: wp.array(dtype=t.Randomization),
        seed: int,
        # State in:
        state: State,
        episode: Ints,
        # In:
        mask: Ints,
        # Out:
        goal_w: t.Vectors,
    ):
        env = wp.tid() + first
        if mask[env] != 0:
            z = spreads[0]
            rng = wp.rand_init(seed * 9781 + episode[env], env)
            episode[env] = episode[env] + 1
            degree = real(0.017453292519943295)
            offset, rng = uniform(z.position, rng)
            state.pos_w[env] = z.spawn_height * z_axis + offset
            vel, rng = uniform(z.velocity, rng)
            state.vel_w[env] = vel
            angles, rng = uniform(z.attitude_deg, rng)
            about_x = wp.quat_from_axis_angle(x_axis, angles[0] * degree)
            about_y = wp.quat_from_axis_angle(y_axis, angles[1] * degree)
            about_z = wp.quat_from_axis_angle(z_axis, angles[2] * degree)
            q = about_z * about_y * about_x
            state.quat_wb[env] = q
            rates, rng = uniform(z.rate_deg, rng)
            rate = rates * degree
            state.rate_b[env] = rate
            state.mass_scale[env] = real(1.0) + z.mass * real(wp.randf(rng, -1.0, 1.0))
            swings = vec3(z.cable_yaw_deg, z.cable_angle_deg, z.cable_rate_deg)
            cable, rng = uniform(swings, rng)
            tilt_rate = z.cable_rate_deg * real(wp.randf(rng, -1.0, 1.0)) * degree
            turn = wp.quat_from_axis_angle(z_axis, cable[0] * degree)
            tilt = wp.quat_from_axis_angle(x_axis, cable[1] * degree)
            down_b = wp.quat_rotate(turn * tilt, -z_axis)
            azimuth_rate_b = (cable[2] * degree) * z_axis
            rate_b = rate + azimuth_rate_b + tilt_rate * wp.quat_rotate(turn, x_axis)
            direction = wp.quat_rotate(q, down_b)
            swing = wp.quat_rotate(q, wp.cross(rate_b, down_b))
            for i in range(L):
                state.cable_dir_w[i, env] = direction
                state.cable_vel_w[i, env] = swing
            radius = z.goal_radius * wp.sqrt(real(wp.randf(rng)))
            angle = real(wp.randf(rng)) * real(6.283185307179586)
            goal_w[env] = vec3(radius * wp.cos(angle), radius * wp.sin(angle), real(0.0))
            settle(plants, state, env, real(wp.randf(rng)) * z.battery_used)

    return ResetKernels(place_kernel, randomize_kernel)

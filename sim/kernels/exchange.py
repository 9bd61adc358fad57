"""Kernels of a control step whose bodies an external solver advances.

As in the paper's simulator (Sec. III-B), the quadrotor's blocks compute one wrench per substep, the
solver advances the bodies, and the blocks then read the root's kinematics. All substeps have the
same length: a command acts from the first substep whose midpoint is not before its time, and the
time of a separation is interpolated within a substep. The wrench is that at the predicted midpoint
of the substep (second order). After the release, the vehicle flies without the solver."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import warp as wp

from sim.kernels import state as st
from sim.kernels.quadrotor.queue import command_at, push, split_delay
from sim.kernels.quadrotor.rigid_body import angular_acceleration
from sim.kernels.rope.payload import LOADS, hanging_force
from sim.kernels.runtime import Ints, unique_kernel
from sim.kernels.state import air_of, release_of, rope_of, vehicle_of
from sim.kernels.step import StepKernels
from sim.kernels.structs import Types
from sim.params import PlantParams

WRENCH_FIELDS = {
    "force_b": "vec3",
    "torque_b": "vec3",
    "load_w": "vec3",
    "pull_w": "vec3",
    "twist_b": "vec3",
}
"""Input of the solver, constant over a substep: force [N] and torque [N m] of the vehicle's blocks
about its centre of mass, body frame, without gravity; force of the air on the payload [N]. Also the
rope's force and torque on the vehicle in the last substep, used to predict the next midpoint."""

FLAG_FIELDS = {
    "moves": "int",
    "redrawn": "int",
}
"""Non-zero: the plant moves in this step; the solver's bodies are set to its state after the step.
"""

BODY_FIELDS = {
    "pos_w": "vec3",
    "quat_wb": "quat",
    "vel_w": "vec3",
    "rate_b": "vec3",
    "cable_dir_w": "vec3[]",
    "cable_vel_w": "vec3[]",
    "payload_pos_w": "vec3",
    "payload_vel_w": "vec3",
}
"""State of the solver's bodies: root, rope segments, payload's centre."""


def build_body_access(t: Types, segments: int):
    """Return Warp functions ``load_bodies(bodies, env, s, n, u) -> s`` and
    ``store_bodies(bodies, env, s, n, u, payload_pos, payload_vel)``, which copy a struct of
    :data:`BODY_FIELDS` to a vehicle's state with local arrays of its rope, and back.
    """
    QuadState = t.QuadState
    vec3 = t.vec3
    Vectors = t.Vectors

    @wp.func
    def load_bodies(bodies: Any, env: int, s: QuadState, n: Vectors, u: Vectors):
        out = s
        out.pos_w = bodies.pos_w[env]
        out.quat_wb = bodies.quat_wb[env]
        out.vel_w = bodies.vel_w[env]
        out.rate_b = bodies.rate_b[env]
        for i in range(segments):
            n[i] = bodies.cable_dir_w[i, env]
            u[i] = bodies.cable_vel_w[i, env]
        return out

    @wp.func
    def store_bodies(
        bodies: Any, env: int, s: QuadState, n: Vectors, u: Vectors, pos: vec3, vel: vec3
    ):
        bodies.pos_w[env] = s.pos_w
        bodies.quat_wb[env] = s.quat_wb
        bodies.vel_w[env] = s.vel_w
        bodies.rate_b[env] = s.rate_b
        for i in range(segments):
            bodies.cable_dir_w[i, env] = n[i]
            bodies.cable_vel_w[i, env] = u[i]
        bodies.payload_pos_w[env] = pos
        bodies.payload_vel_w[env] = vel

    return load_bodies, store_bodies


@dataclass(frozen=True)
class ExchangeKernels:
    """Kernels of one build and the structs that they take."""

    begin: wp.Kernel
    wrench: wp.Kernel
    take: wp.Kernel
    end: wp.Kernel
    show: wp.Kernel
    payload: wp.Kernel
    State: type
    Flags: type
    Wrench: type
    Bodies: type


def build_bodies(t: Types, parts: SimpleNamespace, segments: int):
    """Return the structs ``Wrench`` and ``Bodies``, ``load_bodies`` of :func:`build_body_access`,
    the kernel that copies the plant's state to the bodies, and the kernel that outputs the payload.
    """
    vec3 = t.vec3
    L = segments
    State = parts.State
    Wrench = st.array_struct(t, "Wrench", WRENCH_FIELDS)
    Bodies = st.array_struct(t, "Bodies", BODY_FIELDS)
    load_bodies, store_bodies = build_body_access(t, L)

    @unique_kernel
    def show_kernel(
        # Params:
        first: int,
        plants: t.Plants,
        # In:
        state: State,
        mask: Ints,
        # Out:
        bodies: Bodies,
        wrench: Wrench,
    ):
        """Copy the state to the bodies; the payload's state follows from the rope."""
        env = wp.tid() + first
        if mask[env] == 0:
            return
        n = wp.zeros(L, vec3)
        u = wp.zeros(L, vec3)
        s = load_bodies(state, env, parts.load(state, env), n, u)
        pos, vel = parts.coupled.payload(rope_of(plants, env), s, n, u)
        store_bodies(bodies, env, s, n, u, pos, vel)
        wrench.pull_w[env] = vec3()
        wrench.twist_b[env] = vec3()

    @unique_kernel
    def payload_kernel(
        # Params:
        first: int,
        # State in:
        state: State,
        # In:
        bodies: Bodies,
        # Out:
        out: parts.Output,
    ):
        env = wp.tid() + first
        if state.attached[env] != 0:
            out.payload_pos_w[env] = bodies.payload_pos_w[env]
            out.payload_vel_w[env] = bodies.payload_vel_w[env]

    return Wrench, Bodies, load_bodies, show_kernel, payload_kernel


def build_exchange(
    t: Types, params: PlantParams, step: StepKernels, extensions: frozenset[str]
) -> ExchangeKernels:
    """Build the kernels from the parts of the fused step of the same plant and ``extensions``."""
    real = t.real
    zero = real(0.0)
    vec3 = t.vec3
    L = params.rope.segments
    loaded = bool(extensions & LOADS)
    parts = step.parts
    State = step.State
    Input = step.Input
    Output = step.Output
    load = parts.load
    store = parts.store
    Wrench, Bodies, load_bodies, show_kernel, payload_kernel = build_bodies(t, parts, L)
    flow = parts.flow
    advance = parts.advance
    Flags = st.array_struct(t, "Flags", FLAG_FIELDS)
    nonfinite = st.NONFINITE
    limit = real(st.SPEED_LIMIT)
    Plants = t.Plants
    tiny = real(1.0e-6)

    @unique_kernel
    def begin_kernel(
        # Params:
        first: int,
        plants: Plants,
        # State in:
        state: State,
        # In:
        inputs: Input,
        # Out:
        flags: Flags,
        out: Output,
    ):
        """Queue the command, and start the release's timer if the release is commanded."""
        env = wp.tid() + first
        flags.moves[env] = inputs.mask[env]
        flags.redrawn[env] = 0
        if inputs.mask[env] == 0:
            flags.redrawn[env] = state.attached[env]
            return
        state.status[env] = 0
        if not push(state.queue, env, inputs.command[env]):
            state.status[env] = nonfinite
        out.separated[env] = 0
        if (
            inputs.release[env] != 0
            and state.release_timer[env] < zero
            and state.attached[env] != 0
        ):
            state.release_timer[env] = release_of(plants, env).lag

    @unique_kernel
    def wrench_kernel(
        # Params:
        first: int,
        plants: Plants,
        time: real,
        h: real,
        # State in:
        state: State,
        flags: Flags,
        # In:
        out: Output,
        # Out:
        wrench: Wrench,
    ):
        """Advance the internal states of the blocks from ``time`` on, and write the wrench at the
        midpoint.
        """
        env = wp.tid() + first
        wrench.force_b[env] = vec3()
        wrench.torque_b[env] = vec3()
        wrench.load_w[env] = vec3()
        if flags.moves[env] == 0:
            return
        p = vehicle_of(plants, state, env)
        rope = rope_of(plants, env)
        half = real(0.5) * h
        n = wp.zeros(L, vec3)
        u = wp.zeros(L, vec3)
        stiffness = wp.zeros(L, real)
        parts.load_rope(state, env, n, u, stiffness)
        whole, switch = split_delay(p, plants.control_period)
        active, _until = command_at(
            state.queue, env, whole, switch, time + half, plants.control_period
        )
        s = load(state, env)
        law_factors = parts.laws.on(
            p, rope, air_of(plants, state, env), s, n, u, stiffness, active, state.attached[env]
        )
        if state.attached[env] == 0:
            s = parts.coupled.step_alone(p, law_factors, s, active, plants.gravity_w, h)
            if st.size(s) < limit:
                store(state, env, s)
            else:
                state.status[env] = state.status[env] | nonfinite
                flags.moves[env] = 0
            return
        f = flow(p, law_factors, s, active)
        force_w = wp.quat_rotate(s.quat_wb, f.force_b) + wrench.pull_w[env]
        f.vel_w = force_w / p.body.mass + plants.gravity_w
        f.rate_b = angular_acceleration(p, s.rate_b, f.torque_b + wrench.twist_b[env])
        middle = advance(s, f, half)
        f = flow(p, law_factors, middle, active)
        wrench.force_b[env] = f.force_b
        wrench.torque_b[env] = f.torque_b
        if wp.static(loaded):
            jet = wp.quat_rotate(s.quat_wb, vec3(zero, zero, -f.force_b[2]))
            wrench.load_w[env] = hanging_force(
                rope, law_factors, out.payload_vel_w[env], n[L - 1], jet
            )
        after = advance(s, f, h)
        state.motor_speed[env] = after.motor_speed
        state.integral[env] = after.integral
        state.setpoint[env] = after.setpoint
        state.gyro[env] = after.gyro
        state.charge_used[env] = after.charge_used
        state.voltage[env] = after.voltage

    @unique_kernel
    def take_kernel(
        # Params:
        first: int,
        plants: Plants,
        time: real,
        h: real,
        # State in:
        state: State,
        flags: Flags,
        wrench: Wrench,
        # In:
        bodies: Bodies,
        # Out:
        out: Output,
    ):
        """Read the bodies after the solver's substep of h seconds, which ends at ``time``, and
        separate the payload if its timer has elapsed.
        """
        env = wp.tid() + first
        if flags.moves[env] == 0 or state.attached[env] == 0:
            return
        pos = bodies.payload_pos_w[env]
        vel = bodies.payload_vel_w[env]
        n = wp.zeros(L, vec3)
        u = wp.zeros(L, vec3)
        s = load_bodies(bodies, env, load(state, env), n, u)
        size = st.size(s) + parts.rope_size(u, n) + wp.length(vel) + wp.length(pos) * real(1.0e-3)
        if not size < limit:
            state.status[env] = state.status[env] | nonfinite
            flags.moves[env] = 0
            flags.redrawn[env] = 1
            return
        body = vehicle_of(plants, state, env).body
        mean_b = real(0.5) * (s.rate_b + state.rate_b[env])
        body_force_w = wp.quat_rotate(state.quat_wb[env], wrench.force_b[env])
        acc = (s.vel_w - state.vel_w[env]) / h - plants.gravity_w
        wrench.pull_w[env] = body.mass * acc - body_force_w
        momentum = wp.cw_mul(body.inertia, (s.rate_b - state.rate_b[env]) / h)
        gyroscopic = wp.cross(mean_b, wp.cw_mul(body.inertia, mean_b))
        wrench.twist_b[env] = momentum + gyroscopic - wrench.torque_b[env]
        store(state, env, s)
        for i in range(L):
            state.cable_dir_w[i, env] = n[i]
            state.cable_vel_w[i, env] = u[i]
        timer = state.release_timer[env]
        if timer >= zero and time > timer - tiny:
            one = real(1.0)
            part = wp.clamp((timer - (time - h)) / h, zero, one)
            before = out.payload_vel_w[env]
            # backwards from the end with the acceleration between the ends
            remaining_time = (one - part) * h
            acc = (vel - before) / h
            parts.depart(
                rope_of(plants, env),
                release_of(plants, env),
                air_of(plants, state, env),
                s,
                pos - remaining_time * vel + (real(0.5) * remaining_time * remaining_time) * acc,
                vel - remaining_time * acc,
                n[L - 1],
                plants.gravity,
                out,
                env,
                wp.max(timer, zero),
            )
            state.attached[env] = 0
        else:
            out.payload_pos_w[env] = pos
            out.payload_vel_w[env] = vel

    @unique_kernel
    def end_kernel(
        # Params:
        first: int,
        plants: Plants,
        # State in:
        state: State,
        # In:
        inputs: Input,
        out: Output,
    ):
        env = wp.tid() + first
        if inputs.mask[env] == 0:
            return
        if state.release_timer[env] >= zero:
            state.release_timer[env] = wp.max(
                state.release_timer[env] - plants.control_period, zero
            )
        if state.attached[env] != 0:
            s = load(state, env)
            n = wp.zeros(L, vec3)
            for i in range(L):
                n[i] = state.cable_dir_w[i, env]
            p = vehicle_of(plants, state, env)
            hazard_bits = parts.hazards(p, rope_of(plants, env), s, n, out.payload_pos_w[env])
            state.status[env] = state.status[env] | hazard_bits

    return ExchangeKernels(
        begin_kernel,
        wrench_kernel,
        take_kernel,
        end_kernel,
        show_kernel,
        payload_kernel,
        State,
        Flags,
        Wrench,
        Bodies,
    )

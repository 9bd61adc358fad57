"""The fused control step: one kernel with the command queue, blocks, chain, release and checks of
one control period.

``build_step`` composes the functions of the chosen blocks into the kernel. It has one thread per
environment and no atomics. The same kernel runs on CUDA and on the CPU, there also in pieces that
begin at environment ``first``."""

from dataclasses import dataclass
from types import SimpleNamespace

import warp as wp

from sim.kernels import state as st
from sim.kernels.laws import build_laws
from sim.kernels.quadrotor.queue import command_at, push, split_delay
from sim.kernels.quadrotor.rigid_body import (
    build_direct_flow,
    build_flow,
    mount_position,
    mount_velocity,
)
from sim.kernels.rope import release as rel
from sim.kernels.rope.chain import build_chain
from sim.kernels.rope.coupling import build_coupled_step
from sim.kernels.rope.payload import build_flight
from sim.kernels.runtime import unique_kernel
from sim.kernels.state import air_of, release_of, rope_of, vehicle_of
from sim.kernels.structs import Types
from sim.params import PlantParams


@dataclass(frozen=True)
class StepKernels:
    """Kernels of one build and the structs that they take."""

    step: wp.Kernel
    payload: wp.Kernel
    foresee: wp.Kernel
    State: type
    Input: type
    Output: type
    parts: SimpleNamespace


def build_parts(
    t: Types,
    params: PlantParams,
    direct: bool,
    extensions: frozenset[str],
    motors: bool,
    integrator: str,
) -> SimpleNamespace:
    """Compose the functions that step kernels share; arguments as of :func:`build_step`.

    Returns a namespace of the structs ``State``, ``Input`` and ``Output`` and of Warp functions:
    the blocks' ``flow`` and ``advance``; the namespaces ``chain``, ``coupled`` and ``laws``;
    ``load``, ``store``, ``load_rope``, ``store_rope``, ``rope_size`` and ``hazards``; ``depart``,
    which writes the outputs of a separation."""
    real = t.real
    vec3 = t.vec3
    Vectors = t.Vectors
    Rope = t.Rope
    QuadState = t.QuadState
    L = params.rope.segments
    State = st.array_struct(t, "State", st.STATE_FIELDS)
    Input = st.array_struct(t, "Input", st.INPUT_FIELDS)
    Output = st.array_struct(t, "Output", st.OUTPUT_FIELDS)
    flow, advance = build_flow(t, params.vehicle, extensions, motors)
    if direct:
        flow = build_direct_flow(t)
    chain = build_chain(t, L, extensions)
    coupled = build_coupled_step(t, flow, advance, chain, extensions, integrator)
    laws = build_laws(t, params.laws, flow, chain)
    through_air = bool({"payload_drag", "payload_spin"} & extensions) or any(
        law.block == "payload force" for law in params.laws
    )
    ballistic = rel.build_ballistic(t, build_flight(t, laws), through_air)
    load, store = st.build_access(t, State)
    load_rope, store_rope = st.build_rope_access(t, L)

    @wp.func
    def rope_size(u: Vectors, n: Vectors):
        """Return the sum of the norms of the rope's state."""
        total = real(0.0)
        for i in range(L):
            total += wp.length(u[i]) * real(1.0e-1) + wp.length(n[i])
        return total

    @wp.func
    def hazards(p: t.Vehicle, rope: Rope, s: QuadState, n: Vectors, payload_pos: vec3):
        """Return status bits: the payload hits the vehicle; a joint of the rope is within a
        propeller disc, taken as 2 cm thick."""
        status = int(0)
        if wp.length(payload_pos - s.pos_w) < rope.payload_radius + p.collision_radius:
            status = st.COLLISION
        point = rope.mount
        for i in range(L):
            point += rope.segment_length * wp.quat_rotate_inv(s.quat_wb, n[i])
            if wp.abs(point[2] - p.rotors.z) < real(0.01):
                for j in range(4):
                    dx = point[0] - p.rotors.x[j]
                    dy = point[1] - p.rotors.y[j]
                    if dx * dx + dy * dy < p.rotors.radius * p.rotors.radius:
                        status = status | st.ROPE_IN_ROTOR
        return status

    @wp.func
    def depart(
        rope: Rope,
        r: t.Release,
        air: t.Air,
        s: QuadState,
        pos: vec3,
        vel: vec3,
        direction_w: vec3,
        gravity: real,
        out: Output,
        env: int,
        elapsed: real,
    ):
        """Write the outputs of a separation; ``vel``: of the payload before the kick."""
        vel = rel.kick(r, vel, direction_w)
        time = ballistic.time_to_height(rope, air, pos, vel, r.landing_height, gravity)
        out.payload_pos_w[env] = pos
        out.payload_vel_w[env] = vel
        out.separated[env] = 1
        out.landing_w[env] = ballistic.after(rope, air, pos, vel, gravity, time)
        out.time_to_impact[env] = time
        out.clearance[env] = ballistic.clearance(
            rope, air, pos, vel, gravity, time, s.pos_w, r.clearance_samples
        )
        out.separation_time[env] = elapsed
        out.release_pos_w[env] = s.pos_w

    return SimpleNamespace(
        State=State,
        Input=Input,
        Output=Output,
        flow=flow,
        advance=advance,
        chain=chain,
        coupled=coupled,
        laws=laws,
        load=load,
        store=store,
        load_rope=load_rope,
        store_rope=store_rope,
        rope_size=rope_size,
        hazards=hazards,
        depart=depart,
    )


def build_step(
    t: Types,
    params: PlantParams,
    direct: bool,
    extensions: frozenset[str],
    motors: bool,
    integrator: str,
) -> StepKernels:
    """Compose the kernel for the kinds and the number of segments of ``params``.

    Args:
        t: types of the precision.
        params: only kinds and number of segments are used; the kernel reads all numbers at run
            time.
        direct: bypass the blocks; see :func:`sim.kernels.quadrotor.rigid_body.build_direct_flow`.
        extensions: names of :data:`sim.kernels.structs.EXTENSIONS` to build in; the others cost
            nothing.
        motors: bypass the rate controller: commands are motor-speed set-points [rad/s].
        integrator: of a vehicle without payload.
    """
    real = t.real
    zero = real(0.0)
    vec3 = t.vec3
    Vectors = t.Vectors
    Plants = t.Plants
    L = params.rope.segments
    nonfinite = st.NONFINITE
    parts = build_parts(t, params, direct, extensions, motors, integrator)
    State = parts.State
    Input = parts.Input
    Output = parts.Output
    chain = parts.chain
    coupled = parts.coupled
    load = parts.load
    load_rope = parts.load_rope
    limit = real(st.SPEED_LIMIT)

    @wp.func
    def separate(
        rope: t.Rope,
        r: t.Release,
        air: t.Air,
        s: t.QuadState,
        n: Vectors,
        u: Vectors,
        gravity: real,
        out: Output,
        env: int,
        elapsed: real,
    ):
        """Write the outputs of a separation at this state."""
        mount = mount_position(rope, s)
        mount_vel = mount_velocity(rope, s)
        pos, vel = chain.payload(rope, mount, mount_vel, n, u)
        vel = rel.tail(r, vel, chain.com_velocity(rope, mount_vel, u))
        parts.depart(rope, r, air, s, pos, vel, n[L - 1], gravity, out, env, elapsed)

    @unique_kernel
    def step_kernel(
        # Params:
        first: int,
        plants: Plants,
        # State in:
        state: State,
        # In:
        inputs: Input,
        # Out:
        out: Output,
    ):
        env = wp.tid() + first
        if inputs.mask[env] == 0:
            return
        p = vehicle_of(plants, state, env)
        natural = rope_of(plants, env)
        r = release_of(plants, env)
        air = air_of(plants, state, env)
        period = plants.control_period
        gravity = plants.gravity
        n = wp.zeros(L, vec3)
        u = wp.zeros(L, vec3)
        stiffness = wp.zeros(L, real)
        load_rope(state, env, n, u, stiffness)
        rope = chain.stretched(natural, natural, stiffness, u, zero)
        s = load(state, env)

        taken = push(state.queue, env, inputs.command[env])
        whole, switch = split_delay(p, period)
        timer = state.release_timer[env]
        attached = state.attached[env]
        if inputs.release[env] != 0 and timer < zero and attached != 0:
            timer = rel.lag(r, rope, chain.pull(rope, stiffness, u), gravity)
        tiny = real(1.0e-6)
        status = int(0)
        if not taken:
            status = status | nonfinite
        out.separated[env] = 0

        total = coupled.momentum(p, rope, s, u)
        time = real(0.0)
        if attached != 0 and timer >= zero and timer < tiny:
            separate(rope, r, air, s, n, u, gravity, out, env, time)
            attached = int(0)
        while time < period - tiny:
            active, until = command_at(state.queue, env, whole, switch, time, period)
            if attached != 0 and timer > time + tiny:
                until = wp.min(until, timer)
            count = int(wp.ceil((until - time) / plants.substep - real(1.0e-3)))
            h = (until - time) / real(float(count))
            for k in range(count):
                if attached != 0:
                    rope = chain.stretched(natural, rope, stiffness, u, h)
                law_factors = parts.laws.on(p, rope, air, s, n, u, stiffness, active, attached)
                if attached != 0:
                    s, total, fell_back = coupled.step(
                        p,
                        rope,
                        law_factors,
                        s,
                        total,
                        active,
                        n,
                        u,
                        stiffness,
                        plants.gravity_w,
                        plants.gamma,
                        plants.max_turn,
                        h,
                    )
                    if fell_back:
                        status = status | st.FALLBACK
                else:
                    s = coupled.step_alone(p, law_factors, s, active, plants.gravity_w, h)
            time = until
            if attached != 0 and timer >= zero and time > timer - tiny:
                separate(rope, r, air, s, n, u, gravity, out, env, time)
                attached = int(0)

        if timer >= zero:
            timer = wp.max(timer - period, zero)
        state.release_timer[env] = timer
        state.attached[env] = attached
        if st.size(s) + parts.rope_size(u, n) < limit:  # false for NaN
            parts.store(state, env, s)
            parts.store_rope(state, env, n, u, stiffness)
        else:
            status = status | nonfinite
            s = load(state, env)
            load_rope(state, env, n, u, stiffness)
        if attached != 0:
            pos, vel = coupled.payload(rope, s, n, u)
            out.payload_pos_w[env] = pos
            out.payload_vel_w[env] = vel
            status = status | parts.hazards(p, rope, s, n, pos)
        state.status[env] = status

    @unique_kernel
    def payload_kernel(
        # Params:
        first: int,
        plants: Plants,
        # State in:
        state: State,
        # Out:
        out: Output,
    ):
        env = wp.tid() + first
        natural = rope_of(plants, env)
        s = load(state, env)
        n = wp.zeros(L, vec3)
        u = wp.zeros(L, vec3)
        stiffness = wp.zeros(L, real)
        load_rope(state, env, n, u, stiffness)
        rope = chain.stretched(natural, natural, stiffness, u, zero)
        if state.attached[env] != 0:
            pos, vel = coupled.payload(rope, s, n, u)
            out.payload_pos_w[env] = pos
            out.payload_vel_w[env] = vel

    @unique_kernel
    def foresee_kernel(
        # Params:
        first: int,
        plants: Plants,
        # State in:
        state: State,
        # Out:
        out: Output,
    ):
        env = first + wp.tid()
        natural = rope_of(plants, env)
        n = wp.zeros(L, vec3)
        u = wp.zeros(L, vec3)
        stiffness = wp.zeros(L, real)
        load_rope(state, env, n, u, stiffness)
        rope = chain.stretched(natural, natural, stiffness, u, zero)
        s = load(state, env)
        r = release_of(plants, env)
        air = air_of(plants, state, env)
        separate(rope, r, air, s, n, u, plants.gravity, out, env, zero)

    return StepKernels(step_kernel, payload_kernel, foresee_kernel, State, Input, Output, parts)

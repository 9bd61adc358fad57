"""Solver that runs the fused kernel's chain through the exchange, to measure the exchange's
cost.
"""

import warp as wp

from sim.kernels.exchange import build_body_access
from sim.kernels.quadrotor.rigid_body import advance, quat_rate
from sim.kernels.rope.chain import build_chain
from sim.kernels.rope.coupling import build_coupled_step
from sim.kernels.runtime import unique_kernel
from sim.kernels.state import rope_of, vehicle_of
from sim.kernels.structs import extensions_of
from sim.solvers import World


class ChainSolver:
    """The batched simulator's own rope."""

    capturable = True

    def __init__(self, world: World):
        self.world = world
        self._kernel = _kernel(world)

    def place(self, mask) -> None:
        """Do nothing: the bodies are in the state's arrays."""

    def advance(self, duration: float) -> None:
        w = self.world
        inputs = [w.plants, duration, w.state, w.bodies, w.wrench]
        wp.launch(self._kernel, w.count, inputs, device=w.device, block_dim=64)


def _kernel(world: World) -> wp.Kernel:
    """Build the kernel that advances the bodies of a world."""
    t = world.types
    L = world.params.rope.segments
    real = t.real
    vec3 = t.vec3
    vec4 = t.vec4
    Air = t.Air
    QuadState = t.QuadState
    State = world.kernels.State
    Wrench = world.kernels.Wrench
    Bodies = world.kernels.Bodies
    extensions = extensions_of(world.ropes) | {"push"}
    load_bodies, store_bodies = build_body_access(t, L)

    @wp.func
    def flow(p: t.Vehicle, air: Air, s: QuadState, command: vec4):
        """Return the exchanged wrench, which ``air`` holds with its force in the body frame."""
        out = t.QuadRate()
        out.pos_w = s.vel_w
        out.quat_wb = quat_rate(s.quat_wb, s.rate_b)
        out.force_b = air.push_w
        out.torque_b = air.twist_b
        return out

    chain = build_chain(t, L, extensions)

    @wp.func
    def hanging(rope: t.Rope, air: Air, vel_w: vec3, along_w: vec3, jet_w: vec3):
        return air.payload_push_w

    coupled = build_coupled_step(t, flow, advance, chain, extensions, hanging=hanging)

    @unique_kernel
    def advance_kernel(
        # Params:
        plants: t.Plants,
        h: real,
        # State in:
        state: State,
        bodies: Bodies,
        # In:
        wrench: Wrench,
    ):
        env = wp.tid()
        p = vehicle_of(plants, state, env)
        rope = rope_of(plants, env)
        air = Air()
        air.push_w = wrench.force_b[env]
        air.twist_b = wrench.torque_b[env]
        air.payload_push_w = wrench.load_w[env]
        n = wp.zeros(L, vec3)
        u = wp.zeros(L, vec3)
        k = wp.zeros(L, real)
        s = load_bodies(bodies, env, QuadState(), n, u)
        for i in range(L):
            k[i] = state.stiffness[i, env]
        s, _total, _fell_back = coupled.step(
            p,
            rope,
            air,
            s,
            coupled.momentum(p, rope, s, u),
            vec4(),
            n,
            u,
            k,
            plants.gravity_w,
            plants.gamma,
            plants.max_turn,
            h,
        )
        for i in range(L):
            if wp.isfinite(k[i]):
                state.stiffness[i, env] = k[i]
        pos, vel = coupled.payload(rope, s, n, u)
        store_bodies(bodies, env, s, n, u, pos, vel)

    return advance_kernel

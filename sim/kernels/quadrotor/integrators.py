"""Integration step of a quadrotor without payload: Euler, Heun or RK4.

Source: Hairer, Norsett, Wanner, *Solving Ordinary Differential Equations I*, II.1 (Heun's method,
and the classical method of order 4)."""

from typing import Any

import warp as wp

from sim.kernels.quadrotor.rigid_body import angular_acceleration, blend
from sim.kernels.structs import Types


def build_quad_step(t: Types, flow, advance, integrator: str):
    """Return the function ``step(p, air, s, command, gravity, h) -> state`` of an integrator."""
    real = t.real

    @wp.func
    def slope(p: Any, air: Any, s: Any, command: Any, gravity: Any):
        """Return the derivative of the state."""
        r = flow(p, air, s, command)
        inv_mass = real(1.0) / p.body.mass
        r.vel_w = inv_mass * wp.quat_rotate(s.quat_wb, r.force_b) + gravity
        r.rate_b = angular_acceleration(p, s.rate_b, r.torque_b)
        return r

    @wp.func
    def euler(p: Any, air: Any, s: Any, command: Any, gravity: Any, h: real):
        return advance(s, slope(p, air, s, command, gravity), h)

    @wp.func
    def heun(p: Any, air: Any, s: Any, command: Any, gravity: Any, h: real):
        half = real(0.5)
        r1 = slope(p, air, s, command, gravity)
        r2 = slope(p, air, advance(s, r1, h), command, gravity)
        return advance(s, blend(r2, half, r1, half), h)

    @wp.func
    def rk4(p: Any, air: Any, s: Any, command: Any, gravity: Any, h: real):
        half = real(0.5)
        one = real(1.0)
        r1 = slope(p, air, s, command, gravity)
        r2 = slope(p, air, advance(s, r1, half * h), command, gravity)
        r3 = slope(p, air, advance(s, r2, half * h), command, gravity)
        r4 = slope(p, air, advance(s, r3, h), command, gravity)
        outer = blend(r4, one, r1, one)
        inner = blend(r2, one, r3, one)
        return advance(s, blend(outer, one / real(6.0), inner, one / real(3.0)), h)

    return {"euler": euler, "heun": heun, "rk4": rk4}[integrator]

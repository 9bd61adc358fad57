"""One integration step of a quadrotor that carries nothing: Euler, Heun or RK4.

Source: Hairer, Norsett, Wanner, *Solving Ordinary Differential Equations I*, II.1 (Heun's method,
and the classical method of order 4)."""

import warp as wp

from sim.kernels.quadrotor.rigid_body import advance, angular_acceleration, blend
from sim.kernels.structs import Types


def build_quad_step(t: Types, flow, rate, motor_advance, integrator: str = "heun"):
    """Return ``step(p, air, s, command, gravity, h) -> state`` of one integrator."""
    Vehicle = t.Vehicle
    Air = t.Air
    QuadState = t.QuadState
    vec3 = t.vec3
    vec4 = t.vec4
    real = t.real

    @wp.func
    def slope(p: Vehicle, air: Air, s: QuadState, command: vec4, gravity: vec3):
        """Derivative of the state, and the motor speeds that act."""
        f = flow(p, air, s, command)
        inv_mass = real(1.0) / p.body.mass
        acc = inv_mass * wp.quat_rotate(s.quat_wb, f.force_b) + gravity
        turn = angular_acceleration(p, s.rate_b, f.torque_b)
        return rate(p, s, f, acc, turn), f.motor_speed

    @wp.func
    def euler(p: Vehicle, air: Air, s: QuadState, command: vec4, gravity: vec3, h: real):
        r, acting = slope(p, air, s, command, gravity)
        out = advance(s, r, h)
        out.motor_speed = motor_advance(out.motor_speed, acting)
        return out

    @wp.func
    def heun(p: Vehicle, air: Air, s: QuadState, command: vec4, gravity: vec3, h: real):
        r1, acting1 = slope(p, air, s, command, gravity)
        s2 = advance(s, r1, h)
        s2.motor_speed = motor_advance(s2.motor_speed, acting1)
        r2, acting = slope(p, air, s2, command, gravity)
        out = advance(s, blend(r1, real(0.5), r2, real(0.5)), h)
        out.motor_speed = motor_advance(out.motor_speed, acting)
        return out

    @wp.func
    def rk4(p: Vehicle, air: Air, s: QuadState, command: vec4, gravity: vec3, h: real):
        half = real(0.5)
        one = real(1.0)
        r1, _a1 = slope(p, air, s, command, gravity)
        r2, _a2 = slope(p, air, advance(s, r1, half * h), command, gravity)
        r3, _a3 = slope(p, air, advance(s, r2, half * h), command, gravity)
        r4, acting = slope(p, air, advance(s, r3, h), command, gravity)
        outer = blend(r1, one, r4, one)
        inner = blend(r2, one, r3, one)
        out = advance(s, blend(outer, one / real(6.0), inner, one / real(3.0)), h)
        out.motor_speed = motor_advance(out.motor_speed, acting)
        return out

    return {"euler": euler, "heun": heun, "rk4": rk4}[integrator]

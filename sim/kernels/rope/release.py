"""Release and ballistic flight: closed-form landing, time to impact, clearance to the vehicle.

Source: the paper, Sec. III-B (projectile without drag) and Eq. 5 (clearance at K fractions of the
flight). Equations of the release: :class:`sim.params.ReleaseParams`."""

from types import SimpleNamespace
from typing import Any

import warp as wp

from sim.kernels.structs import Types

FLIGHT_STEP = 0.02
"""Largest step of a flight with drag [s]. After one second, the error of a tennis ball's path by
RK4 is 1e-8 m (tested).
"""
# largest number of steps until the landing
FLIGHT_STEPS = 500


@wp.func
def time_to_height(rope: Any, air: Any, pos_w: Any, vel_w: Any, height: Any, gravity: Any):
    """Return the time [s] at which a projectile descends to ``height`` [m]; ``gravity``: magnitude
    [m/s^2].

    If it never reaches the height, the result is the time of its apex, at least 0. ``rope`` and
    ``air`` are not used here, but by the functions with drag (:func:`build_ballistic`)."""
    zero = height - height
    two = type(height)(2.0)
    root = wp.max(vel_w[2] * vel_w[2] + two * gravity * (pos_w[2] - height), zero)
    return wp.max((vel_w[2] + wp.sqrt(root)) / gravity, zero)


@wp.func
def projectile(rope: Any, air: Any, pos_w: Any, vel_w: Any, gravity: Any, time: Any):
    """Return the position [m] after ``time`` [s] of free flight, world frame, z up."""
    fall = type(time)(0.5) * gravity * time * time
    return pos_w + time * vel_w - type(pos_w)(time - time, time - time, fall)


@wp.func
def clearance(
    rope: Any,
    air: Any,
    pos_w: Any,
    vel_w: Any,
    gravity: Any,
    time: Any,
    vehicle_w: Any,
    samples: int,
):
    """Return the smallest distance [m] from a point, at ``samples`` equally spaced times from 0 to
    ``time``.
    """
    nearest = wp.length(pos_w - vehicle_w)
    for k in range(1, samples):
        s = time * type(time)(float(k)) / type(time)(float(samples - 1))
        nearest = wp.min(
            nearest, wp.length(projectile(rope, air, pos_w, vel_w, gravity, s) - vehicle_w)
        )
    return nearest


@wp.func
def lag(r: Any, rope: Any, pull: Any, gravity: Any):
    """Return the time [s] from the latch to the separation; ``pull``: tension at the latch [N]."""
    excess = pull - rope.payload_mass * gravity
    return wp.max(r.lag + r.lag_tension * excess, gravity - gravity)


@wp.func
def kick(r: Any, vel_w: Any, along_w: Any):
    """Return the velocity of the payload after the release; ``along_w``: direction of the last
    segment.
    """
    return vel_w + r.kick_w + r.kick_along * along_w


@wp.func
def tail(r: Any, vel_w: Any, com_vel_w: Any):
    """Return the velocity of a payload that leaves with a share of the rope; ``com_vel_w``: of the
    centre of mass of rope and payload.
    """
    return vel_w + r.rope_tail * (com_vel_w - vel_w)


def build_step_in_flight(t: Types, acceleration):
    """Return ``step(rope, air, pos_w, vel_w, gravity_w, h)``: position and velocity of the payload
    alone after h seconds, by RK4.

    Args:
        t: types of the precision.
        acceleration: ``(rope, air, vel_w, gravity_w)`` -> [m/s^2], world frame.
    """
    real = t.real

    @wp.func
    def step(rope: Any, air: Any, pos_w: Any, vel_w: Any, gravity_w: Any, h: real):
        half = real(0.5) * h
        a1 = acceleration(rope, air, vel_w, gravity_w)
        v2 = vel_w + half * a1
        a2 = acceleration(rope, air, v2, gravity_w)
        v3 = vel_w + half * a2
        a3 = acceleration(rope, air, v3, gravity_w)
        v4 = vel_w + h * a3
        a4 = acceleration(rope, air, v4, gravity_w)
        sixth = h / real(6.0)
        two = real(2.0)
        return pos_w + sixth * (vel_w + two * v2 + two * v3 + v4), vel_w + sixth * (
            a1 + two * a2 + two * a3 + a4
        )

    return step


def build_ballistic(t: Types, acceleration, dragging: bool) -> SimpleNamespace:
    """Build the flight of the payload alone: in closed form, or by RK4 with forces of the air.

    Args:
        t: types of the precision.
        acceleration: ``(rope, air, vel_w, gravity)`` -> [m/s^2], world frame.
        dragging: whether the air acts on the payload.

    Returns:
        Namespace of Warp functions ``time_to_height(rope, air, pos, vel, height, gravity)`` [s],
        ``after(rope, air, pos, vel, gravity, time)`` [m], ``clearance(rope, air, pos, vel, gravity,
        time, vehicle_w, samples)`` [m], each with the arguments of the functions of the same names
        in this module.
    """
    if not dragging:
        return SimpleNamespace(time_to_height=time_to_height, after=projectile, clearance=clearance)
    real = t.real
    zero = real(0.0)
    vec3 = t.vec3
    Rope = t.Rope
    Air = t.Air
    step = build_step_in_flight(t, acceleration)

    @wp.func
    def fly(rope: Rope, air: Air, pos_w: vec3, vel_w: vec3, gravity: real, h: real):
        return step(rope, air, pos_w, vel_w, vec3(zero, zero, -gravity), h)

    @wp.func
    def after(rope: Rope, air: Air, pos_w: vec3, vel_w: vec3, gravity: real, time: real):
        count = int(wp.ceil(wp.max(time, zero) / real(FLIGHT_STEP)))
        pos = pos_w
        vel = vel_w
        for _ in range(count):
            pos, vel = fly(rope, air, pos, vel, gravity, time / real(float(count)))
        return pos

    @wp.func
    def drag_time(rope: Rope, air: Air, pos_w: vec3, vel_w: vec3, height: real, gravity: real):
        """Step until the height is passed, then use Newton's method from the start of the last
        step.
        """
        pos = pos_w
        vel = vel_w
        h = real(FLIGHT_STEP)
        time = real(0.0)
        next_pos, next_vel = fly(rope, air, pos, vel, gravity, h)
        count = int(0)
        while (next_pos[2] > height or next_vel[2] > zero) and count < FLIGHT_STEPS:
            pos = next_pos
            vel = next_vel
            time = time + h
            count = count + 1
            next_pos, next_vel = fly(rope, air, pos, vel, gravity, h)
        share = time_to_height(rope, air, pos, vel, height, gravity)
        for _ in range(3):
            next_pos, next_vel = fly(rope, air, pos, vel, gravity, share)
            if next_vel[2] < zero:
                share = wp.max(share - (next_pos[2] - height) / next_vel[2], zero)
        return time + share

    @wp.func
    def drag_clearance(
        rope: Rope,
        air: Air,
        pos_w: vec3,
        vel_w: vec3,
        gravity: real,
        time: real,
        vehicle_w: vec3,
        samples: int,
    ):
        nearest = wp.length(pos_w - vehicle_w)
        pos = pos_w
        vel = vel_w
        h = time / real(float(samples - 1))
        for _ in range(samples - 1):
            pos, vel = fly(rope, air, pos, vel, gravity, h)
            nearest = wp.min(nearest, wp.length(pos - vehicle_w))
        return nearest

    return SimpleNamespace(time_to_height=drag_time, after=after, clearance=drag_clearance)

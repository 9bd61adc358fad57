"""Simulated measurements at the recorded stamps: cubic interpolation within a step, and the model
of the sensors.

Equations of delays, frames and markers: :class:`sim.params.SensingParams`.
"""

from dataclasses import dataclass
from typing import Any

import warp as wp

from sim.kernels.quadrotor.rigid_body import quat_rate
from sim.kernels.structs import Types, make_struct


@wp.func
def rotation_of_vector(like: Any, vector: Any):
    """Return the quaternion of a rotation vector [rad], of the type of ``like``."""
    angle = wp.length(vector)
    half = type(angle)(0.5) * angle
    scale = type(angle)(0.5)
    if angle > type(angle)(1.0e-9):
        scale = wp.sin(half) / angle
    return type(like)(vector[0] * scale, vector[1] * scale, vector[2] * scale, wp.cos(half))


@wp.func
def vector_of_rotation(like: Any, quat: Any):
    """Return the shortest rotation vector [rad] of a unit quaternion, of the type of ``like``."""
    one = type(quat[3])(1.0)
    sign = one
    if quat[3] < quat[3] - quat[3]:
        sign = -one
    axis = type(like)(quat[0] * sign, quat[1] * sign, quat[2] * sign)
    sine = wp.length(axis)
    scale = type(sine)(2.0)
    if sine > type(sine)(1.0e-9):
        scale = type(sine)(2.0) * wp.atan2(sine, quat[3] * sign) / sine
    return axis * scale


@wp.func
def cubic(a: Any, rate_a: Any, b: Any, rate_b: Any, s: Any, h: Any):
    """Evaluate the cubic through two states, h seconds apart, with their derivatives.

    ``s``: 0 at the first state, 1 at the second."""
    way = b - a
    rest = type(s)(1.0) - s
    return a + way * s + ((rate_a * h - way) * rest - (rate_b * h - way) * s) * (s * rest)


@wp.func
def see_pose(x: Any, com: Any, pos_w: Any, quat_wb: Any, reference: Any):
    """Return the measured position [m] of a vehicle's marker body, and its attitude relative to the
    quaternion ``reference`` as a rotation vector [rad]; ``com``: centre of mass.
    """
    frame = rotation_of_vector(quat_wb, x.frame_tilt)
    point = pos_w + wp.quat_rotate(quat_wb, x.marker_offset - com)
    quat_measured = frame * quat_wb * rotation_of_vector(quat_wb, x.marker_rotation)
    turn = vector_of_rotation(pos_w, wp.quat_inverse(reference) * quat_measured)
    return (type(x.scale)(1.0) + x.scale) * wp.quat_rotate(frame, point), turn


@wp.func
def see_point(x: Any, like: Any, pos_w: Any):
    """Return the measured position of the payload [m]."""
    frame = rotation_of_vector(like, x.frame_tilt)
    return (type(x.scale)(1.0) + x.scale) * wp.quat_rotate(frame, pos_w + x.payload_offset)


@dataclass(frozen=True)
class Sampling:
    """Functions of :func:`build_sampling` and the structs that they take."""

    sample: wp.Function
    copy_samples: wp.Function
    Moment: type  # a lane in flight
    Steps: type  # start, end and length of a step [s], and the lane's state at its start
    # number of sampled stamps of each sensor, and time of the state that the next stamp shows [s]
    Pointers: type


def build_sampling(t: Types, Sensing: type, Windows: type, Data: type, Ball: type) -> Sampling:
    """Build the functions that a lane calls at the end of each step.

    Args:
        t: types of the precision.
        Sensing, Windows, Data, Ball: structs of the replay.
    """
    real = t.real
    vec3 = t.vec3
    Pointers = make_struct(
        "Pointers", {"vehicle": wp.int32, "payload": wp.int32, "gyro": wp.int32, "due": real}
    )
    body = {"quad": t.QuadState, "pay": vec3, "pay_vel": vec3}
    Steps = make_struct("Steps", body | dict.fromkeys(("t0", "t1", "h"), real))
    release = {"rope": t.Rope, "ball": Ball, "total": vec3, "before": vec3, "at": Pointers}
    times = dict.fromkeys(("time", "separation", "slack_first", "slack_last"), real)
    flags = dict.fromkeys(("mode", "latched", "knot", "slack"), wp.int32)
    Moment = make_struct("Moment", body | release | times | flags)

    @wp.func
    def late(x: Sensing, windows: Windows, w: int, stamp: real, delay: real):
        """Return the time of the state that a stamp shows [s]."""
        return stamp - delay - x.clock_rate * (stamp - windows.clock_zero[w])

    @wp.func
    def sample(
        p: t.Vehicle,
        x: Sensing,
        data: Data,
        windows: Windows,
        w: int,
        k: Steps,
        m: Moment,
        last: bool,
        pointers: Pointers,
        out: wp.array2d(dtype=vec3),
        lane: int,
    ):
        """Write the measurements at all stamps within a step; the window's last step also writes
        the remaining ones.
        """
        pointers_after = pointers
        pointers_after.due = windows.end[w]
        vehicles = windows.vehicle_count[w]
        payloads = windows.payload_count[w]
        span = k.h
        while pointers_after.vehicle < vehicles:
            i = windows.vehicle_first[w] + pointers_after.vehicle
            time = late(x, windows, w, data.vehicle_time[i], x.vehicle_delay)
            if time > k.t1 and not last:
                pointers_after.due = wp.min(pointers_after.due, time)
                break
            s = (time - k.t0) / span
            pos = cubic(k.quad.pos_w, k.quad.vel_w, m.quad.pos_w, m.quad.vel_w, s, span)
            rate = quat_rate(k.quad.quat_wb, k.quad.rate_b)
            next_rate = quat_rate(m.quad.quat_wb, m.quad.rate_b)
            q = wp.normalize(cubic(k.quad.quat_wb, rate, m.quad.quat_wb, next_rate, s, span))
            place, turn = see_pose(x, p.body.com, pos, q, data.vehicle_quat[i])
            out[2 * pointers_after.vehicle, lane] = place
            out[2 * pointers_after.vehicle + 1, lane] = turn
            pointers_after.vehicle = pointers_after.vehicle + 1
        while pointers_after.payload < payloads:
            stamp = data.payload_time[windows.payload_first[w] + pointers_after.payload]
            time = late(x, windows, w, stamp, x.payload_delay)
            if time > k.t1 and not last:
                pointers_after.due = wp.min(pointers_after.due, time)
                break
            s = (time - k.t0) / span
            pos = cubic(k.pay, k.pay_vel, m.pay, m.pay_vel, s, span)
            out[2 * vehicles + pointers_after.payload, lane] = see_point(x, k.quad.quat_wb, pos)
            pointers_after.payload = pointers_after.payload + 1
        while pointers_after.gyro < windows.gyro_count[w]:
            stamp = data.gyro_time[windows.gyro_first[w] + pointers_after.gyro]
            time = late(x, windows, w, stamp, x.gyro_delay)
            if time > k.t1 and not last:
                pointers_after.due = wp.min(pointers_after.due, time)
                break
            s = (time - k.t0) / span
            old = k.quad.rate_b
            change = m.quad.rate_b - old
            bend = change - (old - m.before)  # a parabola through three ends of steps
            turning = old + s * change - real(0.5) * s * (real(1.0) - s) * bend
            out[2 * vehicles + payloads + pointers_after.gyro, lane] = turning + x.gyro_bias
            pointers_after.gyro = pointers_after.gyro + 1
        return pointers_after

    @wp.func
    def copy_samples(
        windows: Windows,
        w: int,
        pointers: Pointers,
        parent: int,
        lane: int,
        out: wp.array2d(dtype=vec3),
    ):
        """Copy the samples of the parent up to the point at which a lane continues it."""
        vehicles = windows.vehicle_count[w]
        for i in range(2 * pointers.vehicle):
            out[i, lane] = out[i, parent]
        for i in range(2 * vehicles, 2 * vehicles + pointers.payload):
            out[i, lane] = out[i, parent]
        first = 2 * vehicles + windows.payload_count[w]
        for i in range(first, first + pointers.gyro):
            out[i, lane] = out[i, parent]

    return Sampling(sample, copy_samples, Moment, Steps, Pointers)

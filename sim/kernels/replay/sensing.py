"""What sensors make of the state: delays, frames, markers. Equations: :class:`sim.params.SensingParams`."""

from typing import Any

import warp as wp

from sim.kernels.structs import Types


@wp.func
def rotation_of_vector(like: Any, vector: Any):
    """Quaternion (of the type of ``like``) of a rotation vector [rad]."""
    angle = wp.length(vector)
    half = type(angle)(0.5) * angle
    scale = type(angle)(0.5)
    if angle > type(angle)(1.0e-9):
        scale = wp.sin(half) / angle
    return type(like)(vector[0] * scale, vector[1] * scale, vector[2] * scale, wp.cos(half))


@wp.func
def vector_of_rotation(like: Any, quat: Any):
    """Rotation vector [rad] (of the type of ``like``) of a unit quaternion, the shorter way round."""
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


def build_sensing(t: Types, Sensing: type):
    """Warp functions of the measurement model.

    Returns ``pose(sensing, com, pos_w, quat_wb, reference)`` -> measured position of the marker body [m] and its attitude against the
    quaternion ``reference`` as a rotation vector [rad]; ``point(sensing, pos_w)`` -> measured position of the payload [m]; ``rate(sensing,
    rate_b)`` [rad/s].
    """
    vec3, quat, real = t.vec3, t.quat, t.real

    @wp.func
    def pose(x: Sensing, com: vec3, pos_w: vec3, quat_wb: quat, reference: quat):
        frame = rotation_of_vector(quat_wb, x.frame_tilt)
        point = pos_w + wp.quat_rotate(quat_wb, x.marker_offset - com)
        seen = frame * quat_wb * rotation_of_vector(quat_wb, x.marker_rotation)
        turn = wp.quat_inverse(reference) * seen
        return (real(1.0) + x.scale) * wp.quat_rotate(frame, point), vector_of_rotation(pos_w, turn)

    @wp.func
    def point(x: Sensing, like: quat, pos_w: vec3):
        return (real(1.0) + x.scale) * wp.quat_rotate(rotation_of_vector(like, x.frame_tilt), pos_w + x.payload_offset)

    @wp.func
    def rate(x: Sensing, rate_b: vec3):
        return rate_b + x.gyro_bias

    return pose, point, rate

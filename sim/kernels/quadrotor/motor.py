"""Motor model. Equations: :class:`sim.params.MotorParams`.

``motor_rate`` gives the speed that acts now and its derivative; ``motor_advance`` the speed after a
step of two derivatives (first-order motor) or the set-point itself (instantaneous motor)."""

from typing import Any

import warp as wp


@wp.func
def motor_rate_first_order(p: Any, speed: Any, target: Any):
    """Speed [rad/s] and its derivative [rad/s^2], each of shape (4,)."""
    return speed, (target - speed) / p.motor.time_constant


@wp.func
def motor_rate_asymmetric(p: Any, speed: Any, target: Any):
    """Speed [rad/s] and its derivative [rad/s^2], each of shape (4,): slower or faster where the
    rotor slows down.
    """
    rate = (target - speed) / p.motor.time_constant
    for i in range(4):
        if target[i] < speed[i]:
            rate[i] = (target[i] - speed[i]) / p.motor.time_constant_down
    return speed, rate


@wp.func
def motor_rate_instant(p: Any, speed: Any, target: Any):
    """Speed [rad/s] and its derivative, each of shape (4,): the set-point, at once."""
    return target, target - target


@wp.func
def motor_advance_first_order(integrated: Any, acting: Any):
    """Speed [rad/s] after a step: the integrated one."""
    return integrated


@wp.func
def motor_advance_instant(integrated: Any, acting: Any):
    """Speed [rad/s] after a step: the one that acted last."""
    return acting

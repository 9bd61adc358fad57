"""Motor model. Equations: :class:`sim.params.MotorParams`.

``motor_rate`` gives the speed that acts now and its derivative. An instantaneous motor has none: a
step ends with the speed that acted last."""

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

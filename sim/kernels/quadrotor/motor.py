"""Motor model. Equations: :class:`sim.params.MotorParams`.

Each function returns the acting speed and its derivative. The speed of an instantaneous motor has
no derivative: a step ends with the speed that acted last."""

from typing import Any

import warp as wp


@wp.func
def motor_rate_first_order(p: Any, speed: Any, target: Any):
    """Return the speed [rad/s] and its derivative [rad/s^2], each of shape (4,)."""
    return speed, (target - speed) / p.motor.time_constant


@wp.func
def motor_rate_asymmetric(p: Any, speed: Any, target: Any):
    """Return the speed [rad/s] and its derivative [rad/s^2], each of shape (4,), with another time
    constant for rotors that slow down.
    """
    rate = (target - speed) / p.motor.time_constant
    for i in range(4):
        if target[i] < speed[i]:
            rate[i] = (target[i] - speed[i]) / p.motor.time_constant_down
    return speed, rate


@wp.func
def motor_rate_instant(p: Any, speed: Any, target: Any):
    """Return the set-point [rad/s] and a zero derivative, each of shape (4,)."""
    return target, target - target

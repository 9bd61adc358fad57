"""Release and ballistic flight: closed-form landing, time to impact, clearance to the vehicle.

Source: the paper, Sec. III-B (projectile without drag) and Eq. 5 (clearance at K fractions of the flight).
"""

from typing import Any

import warp as wp


@wp.func
def time_to_height(pos_w: Any, vel_w: Any, height: Any, gravity: Any):
    """Time [s] at which a projectile comes down to ``height`` [m]; 0 where it never reaches it.

    Args:
        gravity: magnitude [m/s^2].
    """
    zero = height - height
    two = type(height)(2.0)
    root = wp.max(vel_w[2] * vel_w[2] + two * gravity * (pos_w[2] - height), zero)
    return wp.max((vel_w[2] + wp.sqrt(root)) / gravity, zero)


@wp.func
def projectile(pos_w: Any, vel_w: Any, gravity: Any, time: Any):
    """Position [m] after ``time`` of free flight, world frame, z up."""
    fall = type(time)(0.5) * gravity * time * time
    return pos_w + time * vel_w - type(pos_w)(time - time, time - time, fall)


@wp.func
def clearance(pos_w: Any, vel_w: Any, gravity: Any, time: Any, vehicle_w: Any, samples: int):
    """Least distance [m] of the flight to a point, at ``samples`` equal fractions of ``time`` from 0 to 1."""
    least = wp.length(pos_w - vehicle_w)
    for k in range(1, samples):
        s = time * type(time)(float(k)) / type(time)(float(samples - 1))
        least = wp.min(least, wp.length(projectile(pos_w, vel_w, gravity, s) - vehicle_w))
    return least

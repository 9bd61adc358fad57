"""Command queue: a continuous delay of the zero-order-held command.

Convention: the newest command is first; slot j holds the command that was sent j control periods
ago. With ``delay = whole * period + rest``, the command of slot ``whole + 1`` acts until the time
``rest`` of the period, and that of slot ``whole`` from then on. A substep ends exactly there, so
the delay is not rounded to substeps."""

import math
from typing import Any

import warp as wp


def queue_depth(delay: float, period: float) -> int:
    """Return the number of slots that a delay needs. Raises ValueError if it is negative or not
    finite.
    """
    if not (math.isfinite(delay) and delay >= 0):
        raise ValueError(f"command delay {delay} s; expected 0 or more")
    return int(math.floor(delay / period + 1e-6)) + 2


@wp.func
def split_delay(p: Any, period: Any):
    """Split the delay into a number of whole periods and the rest [s]; a rest below a microsecond
    is 0.
    """
    tiny = type(period)(1.0e-6)
    whole = wp.floor(p.queue.delay / period + tiny / period)
    remainder = p.queue.delay - whole * period
    if remainder < tiny:
        remainder = period - period
    return int(whole), remainder


@wp.func
def command_at(
    queue: wp.array2d(dtype=Any), env: int, whole: int, switch: Any, time: Any, period: Any
):
    """Return the command that acts at a time in a control period [s], and the time until which it
    acts [s]; ``whole`` and ``switch`` are from `split_delay`.
    """
    slot = whole
    until = period
    if time < switch - type(period)(1.0e-6):
        slot = whole + 1
        until = wp.min(period, switch)
    return queue[wp.min(slot, queue.shape[0] - 1), env], until


@wp.func
def push(queue: wp.array2d(dtype=Any), env: int, command: Any):
    """Insert a command into slot 0 of an environment's queue, shape (D, E); the others move by one
    slot.

    Returns whether the command is finite. If it is not, the last command is held instead."""
    depth = queue.shape[0]
    for k in range(depth - 1):
        queue[depth - 1 - k, env] = queue[depth - 2 - k, env]
    taken = wp.isfinite(command)
    if taken:
        queue[0, env] = command
    return taken

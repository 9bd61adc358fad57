"""Command queue: a continuous delay of the zero-order-held command.

Convention: commands stand newest first; slot j holds the command that the policy gave j control
periods ago. With ``delay = whole * period + rest`` the command of slot ``whole + 1`` acts until
``rest`` into the period, that of slot ``whole`` from then on. The step ends a substep exactly
there, so the delay is exact, not rounded to substeps."""

import math
from typing import Any

import warp as wp


def queue_depth(delay: float, period: float) -> int:
    """Slots that a delay needs. Raises ValueError for a negative or non-finite one."""
    if not (math.isfinite(delay) and delay >= 0):
        raise ValueError(f"command delay {delay} s; expected 0 or more")
    return int(math.floor(delay / period + 1e-6)) + 2


@wp.func
def split_delay(p: Any, period: Any):
    """Split the delay into whole periods and the rest [s]; a rest below a microsecond counts as
    none.
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
    """The command that acts at a time of a control period [s], and until when [s]; ``whole`` and
    ``switch`` are of `split_delay`.
    """
    slot = whole
    until = period
    if time < switch - type(period)(1.0e-6):
        slot = whole + 1
        until = wp.min(period, switch)
    return queue[wp.min(slot, queue.shape[0] - 1), env], until


@wp.func
def push(queue: wp.array2d(dtype=Any), env: int, command: Any):
    """Put a command into slot 0 of an environment's queue, shape (D, E); the others move on by one.

    Returns whether the command was finite. One that is not is left out: the last one is held in its
    place."""
    depth = queue.shape[0]
    for k in range(depth - 1):
        queue[depth - 1 - k, env] = queue[depth - 2 - k, env]
    taken = wp.isfinite(command)
    if taken:
        queue[0, env] = command
    return taken

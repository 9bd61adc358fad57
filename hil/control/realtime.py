"""Real-time priority and locked memory, so that ticks are on time.

Both need rights: ``setcap cap_sys_nice,cap_ipc_lock+ep`` on the interpreter, or ``rtprio`` and
``memlock`` in ``/etc/security/limits.conf``. If the system refuses one of them, the run reports it
and continues without."""

import ctypes
import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated

from visthrow.config.bounds import Bound, Bounded

# interval after which Python switches threads [s]; its default, 5 ms, is a quarter of a tick
SWITCH = 5e-4
# flags of mlockall(2)
LOCK_CURRENT = 1
LOCK_FUTURE = 2


@dataclass(frozen=True)
class RealtimeParams(Bounded):
    """Parameters of the real-time scheduling."""

    priority: Annotated[int, Bound(0, 99)] = 0  # of SCHED_FIFO, 1 to 99; 0: no real-time priority
    lock_memory: bool = False  # whether all pages of the process stay in memory


@contextmanager
def pause_garbage_collection() -> Iterator[None]:
    """Exclude all present objects from garbage collection and disable automatic collections; the
    caller collects.
    """
    was = gc.isenabled()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.unfreeze()
        if was:
            gc.enable()


def prepare(params: RealtimeParams) -> list[str]:
    """Request priority and locked memory for this thread and those that it starts later; return
    texts of what was refused, and why.

    The network runs on one thread, because more would wait for each other. Threads switch often, so
    that the recorder's thread soon yields to the control loop."""
    import torch

    torch.set_num_threads(1)
    sys.setswitchinterval(SWITCH)
    refused = []
    if params.lock_memory:
        try:
            libc = ctypes.CDLL(None, use_errno=True)
            if libc.mlockall(LOCK_CURRENT | LOCK_FUTURE):
                refused.append(f"memory is not locked: {os.strerror(ctypes.get_errno())}")
        except (OSError, AttributeError) as error:
            refused.append(f"memory is not locked: {error}")
    if params.priority:
        refused += _schedule(params.priority, 0)
    return refused


def keep(params: RealtimeParams) -> list[str]:
    """Prevent threads and processes that are started later from inheriting the priority; return as
    :func:`prepare` does.
    """
    return _schedule(params.priority, os.SCHED_RESET_ON_FORK) if params.priority else []


def _schedule(priority: int, flag: int) -> list[str]:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | flag, os.sched_param(priority))
    except (OSError, AttributeError) as error:  # no permission, or no such call on this system
        return [f"no real-time priority: {error}"]
    return []

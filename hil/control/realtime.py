"""What a system can be asked for, so that ticks come in time: a real-time priority, and memory that
stays in memory.

Both need rights: ``setcap cap_sys_nice,cap_ipc_lock+ep`` on the interpreter, or ``rtprio`` and
``memlock`` in ``/etc/security/limits.conf``. What is not granted is said, and the run goes on
without it."""

import ctypes
import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated

from visthrow.config.bounds import Bound, Bounded

# after which one thread gives way to another [s]; Python's 5 ms are a quarter of a tick
SWITCH = 5e-4
# flags of mlockall(2)
LOCK_CURRENT = 1
LOCK_FUTURE = 2


@dataclass(frozen=True)
class RealtimeParams(Bounded):
    """Parameters of the real-time scheduling."""

    priority: Annotated[int, Bound(0, 99)] = 0  # of SCHED_FIFO, 1 to 99; 0: as any process
    lock_memory: bool = False  # no page of the process leaves the memory


@contextmanager
def pause_garbage_collection() -> Iterator[None]:
    """Leave all that exists by now out of garbage collection, which is then ours to call."""
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
    """Ask for what is wanted, for this thread and those that it starts from now on; returns what
    was refused, and why.

    The network runs on one thread, more only wait for each other; the recorder's gives way to the
    flying one soon."""
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
    """Keep the priority from threads and processes that are started from now on; returns as
    :func:`prepare`.
    """
    return _schedule(params.priority, os.SCHED_RESET_ON_FORK) if params.priority else []


def _schedule(priority: int, flag: int) -> list[str]:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | flag, os.sched_param(priority))
    except (OSError, AttributeError) as error:  # no right to, or no such call on this system
        return [f"no real-time priority: {error}"]
    return []

"""Memory of the linear algebra: thousands of arrays of a few hundred kilobytes, taken and freed again."""

import ctypes
import gc
from functools import cache

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # numbers of glibc's ``malloc.h``
KEPT = 2**31 - 1  # bytes at the top of the heap, up to which none go back to the system
MAPPED = 2**30  # bytes from which an array has a mapping of its own, which goes back when it is freed


@cache
def keep() -> None:
    """Let this process keep what it frees for what it takes next, and look for garbage among new objects alone.

    By default glibc gives large arrays' pages back to the system and faults them in anew: of looks at noise levels, one after the
    other, half the time was the kernel's. A third of a million objects of the modules are never garbage.
    """
    gc.freeze()
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another C library
        return
    mallopt(MMAP_THRESHOLD, MAPPED)
    mallopt(TRIM_THRESHOLD, KEPT)

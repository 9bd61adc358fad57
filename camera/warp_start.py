"""Initialisation of Warp: no adjoints, short compile times, no message on CPU-only machines."""

import os
import sys
import tempfile

import warp as wp

NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"

FLAGS = "-march=native"
"""Flags of Warp's compiler for CPUs.

They leave LLVM's default thresholds for inlining. Warp's much higher thresholds take a quarter
longer to compile, without a difference in results or measurable speed. A kernel that benefits from
another threshold sets it itself.
"""


def start() -> None:
    """Initialise Warp with the same compiler settings in all processes, so that they share compiled
    kernels.

    Warp's native library reports a missing CUDA driver on stderr at every start. This message is
    dropped, because a CPU run needs no GPU; all other output is passed on."""
    wp.config.enable_backward = False
    wp.config.max_unroll = (
        4  # unrolling longer loops costs half a minute of compile time without a gain
    )
    wp.config.cpu_compiler_flags = FLAGS
    wp.config.log_level = wp.LOG_WARNING
    sys.stderr.flush()
    saved = os.dup(2)
    with tempfile.TemporaryFile() as caught:
        os.dup2(caught.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(saved, 2)
            os.close(saved)
        caught.seek(0)
        output = b"".join(line for line in caught if NO_DRIVER not in line)
    if output:
        os.write(2, output)

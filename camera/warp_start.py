"""Start of Warp: forward only, quickly compiled, and quiet on machines without a GPU."""

import os
import sys
import tempfile

import warp as wp

NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"

FLAGS = "-march=native"
"""Of Warp's compiler for CPUs:

LLVM's own thresholds for inlining. Warp's far higher ones take a quarter longer to compile and gain
our kernels nothing: the same bits, as fast within the noise. A kernel that gains by another
threshold states it itself.
"""


def start() -> None:
    """Initialise Warp once, and say how kernels are compiled: alike in all processes, so that one
    finds what another compiled.

    Warp's native library reports a missing CUDA driver on stderr at every start; a CPU run needs no
    GPU. Everything else that it prints is passed on."""
    wp.config.enable_backward = False
    wp.config.max_unroll = (
        4  # longer unrolled loops cost half a minute of compile time and gain nothing
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

"""Start of Warp, quiet on machines without a GPU."""

import os
import sys
import tempfile

import warp as wp

NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"


def start() -> None:
    """Initialise Warp once. Its native library reports a missing CUDA driver on stderr at every start; a CPU run needs no GPU.

    Everything else that it prints is passed on.
    """
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
        rest = b"".join(line for line in caught if NO_DRIVER not in line)
    if rest:
        os.write(2, rest)

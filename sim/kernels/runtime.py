"""Start of Warp for the simulator."""

import warp as wp

from camera.warp_start import start

start()

unique_kernel = wp.kernel(module="unique", enable_backward=False)
"""Decorator of the kernels that one build composes: each is a module by itself, forward only."""

Ints = wp.array(dtype=wp.int32)
"""Type of an array of integers, for annotations."""

"""Start of Warp for the simulator."""

from functools import partial

import warp as wp

from camera.warp_start import start

start()

unique_kernel = partial(wp.kernel, module="unique", enable_backward=False)
"""Decorator of the kernels that one build composes: each is a module by itself, forward only.

It takes other options of ``wp.kernel`` too.
"""

Ints = wp.array(dtype=wp.int32)
"""Type of an array of integers, for annotations."""

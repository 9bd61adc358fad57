"""Initialisation of Warp, and the decorator of the simulator's kernels."""

from functools import partial

import warp as wp

from camera.warp_start import start

start()

unique_kernel = partial(wp.kernel, module="unique", enable_backward=False)
"""Decorator of composed kernels: each is a Warp module of its own, without backward pass.

It accepts the other options of ``wp.kernel``.
"""

Ints = wp.array(dtype=wp.int32)
"""Type of an array of integers, for annotations."""

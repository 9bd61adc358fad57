"""Start of Warp for the simulator: forward only, and quiet."""

import warp as wp

from camera.warp_start import start

wp.config.enable_backward = False
wp.config.max_unroll = 4  # longer unrolled loops cost half a minute of compile time and gain nothing
start()

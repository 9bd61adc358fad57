"""Start of Warp for the simulator."""

from camera.warp_start import start

start()

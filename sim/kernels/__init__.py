"""The batched simulator on Warp: types, arrays, blocks of vehicle and rope, and the kernels that
are composed of these blocks.
"""

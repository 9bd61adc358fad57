"""The batched simulator on Warp: types and arrays, blocks of the vehicle and of the rope, and the
kernels that are composed of them.
"""

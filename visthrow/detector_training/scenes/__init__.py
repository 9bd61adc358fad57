"""A batched renderer of what the fisheye camera sees of a hall, on Warp, and the random scenes that
a detector is trained on.
"""

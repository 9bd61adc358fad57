"""A batched renderer of fisheye pictures of a hall, on Warp, and random scenes for the training of
a detector.
"""

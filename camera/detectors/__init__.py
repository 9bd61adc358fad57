"""Detection of ball and goal square on fisheye images."""

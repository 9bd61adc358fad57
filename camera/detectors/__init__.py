"""Detection and tracking of ball and goal square on fisheye frames."""

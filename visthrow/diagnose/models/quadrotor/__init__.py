"""Models of a quadrotor driven by its logged commands: with a measured pose, or with an IMU
alone.
"""

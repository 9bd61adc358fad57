"""A quadrotor that its logged commands drive: with a measured pose, or with an IMU alone."""

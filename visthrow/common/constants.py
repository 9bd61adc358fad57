"""Constants of physics for what flies on board, where ``sim`` is not installed."""

GRAVITY = 9.81  # acceleration of free fall [m/s^2]; a test holds it equal to the simulator's

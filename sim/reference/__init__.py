"""Independent float64 plant on MuJoCo C: reference of the physics tests and substitute for the real
vehicle.
"""

"""Independent float64 plant on MuJoCo C: oracle of the physics tests and stand-in for the real
vehicle.
"""

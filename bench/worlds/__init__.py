"""Worlds with a hidden effect: plants, pilots and logs that share no code with the package under
test.
"""

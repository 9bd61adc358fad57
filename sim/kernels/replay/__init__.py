"""Event-exact replay of recorded commands through the simulator's blocks, many perturbed lanes at
once.
"""

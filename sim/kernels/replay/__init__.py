"""Event-exact replay of recorded commands through the simulator's blocks, in many perturbed
lanes.
"""

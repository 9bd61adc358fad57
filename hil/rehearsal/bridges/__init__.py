"""Bridges between real firmware in software and the simulator's vehicle, with the firmware's
process and set-up.
"""

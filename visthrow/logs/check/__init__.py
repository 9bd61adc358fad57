"""Checks of flight logs without a model: each channel by itself; units, axes, signs and delays by
physics; excitation.
"""

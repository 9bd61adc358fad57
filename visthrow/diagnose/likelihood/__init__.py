"""Marginal likelihood of flights: statistics of windows, noise levels, evidence of sets
of effects.
"""

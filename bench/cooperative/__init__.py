"""Measurements of several vehicles that throw one load."""

"""Fake autopilots whose messages and timing follow measurements of real ones; the plant behind
them is injected.
"""

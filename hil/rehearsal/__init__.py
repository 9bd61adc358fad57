"""Fake autopilots that behave over the wire as the real ones were measured to; what flies behind
them is injected.
"""

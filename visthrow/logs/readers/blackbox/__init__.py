"""Betaflight blackbox logs, raw or decoded to CSV: bit packing, frames, and the channels of a
flight log.
"""

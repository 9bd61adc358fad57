"""Betaflight blackbox logs, raw or decoded to CSV: bytes, frames, and channels of a flight log."""

"""Measurements of the HIL runner against the fakes, over loopback between processes."""

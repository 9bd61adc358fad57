"""Calibration of a camera: files of other tools, other lens models, and pictures of a board."""

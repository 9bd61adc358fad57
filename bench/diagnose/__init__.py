"""Measurements of the diagnosis on flights whose truth is hidden from it."""

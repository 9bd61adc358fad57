"""Poses: what a source measures, from frames and axes over the gate to an estimated state."""

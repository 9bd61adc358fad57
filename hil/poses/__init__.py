"""Poses: sources, conversion of frames, the gate, and the estimation of states."""

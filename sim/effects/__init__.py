"""Effects that extend the simulator beyond the paper's blocks.

`configs/effects` is the catalogue; `effect.py` is its schema.
"""

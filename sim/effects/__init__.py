"""Effects that extend the simulator beyond the paper's blocks.

Their catalogue is data: `configs/effects`, fields in `effect.py`.
"""

"""Effects that extend the simulator beyond the paper's blocks."""

"""Speed of the simulator: on a CPU core against MuJoCo C, on a GPU against MuJoCo Warp."""

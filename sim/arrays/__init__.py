"""Arrays of the simulator: state and parameters as Warp structs, their checks, and the bridge to torch."""

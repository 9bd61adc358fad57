"""Solvers of the bodies side by side: accuracy, landings, throughput, trainings.

``python -m bench.engine.NAME --help``."""

SUBSTEPS = {"chain": 0.002, "exchanged_chain": 0.002, "physx": 0.002, "mujoco_warp": 0.001}
"""Solver -> time between two exchanges [s]: the paper's; MuJoCo's rope needs half of it."""


def overrides(solver: str, substep: float | None = None) -> list[str]:
    """Changes of a configuration that put its bodies into a solver."""
    return [f"sim.solver={solver}", f"sim.substep={substep or SUBSTEPS[solver]}"]

"""TeamSim: simulate worlds of several vehicles that carry one load."""

from functools import partial
from typing import Any

import warp as wp

from sim import solvers
from sim.hybrid import HybridSim
from sim.kernels.rope.payload import LOADS
from sim.params import PlantParams
from visthrow.cooperative.tree import TreeSolver


class TeamSim(HybridSim):
    """A batched simulator with one row for each vehicle: row ``w * team + v`` is vehicle v of world
    w.

    Blocks, latches and outputs are per row. When a row separates while others still hold the load,
    its output is the landing of a load that would fly freely from then on; the output of the last
    row is the landing of the throw.

    Attributes:
        team: number V of vehicles in a world. worlds: number W of worlds.
    """

    def __init__(self, params: PlantParams, worlds: int, team: int, *args: Any, **options: Any):
        """Allocate ``worlds`` teams; other arguments: see :class:`sim.hybrid.HybridSim`.

        ``options["build"]`` builds another solver of the bodies from a world and ``team=``. Raises
        ValueError: aerodynamic forces act on the load.
        """
        self.team = team
        self.worlds = worlds
        self._build = options.pop("build", TreeSolver)
        super().__init__(params, worlds * team, *args, **options)
        if unknown := sorted(LOADS & self.extensions):
            raise ValueError(f"a team's load with {', '.join(unknown)}; expected none of them")

    def _solver(self) -> partial[solvers.Solver]:
        return partial(self._build, team=self.team)

    @property
    def load(self) -> tuple["wp.array[Any]", "wp.array[Any]"]:
        """Return positions [m] and velocities [m/s] of the loads, each of shape (W,) of vec3."""
        solver: Any = self._exchange.solver  # type: ignore[union-attr]
        return solver.load_pos_w, solver.load_vel_w

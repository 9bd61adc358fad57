"""TeamSim: worlds of several vehicles that carry one load."""

from functools import partial
from typing import Any

import warp as wp

from sim import solvers
from sim.hybrid import HybridSim
from sim.kernels.rope.payload import LOADS
from sim.params import PlantParams
from visthrow.cooperative.tree import TreeSolver


class TeamSim(HybridSim):
    """Batched simulator with a row a vehicle: row ``w * team + v`` is vehicle v of world w.

    Blocks, latches and outputs are those of a row. A row that separates while others hold on puts
    out the landing that would follow there and then; that of the last row is the throw's.

    Attributes:
        team: vehicles a world, V. worlds: number of worlds W.
    """

    def __init__(self, params: PlantParams, worlds: int, team: int, *args: Any, **options: Any):
        """Allocate ``worlds`` teams; the rest is as for :class:`sim.hybrid.HybridSim`.

        ``options["build"]`` makes another solver of the bodies, called with a world and
        ``team=``. Raises ValueError: air that acts on the load.
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
        """Position [m] and velocity [m/s] of the loads, each of shape (W,) of vec3."""
        solver: Any = self._exchange.solver  # type: ignore[union-attr]
        return solver.load_pos_w, solver.load_vel_w

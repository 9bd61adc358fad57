"""Solvers for the bodies of the hybrid simulator: vehicle, rope and payload.

The fused kernel of :mod:`sim.kernels.step` integrates the bodies itself. Any other engine is a
:class:`Solver`. In every substep the quadrotor's blocks give it a wrench, and it returns the
bodies' kinematics."""

import importlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import warp as wp
from numpy import ndarray

from sim.kernels import state as st
from sim.kernels.exchange import ExchangeKernels
from sim.kernels.structs import Types
from sim.params import PlantParams, RopeParams, VehicleParams

SOLVERS = {
    "exchanged_chain": "sim.solvers.exchanged_chain:ChainSolver",
    "physx": "sim.solvers.physx:PhysxSolver",
    "mujoco_warp": "sim.solvers.mujoco:MujocoSolver",
}
"""Name in ``sim.solver`` -> class; ``chain`` is the fused kernel."""

UNKNOWN = frozenset({"compliance", "lag_tension", "rope_tail"})
"""Extensions that only the fused kernel supports."""


class Solver(Protocol):
    """An engine that advances the bodies of E vehicles on the device.

    Attributes:
        capturable: whether its steps can be captured in a CUDA graph.
    """

    capturable: bool

    def __init__(self, world: "World"):
        """Build the bodies.

        Raises ValueError: a plant that the engine cannot simulate; ModuleNotFoundError: the engine
        is not installed.
        """

    def place(self, mask: "wp.array[Any]") -> None:
        """Set the bodies to ``world.state`` where ``mask``, shape (E,), int, is not 0.

        ``world.bodies`` already contains this state, with the payload in line with the rope."""

    def advance(self, duration: float) -> None:
        """Advance all bodies under ``world.wrench`` by ``duration`` [s]; write ``world.bodies``."""


@dataclass(frozen=True)
class World:
    """The inputs of a solver, and the arrays that it shares with the exchange."""

    params: PlantParams
    count: int  # E
    device: str
    types: Types
    vehicles: Sequence[VehicleParams]  # of environment e: e % len(vehicles)
    ropes: Sequence[RopeParams]  # likewise; mounts are relative to the centre of mass
    plants: Any  # these parameters on the device, with the numerics: types.Plants
    state: Any  # arrays of sim.kernels.state.STATE_FIELDS
    kernels: ExchangeKernels  # with the types of the structs
    wrench: Any  # of sim.kernels.exchange.WRENCH_FIELDS
    bodies: Any  # of sim.kernels.exchange.BODY_FIELDS

    def launch(self, kernel: wp.Kernel, arguments: list[Any]) -> None:
        """Launch a kernel for all environments."""
        wp.launch(kernel, self.count, arguments, device=self.device)

    @property
    def substep(self) -> float:
        """Time between two exchanges [s]."""
        return self.params.sim.control_period / self.substeps

    @property
    def substeps(self) -> int:
        """Number of exchanges in a control period."""
        s = self.params.sim
        return math.ceil(s.control_period / s.substep - 1e-3)

    def models(self) -> tuple[list[tuple[VehicleParams, RopeParams]], ndarray]:
        """Return the distinct pairs of vehicle and rope, and the index of the pair of each
        environment.
        """
        period = math.lcm(len(self.vehicles), len(self.ropes))
        rows = range(min(period, self.count))
        pairs = [
            (self.vehicles[e % len(self.vehicles)], self.ropes[e % len(self.ropes)]) for e in rows
        ]
        bodies = [(vehicle.body, rope) for vehicle, rope in pairs]
        different = list(dict.fromkeys(bodies))
        model_of = np.array([different.index(pair) for pair in bodies])
        return [pairs[int(np.argmax(model_of == k))] for k in range(len(different))], model_of[
            np.arange(self.count) % len(rows)
        ]


class Exchange:
    """Steps of a simulator whose bodies are integrated by a solver.

    Raises ValueError: a plant that the solver cannot simulate.
    """

    def __init__(
        self, kernels: ExchangeKernels, world: dict[str, Any], build: Callable[[World], Solver]
    ):
        """Build the solver; ``world``: the fields of :class:`World` except the shared arrays."""
        count = world["count"]
        device = world["device"]
        segments = world["params"].rope.segments
        rows = dict.fromkeys(("cable_dir_w", "cable_vel_w"), segments)
        self.world = World(
            **world,
            kernels=kernels,
            wrench=st.allocate(kernels.Wrench, count, device),
            bodies=st.allocate(kernels.Bodies, count, device, rows),
        )
        self.solver = build(self.world)
        self._flags = st.allocate(kernels.Flags, count, device)

    def step(self, launch: Callable[..., None], sim: Any) -> None:
        """Advance by one control period."""
        world = self.world
        h = world.substep
        k = world.kernels
        plants = world.plants
        flags = self._flags
        launch(k.begin, [plants, sim.state, sim.inputs, flags, sim.out])
        for i in range(world.substeps):
            wrench = [sim.state, flags, sim.out, world.wrench]
            launch(k.wrench, [plants, i * h, h, *wrench])
            self.solver.advance(h)
            taken = [sim.state, flags, world.wrench, world.bodies, sim.out]
            launch(k.take, [plants, (i + 1) * h, h, *taken])
        launch(k.end, [plants, sim.state, sim.inputs, sim.out])
        self.place(launch, sim, flags.redrawn)

    def place(self, launch: Callable[..., None], sim: Any, mask: "wp.array[Any]") -> None:
        """Set the solver's bodies to the state arrays where ``mask`` is not 0."""
        w = self.world
        launch(w.kernels.show, [w.plants, sim.state, mask, w.bodies, w.wrench])
        self.solver.place(mask)
        launch(w.kernels.payload, [sim.state, w.bodies, sim.out])


def solver_class(name: str) -> type[Solver]:
    """Return the class of a solver by its name in :data:`SOLVERS`."""
    module, _, attribute = SOLVERS[name].partition(":")
    solver: type[Solver] = getattr(importlib.import_module(module), attribute)
    return solver


def refuse(extensions: frozenset[str], params: PlantParams) -> None:
    """Raise ValueError if the plant's solver does not support all of its parameters."""
    name = params.sim.solver
    if name != "mujoco_warp":
        params.rope.require_chain(f"sim.solver {name!r}")
    unknown = sorted(UNKNOWN & extensions)
    if unknown:
        raise ValueError(f"sim.solver {name!r} with {', '.join(unknown)}; only 'chain' has that")
    if any(law.block == "rope joint" for law in params.laws):
        raise ValueError(f"sim.solver {name!r} with a law on the rope's joint; only 'chain' has it")
    if name != "exchanged_chain" and params.sim.precision != "float32":
        raise ValueError(
            f"sim.solver {name!r} with precision {params.sim.precision!r}; expected 'float32'"
        )

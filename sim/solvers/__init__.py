"""Solvers that hold the bodies of the hybrid simulator: vehicle, rope and payload.

The fused kernel of :mod:`sim.kernels.step` needs none. Any other engine is a :class:`Solver`; what
it exchanges with the quadrotor's blocks in every substep is a wrench and the root's kinematics."""

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
"""Extensions that no solver behind the exchange knows."""


class Solver(Protocol):
    """An engine that advances the bodies of E vehicles on the device.

    Attributes:
        capturable: whether its work may be captured in a CUDA graph.
    """

    capturable: bool

    def __init__(self, world: "World"):
        """Build the bodies.

        Raises ValueError: something that the engine cannot hold; ModuleNotFoundError: it is not
        installed.
        """

    def place(self, mask: "wp.array[Any]") -> None:
        """Put the bodies to ``world.state`` where ``mask``, shape (E,), int, is not 0.

        ``world.bodies`` shows them already, with the payload in line with the rope."""

    def advance(self, duration: float) -> None:
        """Advance all bodies under ``world.wrench`` [s], and show them in ``world.bodies``."""


@dataclass(frozen=True)
class World:
    """The inputs of a solver, and the arrays that it shares with the exchange."""

    params: PlantParams
    count: int  # E
    device: str
    types: Types
    vehicles: Sequence[VehicleParams]  # of environment e: e % len(vehicles)
    ropes: Sequence[RopeParams]  # likewise; mounts are stated from the centre of mass
    plants: Any  # the same on the device, with the numerics: types.Plants
    state: Any  # arrays of sim.kernels.state.STATE_FIELDS
    kernels: ExchangeKernels  # whose structs the arrays are in
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
        """Number of exchanges a control period."""
        s = self.params.sim
        return math.ceil(s.control_period / s.substep - 1e-3)

    def models(self) -> tuple[list[tuple[VehicleParams, RopeParams]], ndarray]:
        """Different pairs of vehicle and rope, and which of them each environment has."""
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
    """Steps of a simulator whose bodies are a solver's.

    Raises ValueError: a plant that has something which cannot be exchanged.
    """

    def __init__(
        self, kernels: ExchangeKernels, world: dict[str, Any], build: Callable[[World], Solver]
    ):
        """Build the solver; ``world``: what :class:`World` is made of but the shared arrays."""
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
        """Put the solver's bodies to the state arrays where ``mask`` is not 0."""
        w = self.world
        launch(w.kernels.show, [w.plants, sim.state, mask, w.bodies, w.wrench])
        self.solver.place(mask)
        launch(w.kernels.payload, [sim.state, w.bodies, sim.out])


def solver_class(name: str) -> type[Solver]:
    """Class of a solver by its name in :data:`SOLVERS`."""
    module, _, attribute = SOLVERS[name].partition(":")
    solver: type[Solver] = getattr(importlib.import_module(module), attribute)
    return solver


def refuse(extensions: frozenset[str], params: PlantParams) -> None:
    """Raise ValueError for what of a plant cannot be exchanged with a solver."""
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

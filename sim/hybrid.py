"""HybridSim: a batch of quadrotors, each with a rope and a payload or with neither, stepped one
control period at a time.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp
from numpy import ndarray

from sim import solvers
from sim.cores import cores, launch_in_pieces
from sim.kernels import runtime  # noqa: F401  starts Warp
from sim.kernels import state as st
from sim.kernels.exchange import build_exchange
from sim.kernels.laws import check_laws, structure
from sim.kernels.quadrotor.queue import queue_depth
from sim.kernels.randomize import build_reset
from sim.kernels.step import build_step
from sim.kernels.structs import (
    extensions_of,
    kinds_of,
    pack,
    pack_plants,
    plants_on,
    ropes_on,
    types,
)
from sim.params import (
    GRAVITY,
    AirParams,
    PlantParams,
    RandomizationParams,
    ReleaseParams,
    RopeParams,
    VehicleParams,
    change_values,
)

PIECES = 8
"""Number of pieces of a batch for each core of a CPU: a core that has other work for a while leaves
its pieces to the rest.
"""

FEWEST = 32
"""Environments of a piece of a step, at least: they take half a millisecond, the launch a tenth."""
LOOK = 0.01
"""What a kernel that looks at each state once does for an environment, in steps."""

INTEGRATORS = ("euler", "rk4")
"""Integrators of a quadrotor without a rope.

Full-range commands keep the mixer at its limits: after a second of them RK4 is 0.6 mm off at 2 ms,
0.04 mm at 0.5 ms."""

_BUILDS: dict[tuple[Any, ...], tuple[Any, Any, Any]] = {}


def _kernels(
    params: PlantParams,
    direct: bool,
    motors: bool,
    extensions: frozenset[str],
    without_rope: str | None,
) -> tuple[Any, Any, Any]:
    """Kernels of one choice of blocks; built once a process."""
    blocks = (kinds_of(params.vehicle), direct, motors, extensions, without_rope)
    key = (params.sim.precision, params.rope.segments, blocks, structure(params.laws))
    if key not in _BUILDS:
        t = types(params.sim.precision)
        step = build_step(t, params, direct, extensions, motors, without_rope or "heun")
        reset = build_reset(t, params, step.State, without_rope is None)
        _BUILDS[key] = (t, step, reset)
    return _BUILDS[key]


def tether_lengths(rope: RopeParams, z: RandomizationParams) -> list[RopeParams]:
    """Return the rope in ``tether_variants`` lengths that span +-``tether_spread``; its mass per
    metre is kept.

    Environment e gets entry ``e % tether_variants`` (the paper, Sec. III-C).
    """
    if z.tether_variants < 1:
        raise ValueError(f"tether_variants {z.tether_variants}; expected 1 or more")
    return [
        dataclasses.replace(rope, length=rope.length * f, rope_mass=rope.rope_mass * f)
        for f in _factors(z.tether_spread, z.tether_variants)
    ]


def _factors(spread: float, count: int) -> list[float]:
    """Return so many factors that span 1 +- a spread; 1 alone is in the middle."""
    return np.linspace(1 - spread, 1 + spread, count).tolist() if count > 1 else [1.0]


def rope_variants(rope: RopeParams, z: RandomizationParams) -> list[RopeParams]:
    """:func:`tether_lengths` with every combination of ``payload_variants`` masses and as many
    drags of the payload.

    They span +-``payload_spread`` and +-``drag_spread``; a spread of 0 leaves one. The payload
    keeps its size, so its inertia goes with its mass. Environment e gets entry ``e % len(...)``,
    whose cable is ``e % tether_variants``."""
    spreads = {"payload_spread": z.payload_spread, "drag_spread": z.drag_spread}
    if z.payload_variants < 1 or not all(0.0 <= spread < 1.0 for spread in spreads.values()):
        raise ValueError(
            f"payload_variants {z.payload_variants}, {spreads}; expected 1 or more, and 0 to"
            " below 1"
        )
    masses, drags = (
        _factors(spread, z.payload_variants if spread else 1) for spread in spreads.values()
    )
    return [
        dataclasses.replace(
            r,
            payload_mass=r.payload_mass * m,
            payload_inertia=r.payload_inertia * m,
            payload_drag=r.payload_drag * d,
        )
        for d in drags
        for m in masses
        for r in tether_lengths(rope, z)
    ]


def _check(
    params: PlantParams, count: int, ropes: list[RopeParams], without_rope: str | None
) -> None:
    """Refuse a batch that cannot be simulated."""
    if count < 1:
        raise ValueError(f"HybridSim of {count} environments; expected 1 or more")
    if without_rope not in (None, *INTEGRATORS):
        raise ValueError(f"integrator {without_rope!r}; expected one of {INTEGRATORS}")
    if without_rope and params.sim.solver != "chain":
        raise ValueError(
            f"a quadrotor without a rope in sim.solver {params.sim.solver!r}; expected 'chain'"
        )
    check_laws(params.laws)
    if {r.segments for r in ropes} != {params.rope.segments}:
        raise ValueError(
            f"ropes of {sorted({r.segments for r in ropes})} segments in one batch of"
            f" {params.rope.segments}"
        )


class HybridSim:
    """Batched plant: command queue, rate controller, motors, battery, aerodynamics, rope, payload,
    release.

    All arrays live on the device and keep their addresses for life, so a captured graph of ``step``
    stays valid.

    Attributes:
        command: [N, rad/s], shape (E,) of vec4: collective thrust and body rates of the next step.
        release: shape (E,), int: non-zero asks for the release; the latch keeps it.
        state: arrays of :data:`sim.kernels.state.STATE_FIELDS`.
        out: arrays of :data:`sim.kernels.state.OUTPUT_FIELDS`.
        vehicles: parameters of environment e at ``e % len(vehicles)``.
        goal_w: [m], shape (E,) of vec3: goals that :meth:`randomize` draws.
    """

    def __init__(
        self,
        params: PlantParams,
        count: int,
        device: str = "cpu",
        seed: int = 0,
        *,
        vehicles: list[VehicleParams] | None = None,
        ropes: list[RopeParams] | None = None,
        airs: list[AirParams] | None = None,
        releases: list[ReleaseParams] | None = None,
        direct: bool = False,
        motors: bool = False,
        without_rope: str | None = None,
        extensions: frozenset[str] = frozenset(),
        gravity: float = GRAVITY,
        threads: int | None = None,
    ):
        """Allocate ``count`` plants.

        Raises ValueError: no environment, ropes of different segment counts, a law that no block
        can be made of, or an unknown integrator.

        Args:
            params: the plant; its kinds and numerics hold for all.
            count: number of environments E.
            device: Warp device, "cpu" or "cuda:0". seed: of :meth:`randomize`.
            vehicles: of environment e at ``e % len(vehicles)``; default ``[params.vehicle]``.
            ropes, airs, releases: likewise; all ropes with the same number of segments.
            direct: by-pass the blocks: commands are thrust [N] and torque [N m].
            motors: by-pass the rate controller: commands are motor-speed set-points [rad/s].
            without_rope: simulate quadrotors without rope and payload, by this one of
                :data:`INTEGRATORS`; :meth:`set_wrench` pushes them.
            extensions: of :data:`sim.kernels.structs.EXTENSIONS`, besides what parameters need.
            gravity: of free fall, along -z [m/s^2]. threads: at most, of a CPU; default all cores.
        """
        if without_rope is not None:
            params = change_values(params, {"rope.segments": 1})
            extensions = extensions | {"push"}
            ropes = None
        self.vehicles = vehicles = vehicles or [params.vehicle]
        ropes = ropes or [params.rope]
        airs = airs or [params.air]
        releases = releases or [params.release]
        _check(params, count, ropes, without_rope)
        self.params = params
        self.count = count
        self.device = device
        self.seed = seed
        self.gravity = gravity
        self.threads = threads or cores()
        self.extensions = extensions_of(ropes, airs, releases, params.laws) | extensions
        kernels = _kernels(params, direct, motors, self.extensions, without_rope)
        self.types, self._step, self._reset = kernels
        ropes = ropes_on(vehicles, ropes)
        plants = pack_plants(self.types, params, vehicles, ropes, airs, releases)
        self._plants = plants_on(self.types, plants, params.sim, gravity, device)
        self._allocate(max(queue_depth(v.queue.delay, params.sim.control_period) for v in vehicles))
        self._exchange = self._make_exchange(ropes)
        self.place(pos_w=np.zeros((count, 3)))

    def _make_exchange(self, ropes: list[RopeParams]) -> solvers.Exchange | None:
        """Return the solver of the plant's bodies with what it exchanges; None for the fused
        kernel.
        """
        params = self.params
        build = self._solver()
        if build is None:
            params.rope.require_chain("sim.solver 'chain'")
            return None
        solvers.refuse(self.extensions, params)
        kernels = build_exchange(self.types, params, self._step, self.extensions)
        world = {
            "params": params,
            "count": self.count,
            "device": self.device,
            "types": self.types,
            "vehicles": self.vehicles,
            "ropes": ropes,
            "plants": self._plants,
            "state": self.state,
        }
        return solvers.Exchange(kernels, world, build)

    def _solver(self) -> Callable[[solvers.World], solvers.Solver] | None:
        """Return the builder of the solver of the plant's bodies; None for the fused kernel."""
        name = self.params.sim.solver
        return None if name == "chain" else solvers.solver_class(name)

    @property
    def capturable(self) -> bool:
        """Whether steps can be captured in a CUDA graph."""
        return self._exchange is None or self._exchange.solver.capturable

    def _allocate(self, depth: int) -> None:
        """Make the arrays of state and output, with a command queue so deep."""
        t = self.types
        count = self.count
        device = self.device
        segments = self.params.rope.segments
        rows = {**dict.fromkeys(st.ROPE_FIELDS, segments), "queue": depth}
        self.state = st.allocate(self._step.State, count, device, rows)
        self.out = st.allocate(self._step.Output, count, device)
        self.foreseen = st.allocate(self._step.Output, count, device)
        self.inputs = st.allocate(self._step.Input, count, device)
        self.command = self.inputs.command
        self.release = self.inputs.release
        self.episode = wp.zeros(count, dtype=wp.int32, device=device)
        self.goal_w = wp.zeros(count, dtype=t.vec3, device=device)
        self._all = wp.full(count, 1, dtype=wp.int32, device=device)
        self._used = wp.zeros(count, dtype=t.real, device=device)
        self._spreads: tuple[RandomizationParams, wp.array[Any]] | None = None

    def step(self, mask: "wp.array[Any] | None" = None) -> None:
        """Advance every plant by one control period under ``command`` and ``release``; with a
        ``mask``, shape (E,), where it is not 0.
        """
        self.inputs.mask = self._all if mask is None else mask
        if self._exchange is not None:
            self._exchange.step(self._launch, self)
            return
        arguments = [self._plants, self.state, self.inputs, self.out]
        self._launch(self._step.step, arguments, block_dim=64)

    def foresee(self) -> None:
        """Write into ``foreseen`` what follows if every payload separates now; the plants stay as
        they are.
        """
        inputs = [self._plants, self.state, self.foreseen]
        self._launch(self._step.foresee, inputs, block_dim=64, work=LOOK)

    def randomize(self, spreads: RandomizationParams, mask: "wp.array[Any] | None" = None) -> None:
        """Start new episodes where ``mask`` (shape (E,), int) is non-zero; everywhere
        without one.
        """
        if self._spreads is None or self._spreads[0] != spreads:
            packed = pack(self.types.Randomization, spreads)
            self._spreads = (
                spreads,
                wp.array(packed, dtype=self.types.Randomization, device=self.device),
            )
        mask = self._all if mask is None else mask
        inputs = [
            self._plants,
            self._spreads[1],
            self.seed,
            self.state,
            self.episode,
            mask,
            self.goal_w,
        ]
        self._launch(self._reset.randomize, inputs)
        self.adopt(mask)

    def place(
        self,
        pos_w: ndarray,
        quat_wb: ndarray | None = None,
        vel_w: ndarray | None = None,
        rate_b: ndarray | None = None,
        cable_dir_w: ndarray | None = None,
        cable_vel_w: ndarray | None = None,
        battery_used: float = 0.0,
    ) -> None:
        """Put every plant into a stated pose, actuators at hover, command queue filled with hover.

        Raises ValueError: a shape that does not fit.

        Args:
            pos_w: [m], shape (E, 3).
            quat_wb: xyzw, shape (E, 4); default level.
            vel_w: [m/s], shape (E, 3). rate_b: [rad/s], shape (E, 3).
            cable_dir_w: unit vectors, shape (E, L, 3); default hanging.
            cable_vel_w: their time derivatives [1/s], shape (E, L, 3).
            battery_used: fraction of charge used.
        """
        zero = np.zeros(3)
        rows = np.zeros((self.params.rope.segments, 3))
        values = {
            "pos_w": (pos_w, zero),
            "quat_wb": (quat_wb, st.LEVEL),
            "vel_w": (vel_w, zero),
            "rate_b": (rate_b, zero),
            "cable_dir_w": (cable_dir_w, rows - [0.0, 0.0, 1.0]),
            "cable_vel_w": (cable_vel_w, rows),
        }
        st.put(self.types, self.state, values, self.count)
        self.state.mass_scale.fill_(1.0)
        self._used.fill_(battery_used)
        inputs = [self._plants, self.state, self._all, self._used]
        wp.launch(self._reset.place, self.count, inputs, device=self.device)
        self.adopt()

    def adopt(self, mask: "wp.array[Any] | None" = None) -> None:
        """Take over bodies and ropes as they were written into ``state``, where ``mask`` is not 0:
        the payload follows from them.
        """
        if self._exchange is None:
            self._launch(self._step.payload, [self._plants, self.state, self.out], work=LOOK)
        else:
            mask = self._all if mask is None else mask
            self._exchange.place(self._launch, self, mask)

    def _launch(
        self, kernel: wp.Kernel, arguments: list[Any], block_dim: int = 256, work: float = 1.0
    ) -> None:
        """Launch a kernel for all plants, on a CPU in pieces that run side by side."""
        count = self.count
        device = self.device
        if device == "cpu" and self.threads > 1:
            pieces = min(PIECES * self.threads, int(count * work) // FEWEST)
        else:
            pieces = 1
        if pieces <= 1:
            wp.launch(kernel, count, [0, *arguments], device=device, block_dim=block_dim)
            return
        kernel.module.load(device, block_dim=1)  # by one thread, as a launch there would

        def launch(first: int, last: int) -> None:
            wp.launch(kernel, last - first, [first, *arguments], device=device)

        launch_in_pieces(launch, [count * i // pieces for i in range(pieces + 1)], self.threads)

    def plants(self) -> tuple[ndarray, ndarray]:
        """Parameters of vehicle and rope of every environment as the kernels read them: structured
        arrays, shape (E,).
        """
        vehicles = self._plants.vehicles.numpy()
        ropes = self._plants.ropes.numpy()
        rows = np.arange(self.count)
        return vehicles[rows % len(vehicles)], ropes[rows % len(ropes)]

    def set_command(self, command: ndarray, release: ndarray | None = None) -> None:
        """Copy commands [N, rad/s], shape (E, 4), and release requests, shape (E,), to the device.

        Raises ValueError: another shape.
        """
        asked = np.zeros(self.count) if release is None else np.asarray(release)
        if asked.shape != (self.count,):
            raise ValueError(f"release of shape {asked.shape}; expected {(self.count,)}")
        st.put(self.types, self, {"command": (command, np.zeros(4))}, self.count)
        self.release.assign(asked.astype(np.int32))

    def set_wrench(self, force_w: ndarray, torque_b: ndarray) -> None:
        """Copy a wrench from outside [N], [N m], shapes (E, 3), to the device; it acts until the
        next one.

        Raises ValueError: another shape, or a simulator built without the extension "push"."""
        if "push" not in self.extensions:
            raise ValueError("an external wrench; expected a simulator with extension 'push'")
        zero = np.zeros(3)
        wrench = {"force_w": (force_w, zero), "torque_b": (torque_b, zero)}
        st.put(self.types, self.state, wrench, self.count)

    def get(self, name: str) -> ndarray:
        """Copy of a state or output array by name, environment first: shape (E, ...) or (E, L,
        ...).
        """
        if name in st.STATE_FIELDS:
            return st.fetch(getattr(self.state, name))
        if name in st.OUTPUT_FIELDS:
            return st.fetch(getattr(self.out, name))
        raise ValueError(
            f"no array {name!r}; there are {sorted(st.STATE_FIELDS | st.OUTPUT_FIELDS)}"
        )

    def cable_points_w(self) -> ndarray:
        """Joints of the rope from the mount to its lower end [m], shape (E, L + 1, 3),
        world frame.
        """
        ropes = self._plants.ropes.numpy()
        rows = np.arange(self.count) % len(ropes)
        q = self.get("quat_wb").astype(float)
        r = ropes["mount"][rows].astype(float)
        mount = self.get("pos_w") + r + 2 * np.cross(q[:, :3], np.cross(q[:, :3], r) + q[:, 3:] * r)
        steps = ropes["segment_length"][rows][:, None, None] * self.get("cable_dir_w")
        below = np.concatenate([np.zeros((self.count, 1, 3)), np.cumsum(steps, axis=1)], axis=1)
        return np.asarray(mount[:, None, :] + below)

"""Batched simulator of quadrotors, with or without rope and payload."""

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
"""Number of pieces of a batch for each CPU core. With several pieces, the other cores can take over
those of a core that is busy.
"""

FEWEST = 32
"""Smallest number of environments in a piece: a step takes 0.5 ms, its launch at most 0.1 ms."""
LOOK = 0.01
"""Work of a kernel that only reads each state once, relative to a step."""

INTEGRATORS = ("euler", "rk4")
"""Integrators of a quadrotor without a rope.

After 1 s of full-range commands, which saturate the mixer, the error of RK4 is 0.6 mm with steps of
2 ms and 0.04 mm with 0.5 ms."""

_BUILDS: dict[tuple[Any, ...], tuple[Any, Any, Any]] = {}


def _kernels(
    params: PlantParams,
    direct: bool,
    motors: bool,
    extensions: frozenset[str],
    without_rope: str | None,
) -> tuple[Any, Any, Any]:
    """Return types and kernels for a selection of blocks. They are built once in a process."""
    blocks = (kinds_of(params.vehicle), direct, motors, extensions, without_rope)
    key = (params.sim.precision, params.rope.segments, blocks, structure(params.laws))
    if key not in _BUILDS:
        t = types(params.sim.precision)
        step = build_step(t, params, direct, extensions, motors, without_rope or "heun")
        reset = build_reset(t, params, step.State, without_rope is None)
        _BUILDS[key] = (t, step, reset)
    return _BUILDS[key]


def tether_lengths(rope: RopeParams, z: RandomizationParams) -> list[RopeParams]:
    """Return ropes of ``tether_variants`` lengths that span +-``tether_spread``, with constant mass
    per metre.

    Environment e gets entry ``e % tether_variants`` (the paper, Sec. III-C).
    """
    if z.tether_variants < 1:
        raise ValueError(f"tether_variants {z.tether_variants}; expected 1 or more")
    return [
        dataclasses.replace(rope, length=rope.length * f, rope_mass=rope.rope_mass * f)
        for f in _factors(z.tether_spread, z.tether_variants)
    ]


def _factors(spread: float, count: int) -> list[float]:
    """Return ``count`` factors that span 1 +- ``spread``; a single factor is 1."""
    return np.linspace(1 - spread, 1 + spread, count).tolist() if count > 1 else [1.0]


def rope_variants(rope: RopeParams, z: RandomizationParams) -> list[RopeParams]:
    """Return the ropes of :func:`tether_lengths` in every combination with ``payload_variants``
    masses and as many drags of the payload.

    Masses and drags span +-``payload_spread`` and +-``drag_spread``; a spread of 0 gives a single
    value. The payload's size is constant, so its inertia is proportional to its mass. Environment e
    gets entry ``e % len(...)``, whose cable is ``e % tether_variants``."""
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
    """Raise ValueError if the batch cannot be simulated."""
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
    """A batch of plants: command queue, rate controller, motors, battery, aerodynamics, rope,
    payload, release.

    All arrays are on the device and are never reallocated, so that a captured graph of ``step``
    stays valid.

    Attributes:
        command: [N, rad/s], shape (E,) of vec4: collective thrust and body rates of the next step.
        release: shape (E,), int: a value other than 0 commands the release, which the latch holds.
        state: arrays of :data:`sim.kernels.state.STATE_FIELDS`.
        out: arrays of :data:`sim.kernels.state.OUTPUT_FIELDS`.
        vehicles: parameters of environment e at ``e % len(vehicles)``.
        goal_w: goals drawn by :meth:`randomize` [m], shape (E,) of vec3.
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

        Raises ValueError: no environment, ropes of different segment counts, an invalid law, or an
        unknown integrator.

        Args:
            params: the plant. Its kinds of blocks and its numerics apply to all environments.
            count: number of environments E.
            device: Warp device, "cpu" or "cuda:0". seed: of :meth:`randomize`.
            vehicles: environment e gets entry ``e % len(vehicles)``; default ``[params.vehicle]``.
            ropes, airs, releases: likewise; all ropes must have the same number of segments.
            direct: bypass the blocks: commands are thrust [N] and torque [N m].
            motors: bypass the rate controller: commands are motor-speed set-points [rad/s].
            without_rope: simulate quadrotors without rope and payload, with this integrator of
                :data:`INTEGRATORS`; :meth:`set_wrench` applies external wrenches to them.
            extensions: of :data:`sim.kernels.structs.EXTENSIONS`, besides the required ones.
            gravity: along -z [m/s^2]. threads: largest number of a CPU; default all cores.
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
        """Return the exchange with the solver of the plant's bodies; None for the fused kernel."""
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
        """Return the class of the bodies' solver; None for the fused kernel."""
        name = self.params.sim.solver
        return None if name == "chain" else solvers.solver_class(name)

    @property
    def capturable(self) -> bool:
        """Whether steps can be captured in a CUDA graph."""
        return self._exchange is None or self._exchange.solver.capturable

    def _allocate(self, depth: int) -> None:
        """Allocate the arrays of state and output; ``depth``: length of the command queue."""
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
        """Advance the plants by one control period under ``command`` and ``release``; with a
        ``mask``, shape (E,), int, only those where it is not 0.
        """
        self.inputs.mask = self._all if mask is None else mask
        if self._exchange is not None:
            self._exchange.step(self._launch, self)
            return
        arguments = [self._plants, self.state, self.inputs, self.out]
        self._launch(self._step.step, arguments, block_dim=64)

    def foresee(self) -> None:
        """Predict the outputs if every payload separated now, and write them into ``foreseen``. The
        plants are not changed.
        """
        inputs = [self._plants, self.state, self.foreseen]
        self._launch(self._step.foresee, inputs, block_dim=64, work=LOOK)

    def randomize(self, spreads: RandomizationParams, mask: "wp.array[Any] | None" = None) -> None:
        """Start new episodes where ``mask``, shape (E,), int, is not 0; by default everywhere."""
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
        """Set the pose and velocity of every plant, with actuators and command queue at hover.

        Raises ValueError: a wrong shape.

        Args:
            pos_w: [m], shape (E, 3).
            quat_wb: xyzw, shape (E, 4); default level.
            vel_w: [m/s], shape (E, 3). rate_b: [rad/s], shape (E, 3).
            cable_dir_w: unit vectors, shape (E, L, 3); default hanging.
            cable_vel_w: their time derivatives [1/s], shape (E, L, 3).
            battery_used: fraction of the charge that is used.
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
        """Apply the bodies and ropes that were written into ``state`` where ``mask`` is not 0, and
        compute the payload from them.
        """
        if self._exchange is None:
            self._launch(self._step.payload, [self._plants, self.state, self.out], work=LOOK)
        else:
            mask = self._all if mask is None else mask
            self._exchange.place(self._launch, self, mask)

    def _launch(
        self, kernel: wp.Kernel, arguments: list[Any], block_dim: int = 256, work: float = 1.0
    ) -> None:
        """Launch a kernel for all plants; on a CPU in pieces that run in parallel."""
        count = self.count
        device = self.device
        if device == "cpu" and self.threads > 1:
            pieces = min(PIECES * self.threads, int(count * work) // FEWEST)
        else:
            pieces = 1
        if pieces <= 1:
            wp.launch(kernel, count, [0, *arguments], device=device, block_dim=block_dim)
            return
        kernel.module.load(device, block_dim=1)  # once, before several threads launch the kernel

        def launch(first: int, last: int) -> None:
            wp.launch(kernel, last - first, [first, *arguments], device=device)

        launch_in_pieces(launch, [count * i // pieces for i in range(pieces + 1)], self.threads)

    def plants(self) -> tuple[ndarray, ndarray]:
        """Return the parameters of every environment's vehicle and rope in the kernels' format:
        structured arrays, shape (E,).
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
        """Copy external forces [N] and torques [N m], shapes (E, 3), to the device. They act until
        they are set again.

        Raises ValueError: another shape, or a simulator built without the extension "push"."""
        if "push" not in self.extensions:
            raise ValueError("an external wrench; expected a simulator with extension 'push'")
        zero = np.zeros(3)
        wrench = {"force_w": (force_w, zero), "torque_b": (torque_b, zero)}
        st.put(self.types, self.state, wrench, self.count)

    def get(self, name: str) -> ndarray:
        """Return a copy of a state or output array with the environment first: shape (E, ...) or
        (E, L, ...).
        """
        if name in st.STATE_FIELDS:
            return st.fetch(getattr(self.state, name))
        if name in st.OUTPUT_FIELDS:
            return st.fetch(getattr(self.out, name))
        raise ValueError(
            f"no array {name!r}; there are {sorted(st.STATE_FIELDS | st.OUTPUT_FIELDS)}"
        )

    def cable_points_w(self) -> ndarray:
        """Return the rope's joints from the mount to its lower end [m], shape (E, L + 1, 3), world
        frame.
        """
        ropes = self._plants.ropes.numpy()
        rows = np.arange(self.count) % len(ropes)
        q = self.get("quat_wb").astype(float)
        r = ropes["mount"][rows].astype(float)
        mount = self.get("pos_w") + r + 2 * np.cross(q[:, :3], np.cross(q[:, :3], r) + q[:, 3:] * r)
        steps = ropes["segment_length"][rows][:, None, None] * self.get("cable_dir_w")
        below = np.concatenate([np.zeros((self.count, 1, 3)), np.cumsum(steps, axis=1)], axis=1)
        return np.asarray(mount[:, None, :] + below)

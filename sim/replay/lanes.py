"""Launching the replay: parameters, windows, lanes and recorded data as arrays, split over the cores of a CPU."""

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from sim import runtime  # noqa: F401  starts Warp
from sim import state as st
from sim.checks import check_air, check_numerics, check_release
from sim.cores import cores
from sim.laws import check_laws, structure
from sim.params import GRAVITY, PlantParams, SensingParams
from sim.replay import kernel as rk
from sim.structs import kinds_of, pack, pack_air, pack_rope, pack_vehicle, ropes_on, types


@dataclass(frozen=True)
class Replayed:
    """What the lanes saw.

    With Nv, Np and Ng measured stamps of the vehicle, the payload and the gyro in a lane's window, its first
    ``2 Nv + Np + Ng`` rows hold: position [m] and attitude against the measured one (rotation vector [rad]) in turns,
    payload [m], rate [rad/s]. The rest is undefined.
    """

    seen: np.ndarray  # shape (rows, lanes, 3)
    ends: dict[str, np.ndarray]  # states at the end of the windows of lanes that keep, as ``starts``; others undefined
    knots: dict[str, np.ndarray]  # fields of KNOT_FIELDS at the knots of lanes that keep, by the rows of ``keep``


_BUILDS: dict = {}

FEW = 32
"""Lanes a core up to which a CPU has flown them all before a GPU has flown one: there each takes some 50 times as long."""


class Replay:
    """Replays windows of recorded flights with perturbed parameters, initial states and forces.

    Args:
        plants: parameters of the rows that lanes choose from; one choice of blocks and one number of segments.
        sensings: of the same rows.
        device: Warp device, "cpu" or "cuda:0"; with a GPU, runs of few lanes go to the CPU all the same.
        precision: "float64", in which differences of lanes do not drown in rounding, or "float32".
        gravity: [m/s^2].
        download: brings what the lanes saw to the host, hundreds of megabytes after a run of many.

    Raises:
        ValueError: plants of different blocks or segments, or an unphysical parameter.
    """

    def __init__(
        self,
        plants: Sequence[PlantParams],
        sensings: Sequence[SensingParams],
        device: str = "cpu",
        precision: str = "float64",
        gravity: float = GRAVITY,
        download: Callable[[wp.array], np.ndarray] = wp.array.numpy,
    ):
        first = plants[0]
        if len(sensings) != len(plants) or {p.rope.segments for p in plants} != {first.rope.segments}:
            raise ValueError(
                f"{len(plants)} plants of {sorted({p.rope.segments for p in plants})} segments with {len(sensings)} sensings: "
                "expected one number of segments and a sensing each"
            )
        check_numerics(first.sim)
        for plant in plants:
            check_release(plant.release)
            check_air(plant.air)
        self.device, self.gravity, self.segments, self._sim = device, gravity, first.rope.segments, first.sim
        self._download = download
        self.types = t = types(precision)
        kinds = kinds_of(first.vehicle)
        check_laws(first.laws)
        key = (precision, kinds, self.segments, structure(first.laws))
        if key not in _BUILDS:
            _BUILDS[key] = rk.build_replay(t, first.vehicle, self.segments, first.laws)
        self.kernel = _BUILDS[key]
        vehicles = [p.vehicle for p in plants]
        self._rows = {
            t.Vehicle: pack_vehicle(t, vehicles, kinds),
            t.Rope: pack_rope(t, ropes_on(vehicles, [p.rope for p in plants])),
            t.Release: pack(t.Release, *[p.release for p in plants]),
            t.Air: pack_air(t, [p.air for p in plants], [p.laws for p in plants]),
            self.kernel.Sensing: pack(self.kernel.Sensing, *sensings),
        }
        self._plants: dict[str, list[wp.array]] = {}

    def run(
        self,
        starts: Mapping[str, np.ndarray],
        windows: Mapping[str, np.ndarray],
        lanes: Mapping[str, np.ndarray],
        data: Mapping[str, np.ndarray],
        knot_spacing: float,
        knots: int = 1,
    ) -> Replayed:
        """Fly all lanes.

        Args:
            starts: fields of ``kernel.STATE_FIELDS``, shape (S, ...), rope fields (S, L, ...).
            windows: fields of ``kernel.WINDOW_FIELDS``, shape (W,).
            lanes: fields of ``kernel.LANE_FIELDS``, shape (lanes,).
            data: fields of ``kernel.DATA_FIELDS``, flights one after the other.
            knot_spacing: between knots of the latent forces [s].
            knots: rows of the knot arrays.
        """
        k = self.kernel
        count = len(lanes["window"])
        device = self.device if count > FEW * cores() else "cpu"
        if device not in self._plants:
            self._plants[device] = [wp.array(value, dtype=struct, device=device) for struct, value in self._rows.items()]
        w = np.asarray(lanes["window"])
        rows = 2 * windows["vehicle_count"] + windows["payload_count"] + windows["gyro_count"]
        height = max(int(np.max(rows[w])), 1)
        segments = {"cable_dir_w": self.segments, "cable_vel_w": self.segments, "stiffness": self.segments}
        keeping = count if np.any(np.asarray(lanes["keep"]) >= 0) else 1
        ends = st.allocate(self.types, k.State, rk.STATE_FIELDS, keeping, segments, device)
        held = st.allocate(self.types, k.Knots, rk.KNOT_FIELDS, knots, {}, device)
        out = wp.empty((height, count), dtype=self.types.vec3, device=device)
        resumed = np.asarray(lanes["resume"]) >= 0
        moments, vec3 = knots if np.any(resumed) else 0, self.types.vec3
        ropes = [wp.empty((moments, self.segments), dtype=kind, device=device) for kind in (vec3, vec3, self.types.real)]
        left_at = [wp.empty(moments, dtype=k.Moment, device=device), *ropes]
        marks = wp.zeros(count, dtype=k.Pointers, device=device)
        flown, resumed = _in_order(np.asarray(lanes["rides"]), resumed)
        order = wp.array(np.concatenate((flown, resumed)), dtype=wp.int32, device=device)
        numerics = [knot_spacing, self._sim.gamma, self._sim.max_turn, self.gravity]
        given = [
            self._struct(struct, fields, values, device) for struct, fields, values in (
                (k.State, rk.STATE_FIELDS, starts), (k.Windows, rk.WINDOW_FIELDS, windows),
                (k.Lanes, rk.LANE_FIELDS, lanes), (k.Data, rk.DATA_FIELDS, data),
            )
        ]  # fmt: skip
        for first, last in ((0, len(flown)), (len(flown), len(flown) + len(resumed))):
            self._launch(device, first, last, [*self._plants[device], *numerics, *given, order], [ends, held, marks, *left_at, out])
        return Replayed(self._download(out), self._read(ends, rk.STATE_FIELDS), self._read(held, rk.KNOT_FIELDS))

    def _launch(self, device: str, begin: int, end: int, before: list, after: list) -> None:
        """Some of the lanes, in one launch or one for each core: on the CPU it runs on one thread and leaves the others free."""
        if end <= begin:
            return
        if device != "cpu":
            wp.launch(self.kernel.replay, end - begin, [*before, begin, *after], device=device, block_dim=64)
            wp.synchronize_device(device)
            return
        self.kernel.replay.module.load("cpu")
        pieces = np.linspace(begin, end, min(4 * cores(), end - begin) + 1).astype(int)

        def launch(first: int, last: int) -> None:
            wp.launch(self.kernel.replay, last - first, [*before, int(first), *after], device="cpu")

        for done in [_pool(cores()).submit(launch, a, b) for a, b in zip(pieces[:-1], pieces[1:])]:
            done.result()

    def _struct(self, struct: type, fields: Mapping, values: Mapping[str, np.ndarray], device: str):
        t = self.types
        scalar = {"real": t.real, "int": wp.int32, "vec3": t.vec3, "vec4": t.vec4, "quat": t.quat}
        numpy = {"int": np.int32}
        real = np.float32 if t.real is wp.float32 else np.float64
        out = struct()
        for name, (kind, by_row) in fields.items():
            value = np.asarray(values[name], dtype=numpy.get(kind, real))
            value = np.ascontiguousarray(np.swapaxes(value, 0, 1) if by_row else value)
            setattr(out, name, wp.array(value, dtype=scalar[kind], device=device))
        return out

    @staticmethod
    def _read(struct, fields: Mapping) -> dict[str, np.ndarray]:
        return {
            name: np.swapaxes(getattr(struct, name).numpy(), 0, 1) if by_row else getattr(struct, name).numpy()
            for name, (_, by_row) in fields.items()
        }


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads that launch pieces; kept, since a fit of initial states flies some hundred times."""
    return ThreadPoolExecutor(threads, "replay")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a child process has none of these threads


def _in_order(rides: np.ndarray, resumed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lanes that fly, those from a start and those that leave another lane on its way; the rest ride along."""
    flies, number = np.ones(len(rides), dtype=bool), np.arange(len(rides))
    for lane in np.flatnonzero(rides > 0):
        flies[lane + 1 : lane + 1 + rides[lane]] = False
    return number[flies & ~resumed].astype(np.int32), number[flies & resumed].astype(np.int32)

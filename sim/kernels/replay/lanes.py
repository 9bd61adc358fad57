"""Launching the replay: parameters, windows, lanes and recorded data as arrays, split over the
cores of a CPU.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy import ndarray

from sim.cores import cores, launch_in_pieces
from sim.kernels import runtime  # noqa: F401  starts Warp
from sim.kernels import state as st
from sim.kernels.laws import check_laws, structure
from sim.kernels.replay import kernel as rk
from sim.kernels.structs import kinds_of, pack, pack_plants, plants_on, ropes_on, types
from sim.params import GRAVITY, PlantParams, SensingParams


@dataclass(frozen=True)
class Replayed:
    """The samples of all lanes.

    With Nv, Np and Ng measured stamps of the vehicle, the payload and the gyro in a lane's window,
    its first ``2 Nv + Np + Ng`` rows hold: position [m] and attitude against the measured one
    (rotation vector [rad]) in turns, payload [m], rate [rad/s]. The rest is undefined. ``ends`` and
    ``knots`` are empty where no lane keeps."""

    samples: ndarray  # shape (rows, lanes, 3)
    # states at the end of the windows of lanes that keep, as ``starts``; others undefined
    ends: dict[str, ndarray]
    # fields of KNOT_FIELDS at the knots of lanes that keep, by the rows of ``keep``
    knots: dict[str, ndarray]


class Recording:
    """Windows and the flights that they are of, brought to a device once for all runs; the arrays
    must not change.
    """

    def __init__(self, windows: Mapping[str, ndarray], data: Mapping[str, ndarray]):
        """Keep them.

        Args:
            windows: fields of ``kernel.WINDOW_FIELDS``, shape (W,).
            data: fields of ``kernel.DATA_FIELDS``, flights one after the other.
        """
        self.windows = windows
        self.data = data
        self.rows = 2 * windows["vehicle_count"] + windows["payload_count"] + windows["gyro_count"]
        self.seconds = windows["end"] - windows["start"]
        self._uploaded: dict[tuple[rk.ReplayKernel, str], tuple] = {}

    def upload(self, kernel: rk.ReplayKernel, device: str) -> tuple:
        """Return windows and recorded data as a kernel's structs on a device."""
        if (kernel, device) not in self._uploaded:
            windows = _struct(kernel.Windows, self.windows, device)
            self._uploaded[kernel, device] = windows, _struct(kernel.Data, self.data, device)
        return self._uploaded[kernel, device]


def still(count: int, segments: int) -> dict[str, ndarray]:
    """Return states at rest under a rope of so many segments, fields of ``kernel.STATE_FIELDS``."""
    shapes = {
        "real": (),
        "vec4": (4,),
        "quat": (4,),
        "real[]": (segments,),
        "vec3[]": (segments, 3),
    }
    state = {}
    for name, kind in rk.STATE_FIELDS.items():
        state[name] = np.zeros((count, *shapes.get(kind, (3,))))
    state["quat_wb"][:, 3] = 1.0
    state["cable_dir_w"][..., 2] = -1.0
    return state


_BUILDS: dict = {}

PIECES = 4  # of the lanes for each core of a CPU

# lanes a core up to which a CPU has flown them all before a GPU has flown one: there each takes
# some 50 times as long
SMALL_BATCH = 32


class Replay:
    """Replays windows of recorded flights with perturbed parameters, initial states and forces.

    Raises ValueError: plants of different blocks or segments, or an unphysical parameter.

    Args:
        plants: parameters of the rows that lanes choose from; one choice of blocks and one number
            of segments.
        sensings: of the same rows.
        device: Warp device, "cpu" or "cuda:0"; with a GPU, runs of few lanes go to the CPU all the
            same.
        gravity: [m/s^2].
        imposed: whether the recording holds the attitudes that the vehicles take, fields of
            ``kernel.IMPOSED_FIELDS``; commands then are motor speeds.
    """

    def __init__(
        self,
        plants: Sequence[PlantParams],
        sensings: Sequence[SensingParams],
        device: str = "cpu",
        gravity: float = GRAVITY,
        imposed: bool = False,
    ):
        first = plants[0]
        if len(sensings) != len(plants) or {p.rope.segments for p in plants} != {
            first.rope.segments
        }:
            raise ValueError(
                f"{len(plants)} plants of {sorted({p.rope.segments for p in plants})} segments with"
                f" {len(sensings)} sensings: expected one number of segments and a sensing each"
            )
        self.device = device
        self.segments = first.rope.segments
        self._sim = first.sim
        self._gravity = gravity
        self.types = t = types("float64")  # in which differences of lanes do not drown in rounding
        check_laws(first.laws, measured=imposed)
        key = (kinds_of(first.vehicle), self.segments, structure(first.laws), imposed)
        if key not in _BUILDS:
            _BUILDS[key] = rk.build_replay(t, first.vehicle, self.segments, first.laws, imposed)
        self.kernel = _BUILDS[key]
        vehicles = [p.vehicle for p in plants]
        self.rows = pack_plants(
            t,
            first,
            vehicles,
            ropes_on(vehicles, [p.rope for p in plants]),
            [p.air for p in plants],
            [p.release for p in plants],
            [p.laws for p in plants],
        )
        self.rows["sensings"] = pack(self.kernel.Sensing, *sensings)
        self._plants: dict[str, list] = {}

    def with_rows(self, rows: dict[str, ndarray]) -> "Replay":
        """Return the same replay with other parameters, structured arrays as in ``rows``."""
        other = copy.copy(self)
        other.rows = rows
        other._plants = {}
        return other

    def _plants_on(self, device: str) -> list:
        """Return plants and sensings on a device, copied once."""
        if device not in self._plants:
            rows = dict(self.rows)
            sensings = wp.array(rows.pop("sensings"), dtype=self.kernel.Sensing, device=device)
            plants = plants_on(self.types, rows, self._sim, self._gravity, device)
            self._plants[device] = [plants, sensings]
        return self._plants[device]

    def run(
        self,
        starts: Mapping[str, ndarray],
        recording: Recording,
        lanes: Mapping[str, ndarray],
        knot_spacing: float,
        knots: int = 1,
    ) -> Replayed:
        """Fly all lanes.

        Args:
            starts: fields of ``kernel.STATE_FIELDS``, shape (S, ...), rope fields (S, L, ...).
            recording: what is flown.
            lanes: fields of ``kernel.LANE_FIELDS``, shape (lanes,).
            knot_spacing: between knots of the latent forces [s].
            knots: rows of the knot arrays.
        """
        k = self.kernel
        t = self.types
        count = len(lanes["window"])
        device = self.device if count > SMALL_BATCH * cores() else "cpu"
        if device != "cpu":  # lanes that wait for others would double the time of the slowest
            lanes = {**lanes, "resume": np.full(count, -1)}
        w = np.asarray(lanes["window"])
        height = max(int(np.max(recording.rows[w])), 1)
        segments = dict.fromkeys(st.ROPE_FIELDS, self.segments)
        keeps = bool(np.any(np.asarray(lanes["keep"]) >= 0))
        if keeps:
            ends = st.allocate(k.State, count, device, segments)
            knot_states = st.allocate(k.Knots, knots, device)
        else:
            ends = k.State()
            knot_states = k.Knots()
        out = wp.empty((height, count), dtype=t.vec3, device=device)
        resumed = np.asarray(lanes["resume"]) >= 0
        moments = knots if np.any(resumed) else 0
        left_at = [
            wp.empty(moments, dtype=k.Moment, device=device),
            st.allocate(k.Ropes, moments, device, segments),
        ]
        marks = wp.empty(count, dtype=k.Pointers, device=device)
        costs = recording.seconds[w] / np.asarray(lanes["substep"])
        launches = [
            rows[np.argsort(-costs[rows], kind="stable")]
            for rows in _lane_order(np.asarray(lanes["shared"]), resumed)
        ]
        order = wp.array(np.concatenate(launches), dtype=wp.int32, device=device)
        begin = _struct(k.State, starts, device)
        flown = _struct(k.Lanes, lanes, device)
        windows, data = recording.upload(k, device)
        before = [*self._plants_on(device), knot_spacing, begin, windows, flown, data, order]
        after = [ends, knot_states, marks, *left_at, out]
        first = 0
        for rows in launches:
            self._launch(device, first, costs[rows], before, after)
            first += len(rows)
        if not keeps:
            return Replayed(out.numpy(), {}, {})
        return Replayed(out.numpy(), _read(ends, k.State), _read(knot_states, k.Knots))

    def _launch(self, device: str, begin: int, costs: ndarray, before: list, after: list) -> None:
        """Some of the lanes, in one launch or a few for each core: on the CPU it runs on one thread
        and leaves the others free.

        Args:
            device: to launch on.
            begin: place of the first in the order.
            costs: of each, in any unit; the longest come first, so that no core is left with one of
                them in the end.
            before: arguments that come before the place of the first.
            after: those that come after it.
        """
        if not len(costs):
            return
        inputs = [*before, begin, *after]
        kernel = self.kernel.replay
        if device != "cpu":
            wp.launch(kernel, len(costs), inputs, device=device, block_dim=64)
            wp.synchronize_device(device)
            return
        whole = wp.launch(kernel, len(costs), inputs, device="cpu", record_cmd=True)

        def launch(first: int, last: int) -> None:
            # packed once: that of each piece took longer than a lane's flight, with Python held
            piece = copy.copy(whole)
            piece.params = list(whole.params)
            piece.set_dim(last - first)
            piece.set_param_at_index(len(before), begin + first)
            piece.launch()

        launch_in_pieces(launch, _share_out(costs, PIECES * cores()), cores())


def _read(struct: Any, kind: Any) -> dict[str, ndarray]:
    """Arrays of a struct on the host, lane first."""
    return {name: st.fetch(getattr(struct, name)) for name in kind.vars}


def _struct(struct: Any, values: Mapping[str, ndarray], device: str) -> Any:
    """Arrays of the values, float64 or int32, in an instance of a struct."""
    out = struct()
    for name, field in struct.vars.items():
        kind = field.type
        value = np.asarray(values[name], dtype=np.int32 if kind.dtype is wp.int32 else np.float64)
        value = np.ascontiguousarray(np.swapaxes(value, 0, 1) if kind.ndim == 2 else value)
        setattr(out, name, wp.array(value, dtype=kind.dtype, device=device, copy=device != "cpu"))
    return out


def _share_out(costs: ndarray, pieces: int) -> list[int]:
    """Bounds of at most so many runs of lanes that cost about the same, each of at
    least one lane.
    """
    total = np.cumsum(costs)
    cuts = np.searchsorted(total, total[-1] / pieces * np.arange(1, pieces)) + 1
    return np.unique([0, *cuts.tolist(), len(costs)]).tolist()


def _lane_order(shared: ndarray, resumed: ndarray) -> tuple[ndarray, ndarray]:
    """Lanes that fly, those from a start and those that leave another lane on its way; the rest
    ride along.
    """
    flies = np.ones(len(shared), dtype=bool)
    number = np.arange(len(shared))
    for lane in np.flatnonzero(shared > 0):
        flies[lane + 1 : lane + 1 + shared[lane]] = False
    return number[flies & ~resumed].astype(np.int32), number[flies & resumed].astype(np.int32)

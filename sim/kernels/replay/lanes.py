"""Launch of the replay kernel: arrays of parameters, windows, lanes and recorded data; distribution
over the cores of a CPU.
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

    A lane's window has Nv, Np and Ng measured stamps of the vehicle, the payload and the gyro. The
    first ``2 Nv + Np + Ng`` rows hold, alternately, position [m] and attitude relative to the
    measured one (rotation vector [rad]), then the payload's position [m], then the rate [rad/s].
    The other rows are undefined. ``ends`` and ``knots`` are empty if no lane keeps its states."""

    samples: ndarray  # shape (rows, lanes, 3)
    # states at the end of the windows, fields as in ``starts``; undefined for lanes that do not
    # keep their states
    ends: dict[str, ndarray]
    # fields of KNOT_FIELDS at the knots of lanes that keep their states, in the rows of ``keep``
    knots: dict[str, ndarray]


class Recording:
    """Windows and recorded flights, copied to a device once for all runs. The arrays must not
    change.
    """

    def __init__(self, windows: Mapping[str, ndarray], data: Mapping[str, ndarray]):
        """Create a recording.

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
    """Return ``count`` states at rest with a straight rope, fields of ``kernel.STATE_FIELDS``."""
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

PIECES = 4  # launches for each core of a CPU

# largest number of lanes per core for which a CPU is faster than a GPU, where one lane takes about
# 50 times as long
SMALL_BATCH = 32


class Replay:
    """A replay of windows of recorded flights with perturbed parameters, initial states and forces.

    Raises ValueError: plants differ in blocks or segments, or a parameter is unphysical.

    Args:
        plants: parameters, one for each row that a lane may select; all with the same kinds of
            blocks and number of segments.
        sensings: one for each plant.
        device: Warp device, "cpu" or "cuda:0"; runs with few lanes use the CPU in any case.
        gravity: [m/s^2].
        imposed: whether the recording imposes attitudes, fields of ``kernel.IMPOSED_FIELDS``;
            commands are motor speeds then.
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
        self.types = t = types("float64")  # so that differences between lanes exceed rounding
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
        """Return a copy of the replay with other parameters, structured arrays as in ``rows``."""
        other = copy.copy(self)
        other.rows = rows
        other._plants = {}
        return other

    def _plants_on(self, device: str) -> list:
        """Return plants and sensings on a device, cached."""
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
        """Simulate all lanes.

        Args:
            starts: fields of ``kernel.STATE_FIELDS``, shape (S, ...), rope fields (S, L, ...).
            recording: windows and recorded data.
            lanes: fields of ``kernel.LANE_FIELDS``, shape (lanes,).
            knot_spacing: time between knots of the latent forces [s].
            knots: number of rows of the knot arrays.
        """
        k = self.kernel
        t = self.types
        count = len(lanes["window"])
        device = self.device if count > SMALL_BATCH * cores() else "cpu"
        if device != "cpu":  # waiting for the parents would double the time of the slowest lane
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
        """Launch a part of the lanes: once on a GPU, and in several pieces per core on a CPU, where
        a launch uses one thread.

        Args:
            device: Warp device.
            begin: index of the first lane in the order.
            costs: of each lane, in any unit, in descending order, so that no core begins a long
                lane at the end.
            before: arguments before the index of the first lane.
            after: arguments after it.
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
            # The arguments are packed once. To pack them for each piece would take longer than a
            # lane's flight, and with Python's lock held.
            piece = copy.copy(whole)
            piece.params = list(whole.params)
            piece.set_dim(last - first)
            piece.set_param_at_index(len(before), begin + first)
            piece.launch()

        launch_in_pieces(launch, _share_out(costs, PIECES * cores()), cores())


def _read(struct: Any, kind: Any) -> dict[str, ndarray]:
    """Copy the arrays of a struct to the host, with the lane first."""
    return {name: st.fetch(getattr(struct, name)) for name in kind.vars}


def _struct(struct: Any, values: Mapping[str, ndarray], device: str) -> Any:
    """Return an instance of a struct with arrays of the values, float64 or int32, on a device."""
    out = struct()
    for name, field in struct.vars.items():
        kind = field.type
        value = np.asarray(values[name], dtype=np.int32 if kind.dtype is wp.int32 else np.float64)
        value = np.ascontiguousarray(np.swapaxes(value, 0, 1) if kind.ndim == 2 else value)
        setattr(out, name, wp.array(value, dtype=kind.dtype, device=device, copy=device != "cpu"))
    return out


def _share_out(costs: ndarray, pieces: int) -> list[int]:
    """Return the bounds of at most ``pieces`` ranges of lanes of about equal cost, each with at
    least one lane.
    """
    total = np.cumsum(costs)
    cuts = np.searchsorted(total, total[-1] / pieces * np.arange(1, pieces)) + 1
    return np.unique([0, *cuts.tolist(), len(costs)]).tolist()


def _lane_order(shared: ndarray, resumed: ndarray) -> tuple[ndarray, ndarray]:
    """Return the lanes to be simulated from a start, and those that continue another lane. The
    remaining lanes share the flight of another.
    """
    flies = np.ones(len(shared), dtype=bool)
    number = np.arange(len(shared))
    for lane in np.flatnonzero(shared > 0):
        flies[lane + 1 : lane + 1 + shared[lane]] = False
    return number[flies & ~resumed].astype(np.int32), number[flies & resumed].astype(np.int32)

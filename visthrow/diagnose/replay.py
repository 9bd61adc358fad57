"""Recorded flights cut into windows, ready to be replayed in any setting: the arrays that all lanes of a batch share."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim.replay.kernel import ATTACHED, LOOSE, NO_PAYLOAD, WINDOW_FIELDS
from sim.replay.lanes import Replay, Replayed
from visthrow.diagnose.catalogue import Setting
from visthrow.diagnose.cutting import Cut
from visthrow.diagnose.recorded import NEVER, Recorded, Samples
from visthrow.diagnose.states import States, rows_of

KNOT_SPACING = 0.1  # of the latent forces [s]
EARLY = 0.004  # after a window's start, before which no stamp is used: delays may move there [s]
FINENESS = {"throw": 0.25}
"""Step in a phase against the one asked for: the rope whips in throws."""
FINEST = 0.01  # of the square of the step: a tenth of the step asked for
BATCH, CUDA_BATCH = 4096, 32768  # lanes of one run, which bounds its memory; on a GPU more lanes cost hardly more time


@dataclass(frozen=True)
class Lane:
    """What one lane of a batch flies."""

    window: int
    plant: int  # row of the settings
    state: int  # row of the states
    axis: int = -1  # of its latent force
    knot: int = 0
    size: float = 0.0
    keep: int = -1
    resume: int = -1  # row of what another lane keeps, at which this one leaves it
    parent: int = -1  # that lane
    rides: int = 0  # lanes after it that fly alike and see it otherwise


class Flights:
    """Windows of recorded flights as the replay's arrays.

    Attributes:
        cuts: the windows. knots: of each window, shape (W,). rows: of output of each window, in vectors.
    """

    def __init__(self, flights: Sequence[Recorded], cuts: Sequence[Cut], delays: tuple[float, float, float], stride: int = 1):
        """Lay out flights and windows.

        Args:
            flights: all of them.
            cuts: windows, by number of the flight.
            delays: of vehicle, payload and gyro that the setting knows of [s].
            stride: use every so many samples.
        """
        self.flights, self.cuts, self.stride = list(flights), list(cuts), stride
        self.knots = np.array([int(np.ceil((c.end - c.start) / KNOT_SPACING - 1e-6)) + 1 for c in cuts])
        self._fineness = np.array([FINENESS.get(c.phase, 1.0) for c in cuts])
        lengths = np.cumsum([0] + [len(f.command_time) for f in self.flights])
        self.windows = {name: np.zeros(len(self.cuts)) for name in WINDOW_FIELDS}
        empty = np.zeros((0, 3))
        parts: dict[str, list[Samples]] = {"vehicle": [], "attitude": [], "payload": [], "gyro": []}
        counts = {"vehicle": 0, "payload": 0, "gyro": 0}
        for w, c in enumerate(self.cuts):
            f = self.flights[c.flight]
            given = {
                "start": c.start, "end": c.end, "first_knot": c.start, "knots": self.knots[w], "payload": c.payload,
                "latch": f.latch if c.payload == ATTACHED else NEVER, "clock_zero": f.start,
                "command_first": lengths[c.flight], "command_last": lengths[c.flight + 1],
            }  # fmt: skip
            sources = {"vehicle": f.vehicle, "payload": f.payload if c.payload in (ATTACHED, LOOSE) else None, "gyro": f.gyro}
            for (name, source), delay in zip(sources.items(), delays):
                rows = self._rows(source, c, delay)
                given |= {f"{name}_first": counts[name], f"{name}_count": len(rows)}
                counts[name] += len(rows)
                chosen = source or Samples(np.zeros(0), empty, 1.0)
                parts[name].append(Samples(chosen.time[rows], chosen.values[rows], chosen.sigma))
                if name == "vehicle":
                    parts["attitude"].append(Samples(f.attitude.time[rows], f.attitude.values[rows], f.attitude.sigma))
            for name, value in given.items():
                self.windows[name][w] = value
        self.windows = {k: v.astype(int) if WINDOW_FIELDS[k][0] == "int" else v for k, v in self.windows.items()}
        self.samples = parts
        self.rows = 2 * self.windows["vehicle_count"] + self.windows["payload_count"] + self.windows["gyro_count"]
        self.data = {
            "command_time": np.concatenate([f.command_time for f in self.flights]),
            "command": np.concatenate([f.command for f in self.flights]),
            "vehicle_time": self._joined("vehicle").time, "vehicle_quat": self._joined("attitude").values,
            "payload_time": self._joined("payload").time, "gyro_time": self._joined("gyro").time,
        }  # fmt: skip

    def _rows(self, source: Samples | None, c: Cut, delay: float) -> np.ndarray:
        if source is None:
            return np.zeros(0, dtype=int)
        span = source.between(c.start + delay + EARLY, c.end + delay)
        return np.arange(span.start, span.stop, self.stride)

    def alike(self, w: int, setting: Setting, other: Setting) -> bool:
        """Whether a window is flown alike in two settings, which may be seen otherwise: what differs does nothing in it."""
        c, plant = self.cuts[w], other.plant
        if setting.step_square != other.step_square:
            return False
        if c.payload == NO_PAYLOAD and not plant.laws:
            plant = replace(plant, rope=setting.plant.rope, release=setting.plant.release)
        elif c.payload == ATTACHED and self.flights[c.flight].latch >= c.end:
            plant = replace(plant, release=setting.plant.release)
        return plant == setting.plant

    def _joined(self, name: str) -> Samples:
        parts = self.samples[name]
        return Samples(np.concatenate([p.time for p in parts]), np.concatenate([p.values for p in parts]), 1.0)

    def time(self, w: int) -> np.ndarray:
        """Stamps of a window's samples [s], shape (N,)."""
        s = self.samples
        return self.spread(w, s["vehicle"][w].time, s["vehicle"][w].time, s["payload"][w].time, s["gyro"][w].time)

    def sigma(self, w: int) -> np.ndarray:
        """Noise of a window's samples, shape (N,)."""
        return self.spread(w, *[self.samples[name][w].sigma for name in ("vehicle", "attitude", "payload", "gyro")])

    def spread(self, w: int, vehicle, attitude, payload, gyro) -> np.ndarray:
        """A number for every sample of a window, from one for each row of its groups."""
        s = self.samples
        pairs = np.stack(np.broadcast_arrays(vehicle, attitude), axis=-1).ravel()
        counts = len(s["vehicle"][w].time), len(s["payload"][w].time), len(s["gyro"][w].time)
        if pairs.size == 2:
            pairs = np.tile(pairs, counts[0])
        rest = [np.broadcast_to(value, count) for value, count in zip((payload, gyro), counts[1:])]
        return np.repeat(np.concatenate((pairs, *rest)), 3)

    def residual(self, seen: np.ndarray, w: int, lane: int) -> np.ndarray:
        """Measured minus simulated, shape (N,); of an attitude the rotation vector from the simulated to the measured."""
        nv, rows = int(self.windows["vehicle_count"][w]), int(self.rows[w])
        measured = np.zeros((rows, 3))
        measured[0 : 2 * nv : 2] = self.samples["vehicle"][w].values
        measured[2 * nv :] = np.concatenate((self.samples["payload"][w].values, self.samples["gyro"][w].values))
        return (measured - seen[:rows, lane]).ravel()

    def fly(self, replay: Replay, settings: Sequence[Setting], states: States, lanes: Sequence[Lane], substep: float) -> Replayed:
        """Fly lanes; ``settings`` are those of the replay's rows.

        Args:
            replay: built of the settings' plants and sensings.
            settings: whose step sizes count.
            states: initial states that the lanes choose from.
            lanes: at most some thousand, for the memory's sake.
            substep: largest integration step [s].
        """
        step = substep * np.sqrt([max(s.step_square, FINEST) for s in settings])
        given = {
            "window": np.array([x.window for x in lanes]), "plant": np.array([x.plant for x in lanes]),
            "state": np.array([x.state for x in lanes]), "axis": np.array([x.axis for x in lanes]),
            "knot": np.array([x.knot for x in lanes]), "size": np.array([x.size for x in lanes]),
            "keep": np.array([x.keep for x in lanes]), "resume": np.array([x.resume for x in lanes]),
            "parent": np.array([x.parent for x in lanes]), "rides": np.array([x.rides for x in lanes]),
            "substep": step[[x.plant for x in lanes]] * self._fineness[[x.window for x in lanes]],
        }  # fmt: skip
        knots = max([1, *[x.keep + int(self.knots[x.window]) for x in lanes if x.keep >= 0]])
        return replay.run(states, self.windows, given, self.data, KNOT_SPACING, knots)


def carried(flights: Flights, replay: Replay, setting: Setting, begin, substep: float) -> States:
    """Initial states of all windows: measured poses, and inner states carried through the windows before.

    Args:
        flights: the windows, those of one flight in order of time.
        replay: whose row 0 is the setting.
        setting: what is simulated.
        begin: function ``(flight, cut, inner or None)`` -> one state, with ``inner`` the end of the window before.
        substep: largest integration step [s].
    """
    by_flight: dict[int, list[int]] = {}
    for w, c in enumerate(flights.cuts):
        by_flight.setdefault(c.flight, []).append(w)
    states: list[States | None] = [None] * len(flights.cuts)
    ends: dict[int, States | None] = dict.fromkeys(by_flight)
    for k in range(max(map(len, by_flight.values()))):
        now = {f: ws[k] for f, ws in by_flight.items() if k < len(ws)}
        for f, w in now.items():
            inner = ends[f]
            if k > 0 and flights.cuts[w].start > flights.cuts[by_flight[f][k - 1]].end + 1e-6:
                inner = None  # a gap: the inner states have gone
            states[w] = begin(flights.flights[f], flights.cuts[w], inner)
        batch = {name: np.concatenate([states[w][name] for w in now.values()]) for name in states[next(iter(now.values()))]}
        lanes = [Lane(w, 0, row, keep=0) for row, w in enumerate(now.values())]
        flown = flights.fly(replay, [setting], batch, lanes, substep)
        for row, f in enumerate(now):
            ends[f] = {name: value.copy() for name, value in rows_of(flown.ends, np.array([row])).items()}
    return {name: np.concatenate([s[name] for s in states]) for name in states[0]}

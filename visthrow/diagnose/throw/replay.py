"""Recorded flights cut into windows, ready to be replayed in any setting: the arrays that all lanes
of a batch share.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from sim.effects.setting import Setting
from sim.kernels.replay.kernel import ATTACHED, LOOSE, NO_PAYLOAD, WINDOW_FIELDS
from sim.kernels.replay.lanes import Recording, Replay, Replayed
from visthrow.diagnose.likelihood.transfer import to_host
from visthrow.diagnose.throw.cutting import Cut
from visthrow.diagnose.throw.initial_states import (
    States,
    hover_state,
    measured_state,
    rows_of,
    stacked,
)
from visthrow.diagnose.throw.recorded_flight import NEVER, ChannelSamples, RecordedFlight

KNOT_SPACING = 0.1  # of the latent forces [s]
EARLY = 0.004  # after a window's start, before which no stamp is used: delays may move there [s]
FINENESS = {"throw": 0.25}  # step in a phase against the one asked for: the rope whips in throws
FINEST = 0.01  # of the square of the step: a tenth of the step asked for
# added to the square of the step, in the nominal one, of rough lanes: twice as long steps
ROUGHER = 3.0
# shortest lags of the vehicle's filters and rotors, above which a rough step may not go
STABLE = 1.75
BATCH, CUDA_BATCH = (
    4096,
    32768,
)  # lanes of one run, which bounds its memory; on a GPU more lanes cost hardly more time


def downloaded(array: wp.array) -> np.ndarray:
    """Copy an array that a replay wrote to the host."""
    return to_host(wp.to_torch(array)) if array.device.is_cuda else array.numpy()


def rough_step(setting: Setting, substep: float) -> float:
    """Length of a rough lane's steps [s]: twice the nominal one, as far as the vehicle's shortest
    lag allows.
    """
    controller = setting.plant.vehicle.controller
    motor = setting.plant.vehicle.motor
    lags = (
        [controller.gyro_time_constant, controller.setpoint_time_constant]
        if controller.kind != "geometric"
        else []
    )
    lags += [motor.time_constant] if motor.kind != "instant" else []
    lags += [motor.time_constant_down] if motor.kind == "asymmetric" else []
    nominal = substep * np.sqrt(max(setting.step_square, FINEST))
    longer = substep * np.sqrt(max(setting.step_square, FINEST) + ROUGHER)
    return max(nominal, min([longer, *[STABLE * lag for lag in lags]]))


class Simulation:
    """Plants and sensors that lanes are flown with.

    Attributes:
        settings: a lane names its by the row.
    """

    def __init__(
        self,
        settings: Sequence[Setting],
        substep: float,
        device: str,
        download: Callable[[wp.array], Any] = downloaded,
    ):
        """Move them to a device.

        ``substep``: largest integration step [s]; ``download``: makes of the device's arrays what
        flights return."""
        self.settings = list(settings)
        self.replay = Replay(
            [s.plant for s in settings], [s.sensing for s in settings], device, download=download
        )
        self.steps = np.array(
            [
                (substep * np.sqrt(max(s.step_square, FINEST)), rough_step(s, substep))
                for s in settings
            ]
        )


class Lane(NamedTuple):
    """The settings of one lane of a batch; there are some ten thousand in a run."""

    window: int
    plant: int  # row of the settings
    state: int  # row of the states
    axis: int = -1  # of its latent force
    knot: int = 0
    size: float = 0.0
    keep: int = -1
    resume: int = -1  # row of what another lane keeps, at which this one leaves it
    parent: int = -1  # that lane
    shared: int = 0  # lanes after it that share its flight and differ in what sensors show of it
    rough: bool = False  # whether it flies with longer steps


class ReplayedFlights:
    """Windows of recorded flights as the replay's arrays.

    Attributes:
        cuts: the windows. knots: of each window, shape (W,). rows: of output of each window, in
            vectors. recording: for a replay.
        time: stamps of each window's samples [s], shape (N,). sigma: their noise.
    """

    def __init__(
        self,
        flights: Sequence[RecordedFlight],
        cuts: Sequence[Cut],
        delays: tuple[float, float, float],
    ):
        """Lay out flights and windows.

        ``delays``: of vehicle, payload and gyro that the setting knows of [s].
        """
        self.flights = list(flights)
        self.cuts = list(cuts)
        self.knots = np.array(
            [int(np.ceil((c.end - c.start) / KNOT_SPACING - 1e-6)) + 1 for c in cuts]
        )
        self._fineness = np.array([FINENESS.get(c.phase, 1.0) for c in cuts])
        lengths = np.cumsum([0] + [len(f.command_time) for f in self.flights])
        names = ("vehicle", "attitude", "payload", "gyro")
        parts: dict[str, list[ChannelSamples]] = {name: [] for name in names}
        rows = []
        for w, c in enumerate(self.cuts):
            f = self.flights[c.flight]
            payload = f.payload if c.payload in (ATTACHED, LOOSE) else None
            sources = (f.vehicle, f.attitude, payload, f.gyro)
            for name, source, delay in zip(names, sources, (delays[0], *delays)):
                samples = source or ChannelSamples(np.zeros(0), np.zeros((0, 3)), 1.0)
                span = samples.between(c.start + delay + EARLY, c.end + delay)
                parts[name].append(
                    ChannelSamples(samples.time[span], samples.values[span], samples.sigma)
                )
            rows.append(
                {
                    "start": c.start,
                    "end": c.end,
                    "first_knot": c.start,
                    "knots": self.knots[w],
                    "payload": c.payload,
                    "latch": f.latch if c.payload == ATTACHED else NEVER,
                    "clock_zero": f.start,
                    "command_first": lengths[c.flight],
                    "command_last": lengths[c.flight + 1],
                }
            )
        fields = {name: np.array([row[name] for row in rows]) for name in rows[0]}
        for name, pieces in parts.items():
            counts = np.array([len(piece.time) for piece in pieces])
            fields |= {f"{name}_first": np.cumsum(counts) - counts, f"{name}_count": counts}
        self.windows = {
            name: fields[name].astype(int if kind[0] == "int" else float)
            for name, kind in WINDOW_FIELDS.items()
        }
        self.samples = parts
        data = {
            "command_time": np.concatenate([f.command_time for f in self.flights]),
            "command": np.concatenate([f.command for f in self.flights]),
            "vehicle_time": self._joined("vehicle").time,
            "vehicle_quat": self._joined("attitude").values,
            "payload_time": self._joined("payload").time,
            "gyro_time": self._joined("gyro").time,
        }
        self.recording = Recording(self.windows, data)
        self.rows = self.recording.rows
        self.time = self._of_samples("time", ("vehicle", "vehicle", "payload", "gyro"))
        self.sigma = self._of_samples("sigma", ("vehicle", "attitude", "payload", "gyro"))
        pairs = [
            np.stack((samples.values, np.zeros_like(samples.values)), axis=1).reshape(-1, 3)
            for samples in parts["vehicle"]
        ]
        self._measured = [
            np.concatenate((samples, p.values, g.values))
            for samples, p, g in zip(pairs, parts["payload"], parts["gyro"])
        ]

    def _of_samples(self, what: str, names: Sequence[str]) -> list[np.ndarray]:
        groups = zip(
            *([getattr(channel, what) for channel in self.samples[name]] for name in names)
        )
        return [self.spread(w, *channel) for w, channel in enumerate(groups)]

    def like(self, w: int) -> tuple[int, bool]:
        """Return what :meth:`alike` depends on: the same of two windows, the same answer."""
        c = self.cuts[w]
        return c.payload, self.flights[c.flight].latch >= c.end

    def alike(self, w: int, setting: Setting, second: Setting) -> bool:
        """Whether a window is flown alike in two settings, which may be seen otherwise: what
        differs does nothing in it.
        """
        c = self.cuts[w]
        plant = second.plant
        if setting.step_square != second.step_square:
            return False
        if c.payload == NO_PAYLOAD and not plant.laws:
            plant = replace(plant, rope=setting.plant.rope, release=setting.plant.release)
        elif c.payload == ATTACHED and self.flights[c.flight].latch >= c.end:
            plant = replace(plant, release=setting.plant.release)
        return plant == setting.plant

    def _joined(self, name: str) -> ChannelSamples:
        parts = self.samples[name]
        return ChannelSamples(
            np.concatenate([p.time for p in parts]), np.concatenate([p.values for p in parts]), 1.0
        )

    def spread(self, w: int, vehicle, attitude, payload, gyro) -> np.ndarray:
        """A number for every sample of a window, from one for each row of its groups."""
        s = self.samples
        pairs = np.stack(np.broadcast_arrays(vehicle, attitude), axis=-1).ravel()
        counts = len(s["vehicle"][w].time), len(s["payload"][w].time), len(s["gyro"][w].time)
        if pairs.size == 2:
            pairs = np.tile(pairs, counts[0])
        remaining = [
            np.broadcast_to(value, count) for value, count in zip((payload, gyro), counts[1:])
        ]
        return np.repeat(np.concatenate((pairs, *remaining)), 3)

    def residual(self, measured: np.ndarray, w: int, lane: int) -> np.ndarray:
        """Measured minus simulated, shape (N,); of an attitude the rotation vector from the
        simulated to the measured.
        """
        return (self._measured[w] - measured[: int(self.rows[w]), lane]).ravel()

    def fly(
        self,
        simulation: Simulation,
        states: States,
        lanes: Sequence[Lane],
        recording: Recording | None = None,
    ) -> Replayed:
        """Fly lanes.

        Args:
            simulation: whose settings the lanes choose from.
            states: initial states that the lanes choose from.
            lanes: at most some thousand, for the memory's sake.
            recording: the windows, if not as they are.
        """
        columns = {name: np.array(values) for name, values in zip(Lane._fields, zip(*lanes))}
        columns["substep"] = (
            simulation.steps[columns["plant"], columns.pop("rough").astype(int)]
            * self._fineness[columns["window"]]
        )
        retained = columns["keep"] >= 0
        knots = max(
            1, int(np.max((columns["keep"] + self.knots[columns["window"]])[retained], initial=1))
        )
        return simulation.replay.run(
            states, recording or self.recording, columns, KNOT_SPACING, knots
        )

    def repeated(self, windows: np.ndarray) -> "ReplayedFlights":
        """Return the flights as they concern :meth:`fly`, with windows that stand there more than
        once.
        """
        flights = copy.copy(self)
        flights.knots = self.knots[windows]
        flights._fineness = self._fineness[windows]
        return flights

    def ended(self, ends: Sequence[float]) -> Recording:
        """The windows that end earlier [s]; what is seen afterwards says nothing."""
        return Recording(self.windows | {"end": np.array(ends)}, self.recording.data)


def carried(flights: ReplayedFlights, simulation: Simulation) -> tuple[States, States]:
    """Initial states of all windows: smoothed measurements and, for what nobody measures, what
    flying through the windows before gives.

    ``flights``: the windows, those of one flight in order of time; ``simulation``: of one setting.
    Returns the states, and those at the windows' ends that they lead to.
    """
    (setting,) = simulation.settings
    by_flight: dict[int, list[int]] = {}
    for w, c in enumerate(flights.cuts):
        by_flight.setdefault(c.flight, []).append(w)
    states: list[States | None] = [None] * len(flights.cuts)
    ends: list[States | None] = [None] * len(flights.cuts)
    for k in range(max(map(len, by_flight.values()))):
        windows = [ws[k] for ws in by_flight.values() if k < len(ws)]
        for w in windows:
            c = flights.cuts[w]
            flight = flights.flights[c.flight]
            before = by_flight[c.flight][k - 1] if k else None
            gap = (
                before is None or c.start > flights.cuts[before].end + 1e-6
            )  # in which the inner states have gone
            inner = hover_state(flight, setting.plant, c.payload) if gap else ends[before]
            states[w] = measured_state(flight, c.start, setting, c.payload, inner)
            if gap:
                states[w]["gyro"] = states[w]["rate_b"].copy()
        lanes = [Lane(w, 0, row, keep=0) for row, w in enumerate(windows)]
        flown = flights.fly(simulation, stacked([states[w] for w in windows]), lanes)
        for row, w in enumerate(windows):
            ends[w] = {
                name: value.copy() for name, value in rows_of(flown.ends, np.array([row])).items()
            }
    return stacked(states), stacked(ends)

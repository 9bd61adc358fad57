"""Replay windows of recorded flights in batches of lanes.

A lane is one simulation of one window, with its own setting and initial state. All lanes share the
arrays of recorded commands and stamps."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby, zip_longest
from typing import NamedTuple

import numpy as np
from numpy import ndarray

from sim.effects.setting import Setting
from sim.kernels.replay.kernel import ATTACHED, LOOSE, NO_PAYLOAD
from sim.kernels.replay.lanes import Recording, Replay, Replayed
from visthrow.diagnose.models.model_interface import Indices
from visthrow.diagnose.throw.cutting import Cut
from visthrow.diagnose.throw.initial_states import (
    MOVED,
    States,
    directions,
    hover_state,
    measured_state,
    rows_of,
    stack,
)
from visthrow.diagnose.throw.recorded_flight import (
    NEVER,
    NO_SAMPLES,
    ChannelSamples,
    RecordedFlight,
)

KNOT_SPACING = 0.1  # of the latent forces [s]
EARLY = 0.004  # samples this soon after a window's start are not used: delays may shift them [s]
LATEST = 1.0  # largest delay or lead of commands [s]; a window reads no others
# factors on the nominal and on the rough step in a phase: the rope whips in throws
FINENESS = {"throw": (0.25, 0.5)}
FINEST = 0.01  # smallest factor on the square of the step: a tenth of the requested step
# added to that factor for rough lanes, whose steps are twice as long
ROUGHER = 3.0
# longest rough step, in multiples of the shortest lag of the vehicle's filters and rotors
STABLE = 1.75
# lanes of one run, which limits its memory; on a GPU, more lanes take hardly more time
BATCH, CUDA_BATCH = 4096, 32768


def split_windows(windows: Indices, lanes: Indices, room: int) -> list[list[int]]:
    """Split windows into runs of at most ``room`` lanes, or of one window; ``lanes``: number of
    lanes of each window.
    """
    groups = []
    spare = 0
    for w, count in zip(windows, lanes):
        if not groups or spare < count:
            groups.append([])
            spare = room
        groups[-1].append(w)
        spare -= count
    return groups


def step_lengths(setting: Setting, substep: float) -> tuple[float, float]:
    """Return the lengths of nominal and rough steps [s]. Rough ones are twice as long, unless the
    vehicle's shortest lag forbids it.
    """
    controller = setting.plant.vehicle.controller
    motor = setting.plant.vehicle.motor
    lags = []
    if controller.kind != "geometric":
        lags += [controller.gyro_time_constant, controller.setpoint_time_constant]
    if motor.kind != "instant":
        lags.append(motor.time_constant)
    if motor.kind == "asymmetric":
        lags.append(motor.time_constant_down)
    square = max(setting.step_square, FINEST)
    nominal = substep * np.sqrt(square)
    longer = substep * np.sqrt(square + ROUGHER)
    stable = [STABLE * lag for lag in lags]
    return nominal, max(nominal, min([longer, *stable]))


class Simulation:
    """Plants and sensors for the lanes of a run.

    Attributes:
        settings: a lane refers to one of them by its index.
    """

    def __init__(self, settings: Sequence[Setting], substep: float, device: str):
        """Copy the settings to a device; ``substep``: largest integration step [s]."""
        self.settings = list(settings)
        self.replay = Replay([s.plant for s in settings], [s.sensing for s in settings], device)
        self.steps = np.array([step_lengths(s, substep) for s in settings])


class Lane(NamedTuple):
    """One simulation of one window; a run has some ten thousand lanes."""

    window: int
    plant: int  # row of the settings
    state: int  # row of the states
    axis: int = -1  # of its latent force
    knot: int = 0
    size: float = 0.0
    keep: int = -1
    resume: int = -1  # row of another lane's stored states at which this lane branches off
    parent: int = -1  # that other lane
    shared: int = 0  # number of following lanes with the same flight and other sensors
    rough: bool = False  # whether its steps are longer
    skip: int = -1  # index of a command that is lost: the previous one stays in force


class ReplayedFlights:
    """Windows of recorded flights as the replay's arrays.

    Attributes:
        cuts: the windows. knots: number of knots of each window, shape (W,). rows: number of output
            vectors of each window. recording: arrays for the replay. first_command: index of each
            flight's first command. time: stamps of each window's samples [s], shape (N,). sigma:
            their noise.
    """

    def __init__(
        self,
        flights: Sequence[RecordedFlight],
        cuts: Sequence[Cut],
        setting: Setting,
    ):
        """Arrange the samples of all windows; ``setting``: with the known delays of sensors and
        release.
        """
        x = setting.sensing
        delays = x.vehicle_delay, x.vehicle_delay, x.payload_delay, x.gyro_delay
        self._lag = setting.plant.release.lag
        self.flights = list(flights)
        self.cuts = list(cuts)
        spans = np.array([c.end - c.start for c in cuts])
        self.knots = np.ceil(spans / KNOT_SPACING - 1e-6).astype(int) + 1
        counts = [len(f.command_time) for f in self.flights]
        self.first_command = np.cumsum(counts) - counts
        self._fineness = np.array([FINENESS.get(c.phase, (1.0, 1.0)) for c in cuts])
        self.samples = [self._samples_in(c, delays) for c in self.cuts]
        rows = [self._row(w) for w in range(len(self.cuts))]
        self.windows = {name: np.array([row[name] for row in rows]) for name in rows[0]}
        vehicle, attitude, payload, gyro = zip(*self.samples)
        recorded = {
            "command_time": np.concatenate([f.command_time for f in self.flights]),
            "command": np.concatenate([f.command for f in self.flights]),
            "vehicle_quat": np.concatenate([part.values for part in attitude]),
        }
        for name, parts in (("vehicle", vehicle), ("payload", payload), ("gyro", gyro)):
            counts = np.array([len(part.time) for part in parts])
            self.windows[f"{name}_count"] = counts
            self.windows[f"{name}_first"] = np.cumsum(counts) - counts
            recorded[f"{name}_time"] = np.concatenate([part.time for part in parts])
        self.recording = Recording(self.windows, recorded)
        self.rows = self.recording.rows
        self._groups = [_groups_of(*samples) for samples in self.samples]
        self.sigma = []
        self.time = []
        self._measured = []
        for w, (vehicle, _, payload, gyro) in enumerate(self.samples):
            sigmas = [part.sigma for part in self.samples[w]]
            self.sigma.append(self.spread(w, *sigmas))
            stamps = vehicle.time.repeat(2), payload.time, gyro.time
            self.time.append(np.concatenate(stamps).repeat(3))
            measured = np.zeros((len(self._groups[w]), 3))
            has_value = self._groups[w] != 1  # the replay returns differences of attitudes
            measured[has_value] = np.concatenate((vehicle.values, payload.values, gyro.values))
            self._measured.append(measured)

    def _samples_in(self, c: Cut, delays: Sequence[float]) -> list[ChannelSamples]:
        """Return the window's samples of vehicle, attitude, payload and gyro."""
        f = self.flights[c.flight]
        payload = f.payload if c.payload in (ATTACHED, LOOSE) else None
        samples = []
        for source, delay in zip((f.vehicle, f.attitude, payload, f.gyro), delays):
            source = source or NO_SAMPLES
            samples.append(source.during(c.start + delay + EARLY, c.end + delay))
        return samples

    def _row(self, w: int) -> dict[str, float]:
        """Return a window's fields, but for the ranges of its stamps."""
        c = self.cuts[w]
        f = self.flights[c.flight]
        reach = c.start - LATEST, c.end + LATEST
        bounds = np.searchsorted(f.command_time, reach) + [-1, 1]
        first, last = bounds.clip(0, len(f.command_time)) + self.first_command[c.flight]
        return {
            "start": c.start,
            "end": c.end,
            "first_knot": c.start,
            "knots": self.knots[w],
            "payload": c.payload,
            "latch": f.latch if c.payload == ATTACHED else NEVER,
            "clock_zero": f.start,
            "command_first": first,
            "command_last": last,
        }

    def separation(self, w: int) -> float:
        """Return the expected time of the separation in a window's flight [s]."""
        return self.flights[self.cuts[w].flight].latch + self._lag

    def kind(self, w: int) -> tuple[int, bool]:
        """Return the kind of payload at a window's start, and whether it is not released in it."""
        c = self.cuts[w]
        return c.payload, self.flights[c.flight].latch >= c.end

    def spread(self, w: int, *values: float) -> ndarray:
        """Return for every sample of a window the value of its kind: vehicle, attitude, payload or
        gyro.
        """
        return np.repeat(np.array(values)[self._groups[w]], 3)

    def residual(self, measured: ndarray, w: int, lane: int) -> ndarray:
        """Return measured minus simulated samples, shape (N,); for an attitude, the rotation vector
        from the simulated to the measured one.
        """
        return (self._measured[w] - measured[: self.rows[w], lane]).ravel()

    def fly(
        self,
        simulation: Simulation,
        states: States,
        lanes: Sequence[Lane],
        recording: Recording | None = None,
    ) -> Replayed:
        """Simulate lanes.

        Args:
            simulation: settings to which the lanes refer.
            states: initial states to which the lanes refer.
            lanes: at most some thousand, to limit memory.
            recording: the windows, if changed.
        """
        columns = {name: np.array(values) for name, values in zip(Lane._fields, zip(*lanes))}
        rough = columns.pop("rough").astype(int)
        fineness = self._fineness[columns["window"], rough]
        columns["substep"] = simulation.steps[columns["plant"], rough] * fineness
        ends = columns["keep"] + self.knots[columns["window"]]
        knots = int(np.max(ends[columns["keep"] >= 0], initial=1))
        return simulation.replay.run(
            states, recording or self.recording, columns, KNOT_SPACING, knots
        )

    def residuals(
        self,
        simulation: Simulation,
        states: States,
        lanes: Sequence[Lane],
        recording: Recording | None = None,
    ) -> list[ndarray]:
        """Simulate lanes; return the residual of each, see :meth:`residual` and :meth:`fly`."""
        samples = self.fly(simulation, states, lanes, recording).samples
        return [self.residual(samples, lane.window, i) for i, lane in enumerate(lanes)]

    def differences(
        self,
        simulation: Simulation,
        states: States,
        groups: Sequence[Sequence[Lane]],
        recording: Recording | None = None,
    ) -> list[ndarray]:
        """Simulate groups of lanes, a group for each window. Return the samples of each lane minus
        those of its group's first lane, shape (N, lanes - 1) for each group; see :meth:`fly`.
        """
        lanes = [lane for group in groups for lane in group]
        samples = self.fly(simulation, states, lanes, recording).samples
        first = 0
        differences = []
        for group in groups:
            rows = self.rows[group[0].window]
            last = first + len(group)
            columns = np.swapaxes(samples[:rows, first:last], 1, 2).reshape(3 * rows, -1)
            differences.append(columns[:, 1:] - columns[:, :1])
            first = last
        return differences

    def end_early(self, ends: Sequence[float]) -> Recording:
        """Return the recording with earlier ends of windows [s]; later samples are undefined."""
        return Recording(self.windows | {"end": np.array(ends)}, self.recording.data)


def _groups_of(vehicle: ChannelSamples, _, payload: ChannelSamples, gyro: ChannelSamples):
    """Return the kind of each row of a window: positions and attitudes in turns, then payload, then
    gyro.
    """
    pairs = np.tile([0, 1], len(vehicle.time))
    rest_of_rows = np.repeat([2, 3], [len(payload.time), len(gyro.time)])
    return np.concatenate((pairs, rest_of_rows))


def fly_alike(kind: tuple[int, bool], setting: Setting, second: Setting) -> bool:
    """Return whether two settings lead to the same motion in windows of a kind. They may differ in
    sensors and in parameters without effect there.
    """
    payload, holds = kind
    plant = second.plant
    if setting.step_square != second.step_square:
        return False
    if payload == NO_PAYLOAD and not plant.laws:
        plant = replace(plant, rope=setting.plant.rope, release=setting.plant.release)
    elif payload == ATTACHED and holds:
        plant = replace(plant, release=setting.plant.release)
    return plant == setting.plant


def carry_states(flights: ReplayedFlights, simulation: Simulation) -> tuple[States, States]:
    """Return the initial states of all windows and the states at their ends.

    Measured fields are smoothed measurements. Other fields are carried on from the end of the
    preceding window by simulation. ``flights``: the windows of each flight in order of time;
    ``simulation``: of one setting."""
    (setting,) = simulation.settings
    by_flight = groupby(range(len(flights.cuts)), key=lambda w: flights.cuts[w].flight)
    states = [None] * len(flights.cuts)
    ends = [None] * len(flights.cuts)
    columns = zip_longest(*[list(group) for _, group in by_flight])
    for k, side_by_side in enumerate(columns):
        windows = [w for w in side_by_side if w is not None]
        for w in windows:
            c = flights.cuts[w]
            flight = flights.flights[c.flight]
            # after a gap, the fields that are not measured start from a hover
            gap = k == 0 or c.start > flights.cuts[w - 1].end + 1e-6
            inner = hover_state(flight, setting.plant) if gap else ends[w - 1]
            states[w] = measured_state(flight, c.start, setting, c.payload, inner)
            if gap:
                states[w]["gyro"] = states[w]["rate_b"].copy()
        lanes = [Lane(w, 0, row, keep=0) for row, w in enumerate(windows)]
        flown = flights.fly(simulation, stack([states[w] for w in windows]), lanes)
        for row, w in enumerate(windows):
            ends[w] = rows_of(flown.ends, np.array([row]))
    begun = stack(states)
    begun[MOVED] = np.zeros((len(states), len(directions(setting.plant))))
    return begun, stack(ends)

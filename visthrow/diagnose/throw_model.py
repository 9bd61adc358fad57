"""The whole throw as a model to diagnose: vehicle, rope, payload and release replayed from recorded commands."""

import copy
import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from camera.params import CameraParams
from sim.params import PlantParams, SensingParams
from sim.replay.kernel import NO_PAYLOAD
from sim.replay.lanes import Replay
from visthrow.diagnose.catalogue import Entry, Setting, apply, entries_for
from visthrow.diagnose.cutting import Cut, around_slack, cut, thinned
from visthrow.diagnose.interface import Mistake
from visthrow.diagnose.landing import Landings, landings
from visthrow.diagnose.model import Window
from visthrow.diagnose.opened import opened
from visthrow.diagnose.recorded import NEVER, carriers, record_of
from visthrow.diagnose.replay import BATCH, CUDA_BATCH, KNOT_SPACING, Flights, Lane, carried
from visthrow.diagnose.settling import Settling, perturbed
from visthrow.diagnose.sightings import channels_of, needs_no_flight, sightings, with_sightings
from visthrow.diagnose.states import (
    States,
    concerns,
    directions,
    hover_state,
    measured_state,
    resampled,
)
from visthrow.errors import DiagnoseError
from visthrow.flightlog import FlightLog

LATENT_SIZES = (0.05, 0.05, 0.05, 1e-3, 1e-3, 1e-3, 0.01, 0.01, 0.01)
"""Of the latent forces' derivatives: force [N], torque [N m], force on the payload [N]."""
AFTER_SLACK = 0.05  # that a rope is given to come taut [s]


class ThrowModel:
    """Flights of a vehicle, with or without a payload, against the simulator that training uses.

    Attributes:
        effects: of the catalogue that concern this plant and these logs.
        channels: measured ones.
        entries: name -> entry of the catalogue.
        setting: what the residuals at theta = 0 are simulated with.
    """

    def __init__(
        self,
        logs: Sequence[FlightLog],
        plant: PlantParams,
        *,
        sensing: SensingParams | None = None,
        device: str = "cpu",
        substep: float = 0.002,
        stride: int = 1,
        only: Sequence[str] | None = None,
        carries: bool | None = None,
        simpler: bool = False,
        camera: CameraParams | None = None,
        mistakes: tuple[Mistake, ...] = (),
    ):
        """Cut the flights and find the windows' initial states.

        Args:
            logs: flights.
            plant: the diagnosed one.
            sensing: what is known of the sensors.
            device: "cpu" or "cuda:0".
            substep: largest integration step [s].
            stride: use every so many measured samples.
            only: names of the effects to consider; default all that apply.
            carries: whether a payload hangs below in all flights; default: in those in which one was measured or released.
            simpler: consider also blocks simpler than the plant's, such as a rigid rope; each compiles a kernel.
            camera: whose keypoints the logs hold.
            mistakes: of the logs' interface that were put right before.

        Raises:
            DiagnoseError: no flight can be replayed, or ``only`` names what does not exist.
        """
        self.setting = opened(Setting(plant, sensing or SensingParams(), camera=camera))
        self.device, self.substep, self.mistakes = device, substep, mistakes
        flights = [record_of(log, i) for i, log in enumerate(logs)]
        hangs = carriers(flights) if carries is None else [carries] * len(flights)
        carries = any(hangs)
        release = plant.release
        cuts = thinned([c for i, f in enumerate(flights) for c in cut(f, i, release.lag, release.landing_height, hangs[i])])
        if not cuts:
            raise DiagnoseError(f"{len(flights)} flights hold no stretch of poses and commands long enough to replay")
        self.channels = ["pos_w", "quat_wb"]
        self.channels += ["payload_pos_w"] if carries and any(f.payload for f in flights) else []
        self.channels += ["rate_b"] if any(f.gyro for f in flights) else []
        self.channels += channels_of(logs, flights, camera)
        thrown = any(f.latch != NEVER for f in flights)
        self.entries: dict[str, Entry] = entries_for(self.setting, set(self.channels), carries, thrown, simpler)
        if only is not None:
            unknown = [name for name in only if name not in self.entries]
            if unknown:
                raise DiagnoseError(f"no effects {unknown} for these flights; there are {', '.join(self.entries)}")
            self.entries = {name: self.entries[name] for name in only}
        self._sighted = [e for e in self.entries.values() if needs_no_flight(e)]
        self._graded = [e for e in self.entries.values() if e.switch is None and e not in self._sighted]
        self._switched = [e for e in self.entries.values() if e.switch is not None]
        self.entries = {e.effect.name: e for e in (*self._graded, *self._switched, *self._sighted)}
        self.effects = tuple(e.effect for e in self.entries.values())
        self._directions = directions(self.setting.plant)
        x = self.setting.sensing
        delays = (x.vehicle_delay, x.payload_delay, x.gyro_delay)
        self.flights = Flights(flights, cuts, delays, stride)
        states = self._begin(self.setting)
        if (without_slack := self._without_slack(states)) != cuts:
            self.flights = Flights(flights, without_slack, delays, stride)
            states = self._begin(self.setting)
        self._told = np.array([w for w, c in enumerate(self.flights.cuts) if c.told])
        self._states = self._latest = self._settling(self.setting).fit(states)
        self._sightings = sightings(logs, flights, self.flights.cuts, self.setting)

    def windows(self, theta: Mapping[str, float]) -> list[Window]:
        """See :class:`visthrow.diagnose.model.Model`."""
        setting = apply(self.entries, self.setting, theta)
        self._directions = directions(setting.plant)  # another kind of block has other states
        states = self._states if setting == self.setting else self._settled(setting)
        self._latest = states
        steps = [self._step(e, theta.get(e.effect.name, 0.0)) for e in self._graded]
        settings = [setting, *[e.apply(setting, step) for e, step in zip(self._graded, steps)]]
        replay = self._replay(settings)
        found: list[Window] = []
        for batch in self._batches():
            found += self._linearised(replay, settings, np.array(steps), states, batch)
        columns = [self._secant(e, theta, states, found) for e in self._switched]
        if columns:
            found = [
                dataclasses.replace(w, effects=np.hstack((w.effects, np.stack([c[i] for c in columns], axis=1))))
                for i, w in enumerate(found)
            ]
        return self._with_sightings(setting, theta, found)

    def _with_sightings(self, setting: Setting, theta: Mapping[str, float], windows: list[Window]) -> list[Window]:
        """Windows with what was seen besides poses, and columns of the effects that this alone shows."""
        blank = [np.zeros((len(w.residual), len(self._sighted))) for w in windows]
        whole = [dataclasses.replace(w, effects=np.hstack((w.effects, b))) for w, b in zip(windows, blank)]
        if not self._sightings:
            return whole
        entries = list(self.entries.values())
        steps = np.array([0.0 if e.switch else self._step(e, theta.get(e.effect.name, 0.0)) for e in entries])
        settings = [setting, *[setting if e.switch else e.apply(setting, step) for e, step in zip(entries, steps)]]
        return [
            with_sightings(w, number, self._sightings, self.channels, settings, steps) for number, w in zip(self._told, whole)
        ]

    def _secant(self, e: Entry, theta: Mapping[str, float], states: States, windows: list[Window]) -> list[np.ndarray]:
        """Samples with the other kind of block less those with this one, per theta; a column for each window."""
        on = theta.get(e.effect.name, 0.0) > 0.5
        other = apply(self.entries, self.setting, {**theta, e.effect.name: 0.0 if on else 1.0})
        lanes = [Lane(w, 0, w) for w in self._told]
        start = resampled(states, other.plant.rope.segments)
        seen = self.flights.fly(self._replay([other]), [other], start, lanes, self.substep).seen
        sign = -1.0 if on else 1.0
        return [sign * (x.residual - self.flights.residual(seen, w, lane)) for lane, (w, x) in enumerate(zip(self._told, windows))]

    def residuals(self, theta: Mapping[str, float]) -> list[np.ndarray]:
        """See :class:`visthrow.diagnose.model.Model`; from the initial states of the last :meth:`windows`."""
        setting = apply(self.entries, self.setting, theta)
        lanes = [Lane(w, 0, w) for w in self._told]
        states = resampled(self._latest, setting.plant.rope.segments)
        seen = self.flights.fly(self._replay([setting]), [setting], states, lanes, self.substep).seen
        flown = [self.flights.residual(seen, w, lane) for lane, w in enumerate(self._told)]
        return [np.concatenate((r, *self._sighting_residuals(w, setting))) for r, w in zip(flown, self._told)]

    def _sighting_residuals(self, w: int, setting: Setting) -> list[np.ndarray]:
        held = [(kind, kind.samples(w)[1]) for kind in self._sightings]
        return [values - kind.predicted(w, setting) for kind, values in held if len(values)]

    def step_error(self, finer: int = 4) -> dict[str, float]:
        """Largest change of any sample of each channel when the step is so many times finer, in its noise."""
        fine = dataclasses.replace(self.setting, step_square=1.0 / finer**2)
        settings = [self.setting, fine]
        count, f = len(self._told), self.flights
        lanes = [Lane(w, s, w) for s in range(2) for w in self._told]
        seen = f.fly(self._replay(settings), settings, self._states, lanes, self.substep).seen
        worst = dict.fromkeys(self.channels, 0.0)
        for lane, w in enumerate(self._told):
            off = np.abs(f.residual(seen, w, lane) - f.residual(seen, w, count + lane)) / f.sigma(w)
            for i, name in enumerate(self.channels):
                here = off[self._channel(w) == i]
                worst[name] = max(worst[name], float(here.max())) if len(here) else worst[name]
        return worst

    def landings(self, theta: Mapping[str, float], flights: Sequence[int] | None = None) -> Landings:
        """See :func:`visthrow.diagnose.landing.landings`."""
        return landings(self, theta, flights)

    def landing_errors(self, theta: Mapping[str, float]) -> np.ndarray:
        """Distance of each throw's predicted landing from the measured one [m], shape (throws,)."""
        return self.landings(theta).errors

    def beside(self, cuts: Sequence[Cut]) -> "ThrowModel":
        """The same model of other windows of its flights."""
        other, x = copy.copy(self), self.setting.sensing
        delays = (x.vehicle_delay, x.payload_delay, x.gyro_delay)
        other.flights = Flights(self.flights.flights, cuts, delays, self.flights.stride)
        other._told = np.array([w for w, c in enumerate(cuts) if c.told])
        return other

    def begun(self, theta: Mapping[str, float]) -> tuple[Setting, States]:
        """The setting with effects at ``theta``, and initial states fitted in it."""
        setting = apply(self.entries, self.setting, theta)
        return setting, self._settling(setting).fit(self._begin(setting))

    def _replay(self, settings: Sequence[Setting]) -> Replay:
        return Replay([s.plant for s in settings], [s.sensing for s in settings], self.device)

    def _begin(self, setting: Setting) -> States:
        """Initial states from smoothed measurements and, for what nobody measures, from flying through the windows before."""

        def begin(flight, c, inner):
            start = hover_state(flight, setting.plant, c.payload) if inner is None else inner
            state = measured_state(flight, c.start, setting, c.payload, start)
            if inner is None:
                state["gyro"] = state["rate_b"].copy()
            return state

        return carried(self.flights, self._replay([setting]), setting, begin, self.substep)

    def _settling(self, setting: Setting) -> Settling:
        """What fits initial states in a setting."""
        return Settling(
            self.flights, self._told, self._directions, setting, lag=self.setting.plant.release.lag, substep=self.substep,
            device=self.device,
        )  # fmt: skip

    def _settled(self, setting: Setting) -> States:
        """States fitted in a setting, from the better of those settled at theta = 0 and those that the setting begins with."""
        settling = self._settling(setting)
        return settling.fit(settling.better(resampled(self._states, setting.plant.rope.segments), self._begin(setting)))

    @staticmethod
    def _step(e: Entry, theta: float) -> float:
        """Step of theta for the derivative: upwards, unless that leaves the bounds."""
        step = e.step * e.effect.floor
        return -step if theta + step > e.effect.bounds[1] else step

    def _batches(self) -> list[list[int]]:
        """Windows in groups whose lanes fit a run."""
        batches, room = [], 0
        for w in self._told:
            lanes = 1 + len(self._graded) + len(self._directions) + 9 * int(self.flights.knots[w])
            if not batches or room < lanes:
                batches.append([])
                room = BATCH if self.device == "cpu" else CUDA_BATCH
            batches[-1].append(w)
            room -= lanes
        return batches

    def _nuisances(self, w: int) -> list[int]:
        return [d for d, x in enumerate(self._directions) if concerns(x, self.flights.cuts[w])]

    def _latents(self, w: int) -> list[tuple[int, int]]:
        axes = 6 if self.flights.cuts[w].payload == NO_PAYLOAD else 9
        return [(axis, knot) for axis in range(axes) for knot in range(int(self.flights.knots[w]))]

    def _linearised(
        self, replay: Replay, settings: list[Setting], steps: np.ndarray, states: States, batch: list[int]
    ) -> list[Window]:
        count = len(self.flights.cuts)
        lanes: list[Lane] = []
        keep, columns = 0, {}
        for w in batch:
            alike = [self.flights.alike(w, settings[0], other) for other in settings[1:]]
            effects = np.argsort(~np.array(alike, dtype=bool), kind="stable")
            parent, first = len(lanes), keep
            lanes.append(Lane(w, 0, w, keep=keep, rides=sum(alike)))
            keep += int(self.flights.knots[w])
            lanes += [Lane(w, 1 + int(k), w) for k in effects]
            columns[w] = np.argsort(effects)
            lanes += [Lane(w, 0, (1 + d) * count + w) for d in self._nuisances(w)]
            lanes += [
                Lane(w, 0, w, axis, knot, LATENT_SIZES[axis], resume=first + max(knot - 1, 0), parent=parent)
                for axis, knot in self._latents(w)
            ]
        flown = self.flights.fly(replay, settings, perturbed(states, self._directions), lanes, self.substep)
        out, at, keep = [], 0, 0
        for w in batch:
            nuisances, latents = self._nuisances(w), self._latents(w)
            size = 1 + len(self._graded) + len(nuisances) + len(latents)
            knots = {name: value[keep : keep + self.flights.knots[w]] for name, value in flown.knots.items()}
            index = np.arange(at, at + size)
            index[1 : 1 + len(steps)] = at + 1 + columns[w]
            out.append(self._window(flown.seen[:, index], settings[0], steps, w, nuisances, latents, knots))
            at, keep = at + size, keep + int(self.flights.knots[w])
        return out

    def _window(
        self, seen: np.ndarray, setting: Setting, steps: np.ndarray, w: int, nuisances: list[int], latents: list, knots: dict
    ) -> Window:
        """One window from its lanes: nominal, effects, initial states, latent forces."""
        f = self.flights
        rows, c = int(f.rows[w]), f.cuts[w]
        flat = np.ascontiguousarray(np.swapaxes(seen[:rows], 1, 2)).reshape(3 * rows, -1)
        K, D = len(steps), len(nuisances)
        sizes = [*steps, *[self._directions[d].step for d in nuisances], *[LATENT_SIZES[axis] for axis, _ in latents]]
        slopes = (flat[:, 1:] - flat[:, :1]) / np.array(sizes)
        return Window(
            c.flight, c.phase, f.time(w), self._channel(w), f.residual(seen, w, 0), f.sigma(w), slopes[:, :K],
            slopes[:, K : K + D], np.array([self._directions[d].sd for d in nuisances]), slopes[:, K + D :],
            np.array([axis // 3 for axis, _ in latents]), np.array([axis % 3 for axis, _ in latents]),
            np.array([c.start + KNOT_SPACING * knot for _, knot in latents]), self._at_knots(setting, w, knots),
        )  # fmt: skip

    def _at_knots(self, setting: Setting, w: int, knots: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Simulated quantities at the knots, those of the payload where there is one."""
        c = self.flights.cuts[w]
        time = c.start + KNOT_SPACING * np.arange(len(knots["thrust"]))
        told = {"time": np.minimum(time, c.end)} | {name: value.copy() for name, value in knots.items()}
        if c.payload == NO_PAYLOAD:
            return {name: value for name, value in told.items() if not name.startswith("payload") and name != "tension"}
        arm = np.array(setting.plant.rope.mount) - np.array(setting.plant.vehicle.body.com)
        reach = told["payload_pos_w"] - told["pos_w"] - Rotation.from_quat(told["quat_wb"]).apply(arm)
        told["cable_dir_w"] = reach / np.linalg.norm(reach, axis=1, keepdims=True)
        f = self.flights.flights[c.flight]
        if f.latch != NEVER:
            told["tension"][told["time"] > f.latch + setting.plant.release.lag] = 0.0
        return told

    def _channel(self, w: int) -> np.ndarray:
        at = {name: i for i, name in enumerate(self.channels)}
        return self.flights.spread(w, 0, 1, at.get("payload_pos_w", -1), at.get("rate_b", -1)).astype(int)

    def _without_slack(self, states: States) -> list[Cut]:
        """The windows, with the time in which the rope is slack cut out."""
        count = len(self.flights.cuts)
        lanes = [Lane(w, 0, w, keep=0) for w in range(count)]
        ends = self.flights.fly(self._replay([self.setting]), [self.setting], states, lanes, self.substep).ends
        cuts: list[Cut] = []
        for w, c in enumerate(self.flights.cuts):
            first, last = float(ends["slack_first"][w]), float(ends["slack_last"][w])
            separation = self.flights.flights[c.flight].latch + self.setting.plant.release.lag
            cuts += [c] if last < c.start else around_slack(c, first, last + AFTER_SLACK, separation)
        return cuts

"""The model of a whole throw: vehicle, rope, payload and release, replayed from recorded
commands.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import compress

import numpy as np
from numpy import ndarray

from camera.params import CameraParams
from sim.effects.effect import SettingEffect, apply, possible_together
from sim.effects.setting import Setting, generalise
from sim.kernels.replay.kernel import ATTACHED
from sim.params import PlantParams, SensingParams
from visthrow.common.errors import DiagnoseError, expect_known
from visthrow.config.effects import catalogue
from visthrow.diagnose.models.model_interface import Indices, Linearised, Model, Sizes, Window
from visthrow.diagnose.models.quadrotor.flyer_windows import find_acting
from visthrow.diagnose.throw.cutting import RINGING, Cut, around_slack, cut, thin
from visthrow.diagnose.throw.direct import direct_samples, needs_no_flight, with_direct
from visthrow.diagnose.throw.initial_fit import InitialFit, compensate, perturb
from visthrow.diagnose.throw.initial_states import (
    MOVED,
    States,
    deviations,
    directions,
    move_along,
)
from visthrow.diagnose.throw.landing import landings
from visthrow.diagnose.throw.linearising import Linearisation
from visthrow.diagnose.throw.recorded_flight import NEVER, RecordedFlight, carriers, record_of
from visthrow.diagnose.throw.replay import (
    BATCH,
    CUDA_BATCH,
    Lane,
    ReplayedFlights,
    Simulation,
    carry_states,
    split_windows,
)
from visthrow.logs.flightlog import FlightLog

UNKNOWN_CHARGE = "{} of {} logs hold no battery_voltage: the charge at their start is assumed"
OTHER_CHARGE = (
    "; battery_charge stands for a fuller or emptier pack, which intervals of thrust leave out"
)
REPLAYED = ("pos_w", "quat_wb", "payload_pos_w", "rate_b")  # channels that a replay shows
AFTER_SLACK = 0.05  # time that a rope takes to become taut [s]
FINER = 4  # factor by which the step is shortened to measure its error


class ThrowModel(Model):
    """Flights of a vehicle, with or without a payload, against the simulator that training uses.

    Attributes:
        effects: entries of the catalogue that apply to this plant and these logs.
        channels: measured channels.
        entries: name -> effect.
        setting: the parameters at theta = 0.
    """

    def __init__(
        self,
        logs: Sequence[FlightLog],
        plant: PlantParams,
        *,
        sensing: SensingParams | None = None,
        camera: CameraParams | None = None,
        device: str = "cpu",
        substep: float = 0.002,
        only: Sequence[str] | None = None,
        carries: bool | None = None,
        simpler: bool = False,
    ):
        """Cut the flights into windows and fit their initial states.

        Raises DiagnoseError: no flight can be replayed, or ``only`` names an unknown effect.

        Args:
            sensing: known delays and offsets of the sensors.
            device: "cpu" or "cuda:0".
            substep: largest integration step [s].
            only: names of the effects to consider; default: all that apply.
            carries: whether a payload hangs below in all flights; default: in those in which one
                was measured or released.
            simpler: whether to consider blocks simpler than the plant's, such as a rigid rope; each
                of them compiles a kernel.
            camera: the camera whose keypoints the logs hold.
        """
        self.setting = generalise(Setting(plant, sensing or SensingParams(), camera=camera))
        self.device = device
        self.substep = substep
        flights = [record_of(log, i) for i, log in enumerate(logs)]
        hangs = carriers(flights) if carries is None else [carries] * len(flights)
        states = self._settle_without_slack(flights, self._cuts_of(flights, hangs))
        self._retained = np.array([w for w, c in enumerate(self.flights.cuts) if c.retained])
        self._direct = direct_samples(logs, flights, self.flights.cuts, self.setting)
        direct = dict.fromkeys(d.channel for listed in self._direct.values() for d in listed)
        self.channels = [*_list_channels(flights, any(hangs)), *direct]
        thrown = any(f.latch != NEVER for f in flights)
        silent = sum(f.voltage is None for f in flights)
        self.has_voltage = silent < len(flights)  # whether any log holds the battery's voltage
        measured = set(self.channels)
        if self.has_voltage:
            measured.add("battery_voltage")
        concerned = effects_for(self.setting, measured, any(hangs), thrown, simpler)
        self._choose(concerned, concerned if only is None else only)
        if silent and plant.vehicle.battery.kind == "sag":
            note = OTHER_CHARGE if "battery_charge" in self.entries else ""
            self.notes = (*self.notes, UNKNOWN_CHARGE.format(silent, len(flights)) + note)
        fitter = InitialFit(self.flights, self.simulation(self.setting))
        begun = fitter.fit(states, {})
        # states at theta = 0, and the samples' derivatives by them
        self._nominal = begun, fitter.slopes
        self._settled_at: dict[frozenset[tuple[str, float]], States] = {}

    def _cuts_of(self, flights: Sequence[RecordedFlight], hangs: Sequence[bool]) -> list[Cut]:
        """Cut flights into windows, and thin these if there are many."""
        release = self.setting.plant.release
        cuts: list[Cut] = []
        for i, flight in enumerate(flights):
            cuts += cut(flight, i, release.lag, release.landing_height, hangs[i])
        if not cuts:
            raise DiagnoseError(
                f"{len(flights)} flights hold no stretch of poses and commands long enough to"
                " replay"
            )
        chosen = thin(cuts, flights)
        if len(chosen) < len(cuts):
            count = f"{len(chosen)} of {len(cuts)} windows"
            self.notes = (f"{count} are looked at: all throws, and where commands vary most",)
        return chosen

    def _settle_without_slack(
        self, flights: Sequence[RecordedFlight], cuts: Sequence[Cut]
    ) -> States:
        """Set up the windows without the time in which ropes were slack; return initial states."""
        self.flights = ReplayedFlights(flights, cuts, self.setting)
        simulation = self.simulation(self.setting)
        states, ends = carry_states(self.flights, simulation)
        without_slack = self._cut_slack(ends)
        if without_slack != cuts:
            self.flights = ReplayedFlights(flights, without_slack, self.setting)
            states, _ = carry_states(self.flights, simulation)
        return states

    def _choose(self, concerned: Mapping[str, SettingEffect], names: Iterable[str]) -> None:
        """Set the effects by their names: first those of continuous size, then switches, then those
        that only cameras show.

        Raises DiagnoseError: an effect does not apply to these flights.
        """
        expect_known(names, concerned, "no effect '{}' for these flights", DiagnoseError)
        effects = [concerned[name] for name in names]
        self.not_offered = len(concerned) - len(effects)
        self._sighted = [e for e in effects if needs_no_flight(e)]
        self._graded = [e for e in effects if not e.switch and e not in self._sighted]
        self._switched = [e for e in effects if e.switch]
        self.effects = (*self._graded, *self._switched, *self._sighted)
        self.entries = {e.name: e for e in self.effects}
        # columns of switches, by name, taken where each was first needed
        self._secants: dict[str, list[ndarray]] = {}

    def at(self, theta: Sizes) -> Setting:
        """Return the setting with effects of these sizes."""
        return apply(self.entries, self.setting, theta)

    def windows(self, theta: Sizes) -> list[Window]:
        """See :class:`visthrow.diagnose.models.model_interface.Model`."""
        setting = self.at(theta)
        ways = directions(setting.plant)  # another kind of block has other states
        states = self._settled_at[_key(theta)] = self._settle(setting)
        entries = self.entries.values()
        steps = np.array([self._step(e, theta.get(e.name, 0.0)) for e in entries])
        settings = [setting, *[e.apply(setting, step) for e, step in zip(entries, steps)]]
        graded = len(self._graded)
        simulation = self.simulation(*settings[: 1 + graded])
        begun = perturb(states, ways)
        linearisation = Linearisation(
            self.flights, simulation, self._graded, steps[:graded], ways, begun
        )
        lanes = 2 + graded + len(ways) + 9 * self.flights.knots[self._retained]
        room = BATCH if self.device == "cpu" else CUDA_BATCH
        listed = []
        for batch in split_windows(self._retained, lanes, room):
            listed += linearisation.windows(batch, [self._channel(w) for w in batch])
        whole = []
        for w, window in zip(self._retained, self._add_switches(theta, listed)):
            direct = self._direct.get(w, ())
            whole.append(with_direct(window, direct, self.channels, settings, steps))
        return whole

    def _add_switches(self, theta: Sizes, listed: list[Window]) -> list[Window]:
        """Return the windows with columns of the switches, and zeros for effects that only cameras
        show.
        """
        for e in self._switched:  # columns serve the screening; a switch is judged by simulation
            if e.name not in self._secants:
                self._secants[e.name] = self._secant(e, theta, listed)
        secants = [self._secants[e.name] for e in self._switched]
        windows = []
        for i, w in enumerate(listed):
            columns = [secant[i][:, None] for secant in secants]
            blank = np.zeros((len(w.residual), len(self._sighted)))
            effects = np.hstack((w.effects, *columns, blank))
            windows.append(replace(w, effects=effects))
        return windows

    def _secant(self, e: SettingEffect, theta: Sizes, windows: list[Window]) -> list[ndarray]:
        """Return the change of the samples if a block is switched, per theta; a column for each
        window.

        Initial states are fitted for each kind of block. Otherwise the transient from a state of
        the other kind would count as an effect of the switch."""
        on = theta.get(e.name, 0.0) > 0.5
        elsewhere = self.at({**theta, e.name: 0.0 if on else 1.0})
        sign = -1.0 if on else 1.0
        flown = self._fly(elsewhere, self._settle(elsewhere))
        moved = self._settled_at[_key(theta)][MOVED]
        present = deviations(directions(self.at(theta).plant), self.flights.cuts) > 0.0
        columns = []
        for w, window, after in zip(self._retained, windows, flown):
            fitted = window.residual - window.nuisance @ moved[w, present[w]]
            columns.append(sign * (fitted - after))
        return columns

    def _fly(self, setting: Setting, states: States) -> list[ndarray]:
        """Return the residuals of all windows' replayed samples in a setting."""
        lanes = [Lane(w, 0, w) for w in self._retained]
        return self.flights.residuals(self.simulation(setting), states, lanes)

    def residuals(self, theta: Sizes, linearised: Linearised) -> list[ndarray]:
        """See :class:`.model_interface.Model`."""
        setting = self.at(theta)
        states, moves = self._follow(setting, theta, linearised)
        flown = self._fly(setting, states)
        residuals = []
        for i, (w, residual) in enumerate(zip(self._retained, flown)):
            direct = [d.values - d.predict(setting) for d in self._direct.get(w, ())]
            residual = np.concatenate((residual, *direct))
            if i in moves:
                residual = residual + linearised.windows[i].nuisance @ moves[i]
            residuals.append(residual)
        return residuals

    def possible(self, theta: Sizes) -> Sizes:
        """See the base class."""
        return possible_together(self.entries, self.setting, theta)

    def without_commands(self, theta: Sizes, windows: Indices) -> list[ndarray]:
        """See the base class.

        A radio link may lose commands or deliver them late. The vehicle then keeps the previous
        command, while the log holds the one that was sent. Each window is simulated once for each
        of its commands, with the previous command in its place."""
        flights = self.flights
        delay = self.setting.plant.vehicle.queue.delay
        groups = {}
        for w in self._retained[list(windows)].tolist():
            c = flights.cuts[w]
            f = flights.flights[c.flight]
            acting = find_acting(f.command_time, f.command, delay, c.start, c.end)
            whole = Lane(w, 0, w, rough=True)
            skipped = flights.first_command[c.flight] + acting
            groups[w] = [whole, *[whole._replace(skip=number) for number in skipped]]
        simulation = self.simulation(self.at(theta))
        states = self._settled_at[_key(theta)]
        columns = []
        for part in split_windows(list(groups), [len(lanes) for lanes in groups.values()], BATCH):
            columns += flights.differences(simulation, states, [groups[w] for w in part])
        return columns

    def _follow(
        self, setting: Setting, theta: Sizes, linearised: Linearised
    ) -> tuple[States, dict[int, ndarray]]:
        """Adjust the states to other sizes of the effects by the derivatives; return the states and
        each window's displacement from its prior mean.
        """
        before = linearised.theta
        change = np.array([theta.get(name, 0.0) - before.get(name, 0.0) for name in self.entries])
        ways = directions(setting.plant)
        present = deviations(ways, self.flights.cuts) > 0.0
        follows = np.array([x.follows for x in ways])
        numbers = self._retained[list(linearised.windows)]
        sizes = np.zeros(present.shape)
        for w, window in zip(numbers, linearised.windows.values()):
            sizes[w, present[w]] = compensate(self.flights, w, window, follows[present[w]], change)
        states = move_along(self._settled_at[_key(before)], ways, sizes)
        moves = [states[MOVED][w, present[w]] for w in numbers]
        return states, dict(zip(linearised.windows, moves))

    def step_error(self) -> dict[str, float]:
        """See the base class."""
        fine = replace(self.setting, step_square=1.0 / FINER**2)
        worst = np.zeros(len(self.channels))
        flown = (self._fly(setting, self._nominal[0]) for setting in (self.setting, fine))
        for w, plain, finer in zip(self._retained, *flown):
            change = np.abs(plain - finer) / self.flights.sigma[w]
            np.fmax.at(worst, self._channel(w), change)
        return dict(zip(self.channels, worst))

    landings = landings

    def begin(self, theta: Sizes, cuts: Sequence[Cut]) -> tuple[Setting, States]:
        """Return the setting with effects at ``theta``, and the initial states of other windows of
        the model's flights, fitted in it.
        """
        setting = self.at(theta)
        flights = ReplayedFlights(self.flights.flights, cuts, self.setting)
        return setting, InitialFit(flights, self.simulation(setting)).settle({})

    def simulation(self, *settings: Setting) -> Simulation:
        """Prepare settings for simulation with this model's steps."""
        return Simulation(settings, self.substep, self.device)

    def _settle(self, setting: Setting) -> States:
        """Return the initial states fitted in a setting."""
        states, slopes = self._nominal
        if setting == self.setting:
            return states
        fitter = InitialFit(self.flights, self.simulation(setting))
        places = [way.place for way in directions(self.setting.plant)]
        alike = [way.place for way in fitter.directions] == places
        return fitter.settle(slopes if alike else {})

    @staticmethod
    def _step(e: SettingEffect, theta: float) -> float:
        """Return the finite difference of theta for an effect: upwards unless that exceeds the
        bounds, 0 for a switch.
        """
        step = 0.0 if e.switch else e.step * e.floor
        return -step if theta + step > e.bounds[1] else step

    def _channel(self, w: int) -> ndarray:
        channels = self.channels
        numbers = [channels.index(name) if name in channels else -1 for name in REPLAYED]
        return self.flights.spread(w, *numbers).astype(int)

    def _cut_slack(self, ends: States) -> list[Cut]:
        """Cut the time in which the rope was slack out of the windows, and mark those soon after
        it; ``ends``: states at the windows' ends.
        """
        cuts: list[Cut] = []
        rings = {}  # flight -> time until which its rope may whip
        for w, c in enumerate(self.flights.cuts):
            first = ends["slack_first"][w]
            last = ends["slack_last"][w]
            separation = self.flights.separation(w)
            if c.payload == ATTACHED and c.start < rings.get(c.flight, -np.inf):
                c = replace(c, after_slack=True)
            if last < c.start:
                cuts.append(c)
                continue
            rings[c.flight] = last + RINGING
            cuts += around_slack(c, first, last + AFTER_SLACK, separation)
        return cuts


def effects_for(
    setting: Setting, channels: set[str], payload: bool, releases: bool, simpler: bool = False
) -> dict[str, SettingEffect]:
    """Return the effects that apply to a setting and to logs with these channels, with bounds
    derived from the setting.

    ``simpler``: whether blocks simpler than the setting's are considered.
    """
    chosen = {}
    unconcerned: set[str] = set()  # blocks
    if not payload:
        unconcerned |= {"rope", "rope mount", "payload", "payload air"}
    if not releases:
        unconcerned |= {"release", "ballistic"}
    missing = {"rate_b", "landing"} - channels
    for name, e in catalogue().items():
        if e.block in unconcerned or not e.applies(setting):
            continue
        if e.simpler and not simpler:
            continue
        if name == "battery_charge" and "battery_voltage" in channels:
            continue
        of_payload = name.startswith(("payload_marker", "mocap_delay_payload"))
        if of_payload and "payload_pos_w" not in channels:
            continue
        if missing.isdisjoint(e.channels):
            chosen[name] = e.bound_by(setting)
    return chosen


def _key(theta: Sizes) -> frozenset[tuple[str, float]]:
    """Return the sizes that are not 0."""
    return frozenset((name, float(value)) for name, value in theta.items() if value)


def _list_channels(flights: Sequence[RecordedFlight], carries: bool) -> list[str]:
    """Return the channels of poses and rates that these flights have."""
    measured = [
        True,
        True,
        carries and any(f.payload for f in flights),
        any(f.gyro for f in flights),
    ]
    return list(compress(REPLAYED, measured))

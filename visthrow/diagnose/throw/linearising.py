"""Linearise windows: derivatives of their samples by effects, initial states and latent forces.

A derivative is a finite difference of two lanes with the same step length. Most of them are taken
with longer steps, against a nominal lane of that length. Residuals always use the nominal step.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy import ndarray

from sim.effects.effect import SettingEffect
from sim.effects.setting import Setting
from sim.kernels.replay.kernel import NO_PAYLOAD
from visthrow.diagnose.likelihood.threads import parallel_map
from visthrow.diagnose.models.law_terms import describe_knots
from visthrow.diagnose.models.model_interface import Indices, Window
from visthrow.diagnose.throw.initial_states import MOVED, Direction, States, deviations
from visthrow.diagnose.throw.replay import (
    KNOT_SPACING,
    Lane,
    ReplayedFlights,
    Simulation,
    fly_alike,
)

LATENT_SIZES = (1e-3, 1e-3, 1e-3, 1e-5, 1e-5, 1e-5, 2e-4, 2e-4, 2e-4)
"""Finite differences of the latent forces: force [N], torque [N m], force on the payload [N].

They are small because the controller cancels a steady torque, so its first-order effect is small.
With a hundred times as much, only the second-order effect remained, equal for all axes.
"""
EXACT = ("plant.vehicle.controller.gyro_time_constant", "plant.rope.payload_inertia", "step_square")
"""Parameters whose derivatives use the nominal steps: with twice as long ones they differ by more
than a fifth. The same holds for all derivatives of a rope that has just become taut.
"""

CALM_SPEED = 0.1
"""Root mean square speed of a window [m/s] up to which the air may move as fast as the vehicle.

Rooms have draughts of that speed. A gust pushes a hovering vehicle along, which looks like negative
drag."""
AERODYNAMIC = "aerodynamics"  # block whose effects depend on that speed


def exact(e: SettingEffect) -> bool:
    """Return whether an effect's derivative needs the nominal steps in every window."""
    return any(key.path in EXACT for key in e.changes)


def without_calm_speeds(window: Window, blocks: Sequence[str], wind_w: Sequence[float]) -> Window:
    """Remove the dependence on speeds from a window in which vehicle and air hardly move relative
    to each other; return other windows unchanged.

    ``window``: with all columns; ``wind_w``: of the setting [m/s].
    """
    knots = dict(window.knots)
    if _typical_speed(knots["vel_w"] - wind_w) > CALM_SPEED:
        return window
    knots["vel_w"] = np.zeros_like(knots["vel_w"])
    if "payload_vel_w" in knots and _typical_speed(knots["payload_vel_w"]) < CALM_SPEED:
        knots["payload_vel_w"] = np.zeros_like(knots["payload_vel_w"])
    unaffected = np.array([block != AERODYNAMIC for block in blocks])
    return replace(window, effects=window.effects * unaffected, knots=knots)


def _typical_speed(vel: ndarray) -> float:
    """Return the root mean square of velocities, shape (k, 3)."""
    return np.sqrt((vel**2).sum(1).mean())


@dataclass(frozen=True)
class Plan:
    """The lanes of one window in a run.

    Its columns belong to effects, directions of the initial state, and latent forces.
    """

    window: int
    lanes: list[Lane]
    first: int  # index of its first lane in the run
    first_knot: int  # first row of the knots
    place: ndarray  # lane of each column, relative to the first one
    nominal: ndarray  # lane of the same steps to subtract, relative to the first one
    steps: ndarray  # finite difference of each column
    states: ndarray  # directions of the initial state
    latents: ndarray  # axis and knot, shape (L, 2)


class Linearisation:
    """The part of a linearisation that all windows share."""

    def __init__(
        self,
        flights: ReplayedFlights,
        simulation: Simulation,
        effects: Sequence[SettingEffect],
        steps: ndarray,
        directions: Sequence[Direction],
        states: States,
    ):
        """Store the settings and states of a linearisation.

        Args:
            simulation: the setting of the linearisation, then one for each effect. steps: finite
            differences of the effects, shape (K,). states: initial states, then those perturbed
            along each direction: row ``(1 + d) W + w``.
        """
        self._flights = flights
        self._simulation = simulation
        self._setting, *perturbed = simulation.settings
        self._steps = steps
        self._state_steps = np.array([direction.step for direction in directions])
        self._deviations = deviations(directions, flights.cuts)
        self._states = states
        self._exact = np.array([exact(e) for e in effects], dtype=bool)
        self._blocks = [e.block for e in effects]
        kinds = {flights.kind(w) for w in range(len(flights.cuts))}
        self._alike = {
            kind: np.array([fly_alike(kind, self._setting, x) for x in perturbed], dtype=bool)
            for kind in kinds
        }

    def windows(self, batch: Indices, channels: Sequence[ndarray]) -> list[Window]:
        """Linearise windows whose lanes fit into one run; ``channels``: of each window's
        samples.
        """
        plans = []
        lanes = []
        first_knot = 0
        for w in batch:
            plans.append(self._plan(w, len(lanes), first_knot))
            lanes += plans[-1].lanes
            first_knot += 2 * self._flights.knots[w]
        flown = self._flights.fly(self._simulation, self._states, lanes)

        def window(plan: Plan, channel: ndarray) -> Window:
            residual = self._flights.residual(flown.samples, plan.window, plan.first)
            slopes = self._slopes(flown.samples, plan)
            return self._window(plan, channel, residual, slopes, flown.knots)

        return parallel_map(window, plans, channels)

    def _plan(self, w: int, first: int, first_knot: int) -> Plan:
        """Plan the lanes of one window, in this order: nominal, lanes with the same motion as the
        nominal one, rough nominal, all others.

        ``first``: index of the first lane; ``first_knot``: first row of the knots, of which the
        plan takes twice the window's number."""
        c = self._flights.cuts[w]
        knots = int(self._flights.knots[w])
        alike = self._alike[self._flights.kind(w)]
        riders = np.flatnonzero(alike)
        rough_nominal = 1 + len(riders)
        fine = alike | self._exact | c.after_slack
        states = np.flatnonzero(self._deviations[w])
        axes = 6 if c.payload == NO_PAYLOAD else 9
        latents = np.stack(np.mgrid[:axes, :knots], axis=-1).reshape(-1, 2)
        windows = len(self._flights.cuts)
        columns = [Lane(w, 1 + k, w, rough=not x) for k, x in enumerate(fine)]
        for d in states.tolist():
            columns.append(Lane(w, 0, (1 + d) * windows + w, rough=not c.after_slack))
        for axis, knot in latents.tolist():
            resume = first_knot + knots + max(knot - 1, 0)
            force = axis, knot, LATENT_SIZES[axis]
            parent = first + rough_nominal
            columns.append(Lane(w, 0, w, *force, resume=resume, parent=parent, rough=True))
        others = np.setdiff1d(np.arange(len(columns)), riders)
        lanes = [Lane(w, 0, w, keep=first_knot, shared=len(riders))]
        lanes += [columns[i] for i in riders]
        lanes.append(Lane(w, 0, w, keep=first_knot + knots, rough=True))
        lanes += [columns[i] for i in others]
        place = np.zeros(len(columns), dtype=int)
        place[riders] = 1 + np.arange(len(riders))
        place[others] = 1 + rough_nominal + np.arange(len(others))
        nominal = np.array([rough_nominal * lane.rough for lane in columns])
        latent_steps = np.array(LATENT_SIZES)[latents[:, 0]]
        steps = np.concatenate((self._steps, self._state_steps[states], latent_steps))
        return Plan(w, lanes, first, first_knot, place, nominal, steps, states, latents)

    def _slopes(self, samples: ndarray, plan: Plan) -> ndarray:
        """Return the derivatives of a window's samples by its columns, shape (N, columns).

        ``samples``: of all lanes of the run, shape (rows or more, lanes, 3).
        """
        rows = int(self._flights.rows[plan.window])
        lanes = samples[:rows, plan.first : plan.first + len(plan.lanes)]
        columns = np.swapaxes(lanes, 1, 2).reshape(3 * rows, -1)
        return (columns[:, plan.place] - columns[:, plan.nominal]) / plan.steps

    def _window(
        self,
        plan: Plan,
        channel: ndarray,
        residual: ndarray,
        slopes: ndarray,
        knots: Mapping[str, ndarray],
    ) -> Window:
        """Return the linearised window; ``knots``: quantities at the knots of all lanes.

        Its residual is extrapolated to the mean of the states' prior."""
        w = plan.window
        f = self._flights
        c = f.cuts[w]
        first_state = len(self._steps)
        first_latent = first_state + len(plan.states)
        states = slopes[:, first_state:first_latent]
        axes, places = plan.latents.T
        rows = slice(plan.first_knot, plan.first_knot + f.knots[w])
        values = {name: value[rows] for name, value in knots.items()}
        window = Window(
            c.flight,
            c.phase,
            f.time[w],
            channel,
            residual + states @ self._states[MOVED][w, plan.states],
            f.sigma[w],
            slopes[:, :first_state],
            states,
            self._deviations[w, plan.states],
            slopes[:, first_latent:],
            axes // 3,
            axes % 3,
            c.start + KNOT_SPACING * places,
            at_knots(f, self._setting, w, values),
            c.after_slack,
        )
        return without_calm_speeds(window, self._blocks, self._setting.plant.air.wind_w)


def at_knots(
    flights: ReplayedFlights, setting: Setting, w: int, knots: Mapping[str, ndarray]
) -> dict[str, ndarray]:
    """Return the simulated quantities at the knots, including those of an attached payload."""
    c = flights.cuts[w]
    time = np.minimum(c.start + KNOT_SPACING * np.arange(len(knots["thrust"])), c.end)
    flown = {name: value.copy() for name, value in knots.items()}
    plant = setting.plant
    mount = None
    if c.payload != NO_PAYLOAD:
        mount = np.subtract(plant.rope.mount, plant.vehicle.body.com)
        flown["tension"][time > flights.flights[c.flight].latch + plant.release.lag] = 0.0
    return describe_knots(flown, time, mount)

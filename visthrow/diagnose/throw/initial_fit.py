"""Initial states of replay windows fitted to their samples.

A simulation of every direction costs some twenty times one of the state itself. So derivatives are
taken once, and may come from another setting whose states were fitted before. What that leaves, the
windows' own likelihood makes up for."""

from collections.abc import Sequence

import numpy as np
from numpy import ndarray

from sim.kernels.replay.kernel import ATTACHED
from visthrow.diagnose.models.model_interface import Window
from visthrow.diagnose.models.settling import newton, settle
from visthrow.diagnose.throw.initial_states import (
    MOVED,
    Direction,
    States,
    deviations,
    directions,
    moved_along,
    rows_of,
    stacked,
)
from visthrow.diagnose.throw.replay import Lane, ReplayedFlights, Simulation, carried

DRIFT = 0.02, 0.02, 0.02, 0.04
"""Deviation that gusts bring a flight to in a second: position [m], attitude [rad], payload [m],
rate [rad/s]. Fitted as though there were none, states take their place.
"""
GROWTH = (
    1.5,
    1.0,
    1.5,
    0.5,
)  # powers of the time that they have had: forces act as noise, attitude and rate are controlled
ONWARD = 0.1  # flown after the last sample that depends on the start: sensors may be early [s]
EARLIER = 0.05  # by which a payload may leave before it is expected to [s]
FITTED_SPAN = 0.25  # before that, without which an initial state is fitted to the whole window [s]
TRUSTED = ("motor_speed",)
"""Fields that are linearised about where the commands left them.

Fitted without gusts they would take the gusts' place: rotors far from their commands at the start
of a window, and with them a law of the thrust's slope that is none.
"""


class InitialFit:
    """Fits the states of the windows that count in one setting.

    Attributes:
        rows: derivatives of those windows' samples by their states, as :func:`.settling.settle`
            takes them.
    """

    def __init__(self, flights: ReplayedFlights, simulation: Simulation, lag: float):
        """Make ready; ``simulation``: of the setting; ``lag``: of the release, as far
        as known [s].
        """
        self.flights = flights
        self.simulation = simulation
        self.directions = directions(simulation.settings[0].plant)
        self._numbers = np.array([w for w, c in enumerate(flights.cuts) if c.retained], dtype=int)
        free = [x.follows and x.field not in TRUSTED for x in self.directions]
        self._sd = deviations(self.directions, [flights.cuts[w] for w in self._numbers]) * free
        self._weight, ends = zip(*(telling(flights, w, lag) for w in range(len(flights.cuts))))
        self._shortened = flights.ended(ends)

    def settled(self, rows: Sequence[ndarray] = ()) -> States:
        """Fit each window's initial state to its samples, from what flights through the windows
        give; no step that does not help is taken.

        ``rows``: as :attr:`rows` of another fit has them, if they are known."""
        states, _ = carried(self.flights, self.simulation)
        begun = rows_of(states, self._numbers)
        self.rows = rows or self._rows(begun)

        def moved(unknowns: ndarray) -> States:
            return moved_along(begun, self.directions, self._sd * unknowns)

        none = np.zeros(self._sd.shape)
        unknowns = settle(lambda trial: self._residuals(moved(trial)), self.rows, none)
        fitted = moved(unknowns)
        fitted[MOVED] = self._sd * unknowns
        for name, value in states.items():
            value[self._numbers] = fitted[name]
        return states

    def _residuals(self, states: States) -> list[ndarray]:
        """Return residuals of what tells of initial states, in deviations."""
        lanes = [Lane(w, 0, row) for row, w in enumerate(self._numbers)]
        residuals = self.flights.residuals(self.simulation, states, lanes, self._shortened)
        return [self._weight[w] * residual for w, residual in zip(self._numbers, residuals)]

    def _rows(self, states: States) -> list[ndarray]:
        """Return the derivatives of windows' samples by their initial states, shape (N, D) each."""
        count = len(self._numbers)
        lanes = []
        for row, w in enumerate(self._numbers):
            for d in (-1, *np.flatnonzero(self._sd[row])):
                lanes.append(Lane(w, 0, (1 + d) * count + row, rough=True))
        moved = perturbed(states, self.directions)
        measured = self.flights.fly(self.simulation, moved, lanes, self._shortened).seen
        steps = np.array([d.step for d in self.directions])
        rows = []
        first = 0
        for w, sd in zip(self._numbers, self._sd):
            free = np.flatnonzero(sd)
            slope = np.zeros((len(self._weight[w]), len(sd)))
            change = self.flights.differences(measured, w, first, len(free))
            slope[:, free] = change / steps[free] * sd[free]
            rows.append(slope * self._weight[w][:, None])
            first += 1 + len(free)
        return rows


def telling(flights: ReplayedFlights, w: int, lag: float) -> tuple[ndarray, float]:
    """Return how much a window's samples tell of its start, one over their deviation from a flight
    without gusts, and how long it is flown for their sake [s].

    Gusts may have moved them by their time. What comes after the payload may have left is 0, for it
    tells of the release; nothing is where little is left."""
    c = flights.cuts[w]
    time = flights.time[w]
    since = np.maximum(time - c.start, 0.0)
    drift = flights.spread(w, *DRIFT) * since ** flights.spread(w, *GROWTH)
    weight = 1.0 / np.hypot(flights.sigma[w], drift)
    time_left = flights.flights[c.flight].latch + lag - EARLIER
    if c.payload != ATTACHED or not c.start + FITTED_SPAN < time_left < c.end:
        return weight, c.end
    return weight * (time < time_left), min(time_left + ONWARD, c.end)


def following(
    flights: ReplayedFlights,
    w: int,
    window: Window,
    free: ndarray,
    change: ndarray,
    lag: float,
) -> ndarray:
    """Return how a window's initial state follows a change of the effects, so that the flight stays
    as near to where it was as it can, in the state's units, shape (D,).

    ``free``: which parts of the state follow, shape (D,), bool; ``change``: of the effects' sizes,
    shape (K,); ``lag``: of the release, as far as known [s]."""
    samples = len(flights.time[w])  # and those of a camera, which tell nothing of states
    weight, _ = telling(flights, w, lag)
    sd = window.nuisance_sd[free]
    by_state = window.nuisance[:samples, free] * sd * weight[:, None]
    moves = np.zeros(len(free))
    moves[free] = -sd * newton(by_state, weight * (window.effects[:samples] @ change))
    return moves


def perturbed(states: States, directions: Sequence[Direction]) -> States:
    """The states, and after them each direction's perturbed ones: row ``(1 + d) W + w``."""
    rows = np.arange(len(states["pos_w"]))
    steps = np.diag([d.step for d in directions]).repeat(len(rows), axis=0)
    moved = moved_along(rows_of(states, np.tile(rows, len(directions))), directions, steps)
    return stacked([states, moved])

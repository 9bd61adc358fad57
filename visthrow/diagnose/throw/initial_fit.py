"""Initial states of replay windows fitted to their samples by Levenberg and Marquardt, all windows
at once.

A simulation of every direction costs some thirty times one of the state itself. So derivatives are
used for several steps, as long as each brings what it promised, and may come from another setting
whose states were fitted before."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from sim.kernels.replay.kernel import ATTACHED
from visthrow.diagnose.likelihood.threads import parallel_map
from visthrow.diagnose.models.model_interface import Window
from visthrow.diagnose.throw.initial_states import (
    MOVED,
    Direction,
    States,
    concerns,
    directions,
    moved_along,
    rows_of,
    stacked,
)
from visthrow.diagnose.throw.replay import Lane, ReplayedFlights, Simulation

DAMPING, DAMPING_MOST = (
    1e-3,
    1e5,
)  # of the Levenberg-Marquardt steps: at first, and where a window counts as settled
ROUNDS = 25
DRIFT = 0.02, 0.02, 0.02, 0.04
"""Deviation that gusts bring a flight to in a second: position [m], attitude [rad], payload [m],
rate [rad/s]. Fitted as though there were none, states took their place: bends of the rope of ten
times their prior, after twenty steps.
"""
CALMER = tuple(0.5**k for k in range(1, 11))  # of that, which windows may turn out to have had
GROWTH = (
    1.5,
    1.0,
    1.5,
    0.5,
)  # powers of the time that they have had: forces act as noise, attitude and rate are controlled
HUBER = 30.0  # deviations, beyond which a sample counts less
SETTLED = 1.0, 0.01  # fall of the cost, and relative one, below which an initial state is settled
TRUE = 0.5  # of what it promised, which a step must bring for derivatives to be used further
ONWARD = 0.1  # flown after the last sample that depends on the start: sensors may be early [s]
EARLIER = 0.05  # by which a payload may leave before it is expected to [s]
FITTED_SPAN = 0.25  # before that, without which an initial state is fitted to the whole window [s]
TRUSTED = ("motor_speed",)
"""Fields that are linearised about where the commands left them.

Fitted without gusts they would take the gusts' place: rotors far from their commands at the start
of a window, and with them a law of the thrust's slope that is none.
"""


@dataclass(frozen=True)
class _Trial:
    """A step of each of L windows."""

    states: States  # where it leads
    hoped: np.ndarray  # fall of the cost that it promises, shape (L,)
    cost: np.ndarray  # there, shape (L,)
    residuals: list[np.ndarray]


class InitialFit:
    """Fits the states of the windows that count in one setting."""

    def __init__(self, flights: ReplayedFlights, simulation: Simulation, lag: float):
        """Make ready; ``simulation``: of the setting; ``lag``: of the release, as far
        as known [s].
        """
        self.flights = flights
        self.retained = np.array([w for w, c in enumerate(flights.cuts) if c.retained])
        self.simulation = simulation
        self.directions = directions(simulation.settings[0].plant)
        self.slopes: dict[
            int, np.ndarray
        ] = {}  # of windows' samples by their states, where they were taken last
        self._free = [
            [
                d
                for d, x in enumerate(self.directions)
                if concerns(x, cut) and x.field not in TRUSTED
            ]
            for cut in flights.cuts
        ]  # directions in which windows' initial states are fitted
        self._drift = [drift(flights, w) for w in range(len(flights.cuts))]
        self._gusts = np.ones(
            len(flights.cuts)
        )  # of each window, against the drift that is thought possible
        # deviation of each window's samples from a flight without gusts: noise, and how far gusts
        # may have led by then
        self._spreads = [np.hypot(flights.sigma[w], spread) for w, spread in enumerate(self._drift)]
        self._sensitive, ends = zip(
            *[sensitive_samples(flights, w, lag) for w in range(len(flights.cuts))]
        )
        self._shortened = flights.ended(ends)

    def fit(self, states: States, slopes: Mapping[int, np.ndarray] | None = None) -> States:
        """Fit each window's initial state to its samples; no step that does not help is taken.

        ``states``: to begin with; ``slopes``: of windows' samples by their states, as
        :attr:`slopes` of another fit has them."""
        count = len(self.flights.cuts)
        damping = np.full(count, DAMPING)
        remaining = self.retained
        self.slopes |= slopes or {}
        aged = np.isin(np.arange(count), list(self.slopes))  # derivatives come from elsewhere
        flown = self._residuals(rows_of(states, remaining), remaining)
        residuals = dict(zip(remaining, flown))
        cost = np.full(count, np.inf)
        cost[remaining] = [self._cost(w, residual) for w, residual in residuals.items()]
        stale = ~aged
        for _ in range(ROUNDS):
            self.slopes |= self._slopes(states, remaining[stale[remaining]])
            aged &= ~stale
            trial = self._tried(states, remaining, residuals, damping[remaining])
            helps = trial.cost < cost[remaining]
            tried = np.full(count, np.inf)
            hoped = np.zeros(count)
            tried[remaining] = trial.cost
            hoped[remaining] = trial.hoped
            better = tried < cost
            rows = np.flatnonzero(helps)
            residuals |= {remaining[row]: trial.residuals[row] for row in rows}
            states = {name: value.copy() for name, value in states.items()}
            for name, value in states.items():
                value[remaining[rows]] = trial.states[name][rows]
            fall = np.subtract(cost, tried, out=np.zeros(count), where=better)
            tolerance = np.maximum(SETTLED[0], SETTLED[1] * np.where(better, tried, cost))
            little = better & (fall < tolerance)
            settled = little & ~aged | (hoped < tolerance) & (damping <= DAMPING)
            stale = np.where(better, ~settled & (little | (fall <= TRUE * hoped)), aged & ~settled)
            raised = np.where(aged, damping, 10.0 * damping)
            damping = np.where(better, damping / 10.0, raised)
            aged = aged | better
            cost = np.where(better, tried, cost)
            for w in remaining[settled[remaining]]:
                if self._lower_gusts(w, residuals[w]):
                    settled[w] = False
                    cost[w] = self._cost(w, residuals[w])
            remaining = remaining[~settled[remaining] & (damping[remaining] < DAMPING_MOST)]
            if not len(remaining):
                break
        return states

    def _tried(
        self,
        states: States,
        windows: np.ndarray,
        residuals: Mapping[int, np.ndarray],
        dampings: np.ndarray,
    ) -> _Trial:
        """The next step of each window that is left, with its damping."""
        columns = windows, [residuals[w] for w in windows], states[MOVED][windows], dampings
        steps, hoped = map(np.array, zip(*parallel_map(self._increment, *columns)))
        states_moved = moved_along(rows_of(states, windows), self.directions, steps)
        states_moved[MOVED] = states_moved[MOVED] + steps
        reached = self._residuals(states_moved, windows)
        cost = np.array([self._cost(w, residual) for w, residual in zip(windows, reached)])
        return _Trial(states_moved, hoped, cost, reached)

    def _residuals(self, states: States, which: np.ndarray) -> list[np.ndarray]:
        """Residuals of windows, of what depends on their initial states; a row of the states for
        each.
        """
        f = self.flights
        lanes = [Lane(w, 0, row) for row, w in enumerate(which)]
        measured = f.fly(self.simulation, states, lanes, self._shortened).seen
        return [self._sensitive[w] * f.residual(measured, w, lane) for lane, w in enumerate(which)]

    def _cost(self, w: int, residual: np.ndarray) -> float:
        """Huber's cost of a window's residual; infinite where one is not finite."""
        off = np.abs(residual) / self._spreads[w]
        cost = float(np.sum(np.where(off < HUBER, 0.5 * off**2, HUBER * (off - 0.5 * HUBER))))
        return cost if np.isfinite(cost) else np.inf

    def _lower_gusts(self, w: int, residual: np.ndarray) -> bool:
        """Take a window's gusts for as strong as what is left of it says, if that is much less than
        was thought.
        """
        square = residual**2
        noise = self.flights.sigma[w] ** 2
        drift = self._drift[w] ** 2
        samples = np.count_nonzero(self._sensitive[w])
        calmer = [
            g
            for g in CALMER
            if g < self._gusts[w] and np.sum(square / (noise + g * g * drift)) < samples
        ]
        if not calmer:
            return False
        self._gusts[w] = min(calmer)
        self._spreads[w] = np.hypot(self.flights.sigma[w], self._gusts[w] * self._drift[w])
        return True

    def _slopes(self, states: States, which: np.ndarray) -> dict[int, np.ndarray]:
        """Derivatives of windows' samples by their initial states."""
        if not len(which):
            return {}
        count = len(which)
        lanes = []
        first = []
        ways = {
            d: 1 + index
            for index, d in enumerate(sorted({d for w in which for d in self._free[w]}))
        }
        for row, w in enumerate(which):
            first.append(len(lanes))
            lanes += [
                Lane(w, 0, row, rough=True),
                *[Lane(w, 0, ways[d] * count + row, rough=True) for d in self._free[w]],
            ]
        states_moved = perturbed(rows_of(states, which), [self.directions[d] for d in ways])
        measured = self.flights.fly(self.simulation, states_moved, lanes, self._shortened).seen
        slopes = {}
        for index, w in zip(first, which):
            ds = self._free[w]
            rows = int(self.flights.rows[w])
            flat = np.swapaxes(measured[:rows, index : index + 1 + len(ds)], 1, 2).reshape(
                3 * rows, -1
            )
            steps = np.array([self.directions[d].step for d in ds])
            slopes[w] = (flat[:, 1:] - flat[:, :1]) / steps * self._sensitive[w][:, None]
        return slopes

    def _increment(
        self, w: int, residual: np.ndarray, done: np.ndarray, damping: float
    ) -> tuple[np.ndarray, float]:
        """Levenberg-Marquardt step of a window's state with its vague prior, shape (directions,),
        and the fall of the cost that it promises.

        ``done``: how far it has been moved, shape (directions,)."""
        ds = self._free[w]
        sd = np.array([self.directions[d].spread(self.flights.cuts[w]) for d in ds])
        scaled = self.slopes[w] * sd / self._spreads[w][:, None]
        off = residual / self._spreads[w]
        weight = np.minimum(1.0, HUBER / np.maximum(np.abs(off), 1e-12))
        bend = scaled.T @ (scaled * weight[:, None])
        slope = scaled.T @ (off * weight)
        diagonal = (1.0 + damping) * (bend.diagonal() + 1.0)
        damped = bend - np.diag(bend.diagonal()) + np.diag(diagonal)
        step = np.linalg.solve(damped, slope - done[ds] / sd)
        out = np.zeros(len(done))
        out[ds] = step * sd
        return out, step @ slope - 0.5 * step @ bend @ step


def drift(flights: ReplayedFlights, w: int) -> np.ndarray:
    """Return how far gusts may have moved a window's samples by their time, as a deviation, shape
    (N,).
    """
    since = np.maximum(flights.time[w] - flights.cuts[w].start, 0.0)
    return flights.spread(w, *DRIFT) * since ** flights.spread(w, *GROWTH)


def sensitive_samples(flights: ReplayedFlights, w: int, lag: float) -> tuple[np.ndarray, float]:
    """Which samples tell of a window's start, and how long it is flown for their sake [s].

    They are 1 before the payload may have left, 0 later, for these tell of the release; all 1 where
    few are left."""
    c = flights.cuts[w]
    time = flights.time[w]
    time_left = flights.flights[c.flight].latch + lag - EARLIER
    if c.payload != ATTACHED or not c.start + FITTED_SPAN < time_left < c.end:
        return np.ones(len(time)), c.end
    return (time < time_left).astype(float), min(time_left + ONWARD, c.end)


def following(
    flights: ReplayedFlights, w: int, window: Window, free: np.ndarray, lag: float
) -> np.ndarray:
    """Return how a window's initial state follows its effects, so that the flight stays as near to
    where it was as it can.

    ``free``: which parts of the state follow, shape (D,), bool; ``lag``: of the release, as far as
    known [s]. Returns changes in the state's units by the effects' sizes, shape (D, K)."""
    samples = len(flights.time[w])  # and those of a camera, which tell nothing of states
    weight = (
        sensitive_samples(flights, w, lag)[0] / np.hypot(flights.sigma[w], drift(flights, w))
    )[:, None]
    sd = window.nuisance_sd[free]
    by_state = window.nuisance[:samples, free] * sd * weight
    by_effect = (by_state * weight).T @ window.effects[:samples]
    moves = np.zeros((len(free), by_effect.shape[1]))
    moves[free] = -sd[:, None] * np.linalg.solve(by_state.T @ by_state + np.eye(len(sd)), by_effect)
    return moves


def perturbed(states: States, directions: Sequence[Direction]) -> States:
    """The states, and after them each direction's perturbed ones: row ``(1 + d) W + w``."""
    rows = np.arange(len(states["pos_w"]))
    parts = [states]
    for _, members in groupby(directions, key=lambda d: d.field):
        group = list(members)
        steps = np.repeat(np.diag([d.step for d in group]), len(rows), axis=0)
        parts.append(moved_along(rows_of(states, np.tile(rows, len(group))), group, steps))
    return stacked(parts)

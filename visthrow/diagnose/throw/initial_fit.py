"""Initial states of replay windows fitted to their samples by Levenberg and Marquardt, all windows
at once.

A simulation of every direction costs some thirty times one of the state itself. So derivatives are
used for several steps, as long as each brings what it promised, and may come from another setting
whose states were fitted before."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy import ndarray

from sim.kernels.replay.kernel import ATTACHED
from visthrow.diagnose.likelihood.threads import parallel_map
from visthrow.diagnose.models.model_interface import Window
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
# deviations, beyond which no step leads back: a simulation that ran away
FARTHEST = 1e9
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


class _WindowFit:
    """The fit of one window's state: what was flown last, and how bold its next step is.

    Attributes:
        free: directions that are fitted. sd: their prior deviations.
        sensitive: see :func:`sensitive_samples`.
        spread: deviation of the samples from a flight without gusts: noise, and how far gusts may
            have led by then.
        slopes: of the samples by the free directions, where they were taken last.
        aged: whether they come from elsewhere. stale: whether new ones are due.
    """

    def __init__(self, flights: ReplayedFlights, w: int, directions: Sequence[Direction]):
        """Make ready; see :class:`InitialFit`."""
        sd = deviations(directions, [flights.cuts[w]])[0]
        self.number = w
        self.free = [d for d, x in enumerate(directions) if sd[d] and x.field not in TRUSTED]
        self.sd = sd[self.free]
        self.sigma = flights.sigma[w]
        self.drift = drift(flights, w)
        self.sensitive, self.end = sensitive_samples(flights, w)
        self.gusts = 1.0  # against the drift that is thought possible
        self.spread = np.hypot(self.sigma, self.drift)
        self.slopes: ndarray | None = None
        self.aged = False
        self.stale = True
        self.damping = DAMPING

    def begin(self, residual: ndarray, slopes: ndarray | None) -> None:
        """Start from a residual, with slopes of another fit if there are any."""
        self.residual = residual
        self.cost = self.cost_of(residual)
        if slopes is not None:
            self.slopes = slopes
            self.aged = True
            self.stale = False

    def cost_of(self, residual: ndarray) -> float:
        """Huber's cost of a residual; infinite where it leads nowhere."""
        off = np.abs(residual) / self.spread
        if not np.all(off < FARTHEST):
            return np.inf
        clipped = np.minimum(off, HUBER)
        return float(np.sum(clipped * (off - 0.5 * clipped)))

    def increment(self, done: ndarray) -> tuple[ndarray, float]:
        """Levenberg-Marquardt step with the vague prior, shape (directions,), and the fall of the
        cost that it promises.

        ``done``: how far the state has been moved, shape (directions,)."""
        scaled = self.slopes * self.sd / self.spread[:, None]
        if not np.all(np.abs(scaled) < FARTHEST):
            return np.zeros(len(done)), 0.0
        off = self.residual / self.spread
        weight = np.minimum(1.0, HUBER / np.maximum(np.abs(off), 1e-12))
        bend = scaled.T @ (scaled * weight[:, None])
        slope = scaled.T @ (off * weight)
        diagonal = (1.0 + self.damping) * (bend.diagonal() + 1.0)
        damped = bend - np.diag(bend.diagonal()) + np.diag(diagonal)
        step = np.linalg.solve(damped, slope - done[self.free] / self.sd)
        out = np.zeros(len(done))
        out[self.free] = step * self.sd
        return out, step @ slope - 0.5 * step @ bend @ step

    def judge(self, residual: ndarray, promised: float) -> bool:
        """Take a step if it helps; returns whether it did."""
        cost = self.cost_of(residual)
        better = cost < self.cost
        fall = self.cost - cost if better else 0.0
        lowest = cost if better else self.cost
        tolerance = max(SETTLED[0], SETTLED[1] * lowest)
        little = better and fall < tolerance
        no_hope = promised < tolerance and self.damping <= DAMPING
        self.settled = (little and not self.aged) or no_hope
        if better:
            self.stale = not self.settled and (little or fall <= TRUE * promised)
            self.damping /= 10.0
            self.residual = residual
            self.cost = cost
        else:
            self.stale = self.aged and not self.settled
            self.damping *= 1.0 if self.aged else 10.0
        self.aged = self.aged or better
        if self.settled and self._lower_gusts():
            self.settled = False
            self.cost = self.cost_of(self.residual)
        return better

    @property
    def goes_on(self) -> bool:
        """Whether another step may help."""
        return not self.settled and self.damping < DAMPING_MOST

    def _lower_gusts(self) -> bool:
        """Take gusts for as strong as what is left says, if that is much less than was thought."""
        samples = np.count_nonzero(self.sensitive)
        before = self.gusts
        for gusts in CALMER:
            spread = np.hypot(self.sigma, gusts * self.drift)
            if gusts < self.gusts and np.sum((self.residual / spread) ** 2) < samples:
                self.gusts = gusts
                self.spread = spread
        return self.gusts < before


class InitialFit:
    """Fits the states of the windows that count in one setting."""

    def __init__(self, flights: ReplayedFlights, simulation: Simulation):
        """Make ready; ``simulation``: of the setting."""
        self.flights = flights
        self.simulation = simulation
        self.directions = directions(simulation.settings[0].plant)
        windows = range(len(flights.cuts))
        self._fits = [_WindowFit(flights, w, self.directions) for w in windows]
        self._shortened = flights.ended([fit.end for fit in self._fits])

    @property
    def slopes(self) -> dict[int, ndarray]:
        """Return the derivatives of windows' samples by their states, where they were taken
        last.
        """
        return {fit.number: fit.slopes for fit in self._fits if fit.slopes is not None}

    def settled(self, slopes: Mapping[int, ndarray]) -> States:
        """States fitted from those that flights through the windows give; see :meth:`fit`."""
        states, _ = carried(self.flights, self.simulation)
        return self.fit(states, slopes)

    def fit(self, states: States, slopes: Mapping[int, ndarray]) -> States:
        """Fit each window's initial state to its samples; no step that does not help is taken.

        ``states``: to begin with; ``slopes``: of windows' samples by their states, as
        :attr:`slopes` of another fit has them, as far as they are known."""
        remaining = [fit for fit in self._fits if self.flights.cuts[fit.number].retained]
        states = {name: value.copy() for name, value in states.items()}
        flown = self._residuals(rows_of(states, _numbers(remaining)), remaining)
        for fit, residual in zip(remaining, flown):
            fit.begin(residual, slopes.get(fit.number))
        remaining = [fit for fit in remaining if np.isfinite(fit.cost)]
        for _ in range(ROUNDS):
            if not remaining:
                break
            self._take_slopes(states, [fit for fit in remaining if fit.stale])
            rows = _numbers(remaining)
            done = states[MOVED][rows]
            steps, promised = zip(*parallel_map(_WindowFit.increment, remaining, done))
            trial = moved_along(rows_of(states, rows), self.directions, np.array(steps))
            flown = self._residuals(trial, remaining)
            helps = np.array(list(map(_WindowFit.judge, remaining, flown, promised)))
            for name, value in states.items():
                value[rows[helps]] = trial[name][helps]
            remaining = [fit for fit in remaining if fit.goes_on]
        return states

    def _residuals(self, states: States, fits: Sequence[_WindowFit]) -> list[ndarray]:
        """Residuals of windows, of what depends on their initial states; a row of the states for
        each.
        """
        lanes = [Lane(fit.number, 0, row) for row, fit in enumerate(fits)]
        residuals = self.flights.residuals(self.simulation, states, lanes, self._shortened)
        return [fit.sensitive * residual for fit, residual in zip(fits, residuals)]

    def _take_slopes(self, states: States, fits: Sequence[_WindowFit]) -> None:
        """Take the derivatives of windows' samples by their initial states."""
        if not fits:
            return
        groups = []
        for row, fit in enumerate(fits):
            rows = [row, *[(1 + d) * len(fits) + row for d in fit.free]]
            groups.append([Lane(fit.number, 0, row_moved, rough=True) for row_moved in rows])
        moved = perturbed(rows_of(states, _numbers(fits)), self.directions)
        changes = self.flights.differences(self.simulation, moved, groups, self._shortened)
        for fit, change in zip(fits, changes):
            steps = np.array([self.directions[d].step for d in fit.free])
            fit.slopes = change / steps * fit.sensitive[:, None]
            fit.aged = False


def _numbers(fits: Sequence[_WindowFit]) -> ndarray:
    """Return the windows' numbers."""
    return np.array([fit.number for fit in fits], dtype=int)


def drift(flights: ReplayedFlights, w: int) -> ndarray:
    """Return how far gusts may have moved a window's samples by their time, as a deviation, shape
    (N,).
    """
    since = np.maximum(flights.time[w] - flights.cuts[w].start, 0.0)
    return flights.spread(w, *DRIFT) * since ** flights.spread(w, *GROWTH)


def sensitive_samples(flights: ReplayedFlights, w: int) -> tuple[ndarray, float]:
    """Which samples tell of a window's start, and how long it is flown for their sake [s].

    They are 1 before the payload may have left, 0 later, for these tell of the release; all 1 where
    few are left."""
    c = flights.cuts[w]
    time = flights.time[w]
    time_left = flights.separation(w) - EARLIER
    if c.payload != ATTACHED or not c.start + FITTED_SPAN < time_left < c.end:
        return np.ones(len(time)), c.end
    return (time < time_left).astype(float), min(time_left + ONWARD, c.end)


def following(
    flights: ReplayedFlights,
    w: int,
    window: Window,
    free: ndarray,
    change: ndarray,
) -> ndarray:
    """Return how a window's initial state follows a change of the effects, so that the flight stays
    as near to where it was as it can, in the state's units, shape (D,).

    ``free``: which parts of the state follow, shape (D,), bool; ``change``: of the effects' sizes,
    shape (K,)."""
    samples = len(flights.time[w])  # and those of a camera, which tell nothing of states
    sensitive = sensitive_samples(flights, w)[0]
    weight = sensitive / np.hypot(flights.sigma[w], drift(flights, w))
    sd = window.nuisance_sd[free]
    by_state = window.nuisance[:samples, free] * sd * weight[:, None]
    changed = np.flatnonzero(change)
    shift = by_state.T @ (weight * (window.effects[:samples, changed] @ change[changed]))
    information = by_state.T @ by_state + np.eye(len(sd))
    moves = np.zeros(len(free))
    moves[free] = -sd * np.linalg.solve(information, shift)
    return moves


def perturbed(states: States, directions: Sequence[Direction]) -> States:
    """The states, and after them each direction's perturbed ones: row ``(1 + d) W + w``."""
    rows = np.arange(len(states["pos_w"]))
    steps = np.diag([d.step for d in directions]).repeat(len(rows), axis=0)
    moved = moved_along(rows_of(states, np.tile(rows, len(directions))), directions, steps)
    return stacked([states, moved])

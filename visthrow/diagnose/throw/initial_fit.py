"""Fit the initial states of all replay windows to their samples at once, by Levenberg-Marquardt.

Derivatives by all directions cost some thirty times as much as one simulation of a state. So they
are used for several steps, as long as the cost falls about as predicted, and may come from an
earlier fit in another setting."""

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
    move_along,
    rows_of,
    stack,
)
from visthrow.diagnose.throw.replay import Lane, ReplayedFlights, Simulation, carry_states

DAMPING = 1e-3  # of the first Levenberg-Marquardt step
DAMPING_MOST = 1e5  # at which the fit of a window ends
ROUNDS = 25
DRIFT = 0.02, 0.02, 0.02, 0.04
"""Standard deviation that gusts cause within a second: position [m], attitude [rad], payload [m],
rate [rad/s]. Without it, initial states would be fitted to the gusts: after twenty steps bends of
the rope reached ten times their prior.
"""
CALMER = tuple(0.5**k for k in range(1, 11))  # factors on the drift that are tried
GROWTH = 1.5, 1.0, 1.5, 0.5
"""Powers of time with which the drift grows. Forces act as white noise; attitude and rate are
controlled.
"""
HUBER = 30.0  # deviations from which a sample loses weight
FARTHEST = 1e9  # deviations above which a simulation has diverged
SETTLED = 1.0, 0.01  # absolute and relative decrease of the cost below which a fit ends
TRUE = 0.5  # share of the predicted decrease above which derivatives are used again
ONWARD = 0.1  # simulated after the last sample that depends on the start: sensors may be early [s]
EARLIER = 0.05  # by which the payload may separate before the expected time [s]
FITTED_SPAN = 0.25  # shortest fit before the separation; else the whole window is fitted [s]
TRUSTED = ("motor_speed",)
"""Fields that are not fitted here: they keep the values that the commands lead to.

Otherwise rotor speeds far from their commands would explain gusts at the start of a window, and
cause a spurious law of the thrust's slope.
"""


class _WindowFit:
    """The fit of one window's initial state: its last simulation, derivatives and damping.

    Attributes:
        free: directions that are fitted. sd: their prior deviations.
        sensitive: see :func:`sensitive_samples`.
        spread: deviation of the samples from a flight without gusts, by noise and by the drift that
            gusts cause.
        slopes: derivatives of the samples by the free directions, as taken last.
        aged: whether they were taken at another state. stale: whether new ones are due.
    """

    def __init__(self, flights: ReplayedFlights, w: int, directions: Sequence[Direction]):
        """Prepare the fit of window ``w``."""
        sd = deviations(directions, [flights.cuts[w]])[0]
        self.number = w
        self.free = [d for d, x in enumerate(directions) if sd[d] and x.field not in TRUSTED]
        self.sd = sd[self.free]
        self.sigma = flights.sigma[w]
        self.drift = drift(flights, w)
        self.sensitive, self.end = sensitive_samples(flights, w)
        self.gusts = 1.0  # factor on the drift
        self.spread = np.hypot(self.sigma, self.drift)
        self.slopes: ndarray | None = None
        self.aged = False
        self.stale = True
        self.damping = DAMPING

    def begin(self, residual: ndarray, slopes: ndarray | None) -> None:
        """Start from a residual, and from the slopes of another fit if given."""
        self.residual = residual
        self.cost = self.cost_of(residual)
        if slopes is not None:
            self.slopes = slopes
            self.aged = True
            self.stale = False

    def cost_of(self, residual: ndarray) -> float:
        """Return Huber's cost of a residual; infinite if the simulation diverged."""
        off = np.abs(residual) / self.spread
        if not np.all(off < FARTHEST):
            return np.inf
        clipped = np.minimum(off, HUBER)
        return (clipped * (off - 0.5 * clipped)).sum()

    def increment(self, done: ndarray) -> tuple[ndarray, float]:
        """Return the Levenberg-Marquardt step with the vague prior, shape (directions,), and the
        decrease of the cost that it predicts.

        ``done``: displacement of the state so far, shape (directions,)."""
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
        """Accept a step if the cost falls; return whether it was accepted."""
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
        """Return whether another step may lower the cost."""
        return not self.settled and self.damping < DAMPING_MOST

    def _lower_gusts(self) -> bool:
        """Lower the assumed drift to what the residual shows; return whether it was lowered."""
        samples = np.count_nonzero(self.sensitive)
        before = self.gusts
        for gusts in CALMER:
            spread = np.hypot(self.sigma, gusts * self.drift)
            if gusts < self.gusts and ((self.residual / spread) ** 2).sum() < samples:
                self.gusts = gusts
                self.spread = spread
        return self.gusts < before


class InitialFit:
    """Fits the initial states of retained windows in one setting."""

    def __init__(self, flights: ReplayedFlights, simulation: Simulation):
        """Prepare the fit; ``simulation``: of the setting."""
        self.flights = flights
        self.simulation = simulation
        self.directions = directions(simulation.settings[0].plant)
        windows = range(len(flights.cuts))
        self._fits = [_WindowFit(flights, w, self.directions) for w in windows]
        self._shortened = flights.end_early([fit.end for fit in self._fits])

    @property
    def slopes(self) -> dict[int, ndarray]:
        """Return the derivatives of windows' samples by their initial states, as taken last."""
        return {fit.number: fit.slopes for fit in self._fits if fit.slopes is not None}

    def settle(self, slopes: Mapping[int, ndarray]) -> States:
        """Fit states, starting from those of a simulation through the windows; see :meth:`fit`."""
        states, _ = carry_states(self.flights, self.simulation)
        return self.fit(states, slopes)

    def fit(self, states: States, slopes: Mapping[int, ndarray]) -> States:
        """Fit each window's initial state to its samples.

        ``states``: where the fit starts; ``slopes``: derivatives of windows' samples by their
        states, from the :attr:`slopes` of another fit, for the windows that have any."""
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
            trial = move_along(rows_of(states, rows), self.directions, np.array(steps))
            flown = self._residuals(trial, remaining)
            helps = np.array(list(map(_WindowFit.judge, remaining, flown, promised)))
            for name, value in states.items():
                value[rows[helps]] = trial[name][helps]
            remaining = [fit for fit in remaining if fit.goes_on]
        return states

    def _residuals(self, states: States, fits: Sequence[_WindowFit]) -> list[ndarray]:
        """Simulate windows, one from each row of the states; return the residuals of the samples
        that depend on their initial states.
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
        moved = perturb(rows_of(states, _numbers(fits)), self.directions)
        changes = self.flights.differences(self.simulation, moved, groups, self._shortened)
        for fit, change in zip(fits, changes):
            steps = np.array([self.directions[d].step for d in fit.free])
            fit.slopes = change / steps * fit.sensitive[:, None]
            fit.aged = False


def _numbers(fits: Sequence[_WindowFit]) -> ndarray:
    """Return the windows' numbers."""
    return np.array([fit.number for fit in fits], dtype=int)


def drift(flights: ReplayedFlights, w: int) -> ndarray:
    """Return the standard deviation by which gusts may have moved a window's samples, shape
    (N,).
    """
    since = np.maximum(flights.time[w] - flights.cuts[w].start, 0.0)
    return flights.spread(w, *DRIFT) * since ** flights.spread(w, *GROWTH)


def sensitive_samples(flights: ReplayedFlights, w: int) -> tuple[ndarray, float]:
    """Return which samples depend on a window's initial state alone, and until when it is simulated
    for them [s].

    The weights are 1 until the payload may separate and 0 later, as later samples depend on the
    release. If too few samples remain, all weights are 1."""
    c = flights.cuts[w]
    time = flights.time[w]
    time_left = flights.separation(w) - EARLIER
    if c.payload != ATTACHED or not c.start + FITTED_SPAN < time_left < c.end:
        return np.ones(len(time)), c.end
    return (time < time_left).astype(float), min(time_left + ONWARD, c.end)


def compensate(
    flights: ReplayedFlights,
    w: int,
    window: Window,
    free: ndarray,
    change: ndarray,
) -> ndarray:
    """Return the change of a window's initial state that compensates a change of the effects as far
    as possible, in the state's units, shape (D,).

    ``free``: which parts of the state may change, shape (D,), bool; ``change``: of the effects'
    sizes, shape (K,)."""
    samples = len(flights.time[w])  # those of a camera come after them and do not depend on states
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


def perturb(states: States, directions: Sequence[Direction]) -> States:
    """Return the states followed by those perturbed along each direction: row ``(1 + d) W + w``."""
    rows = np.arange(len(states["pos_w"]))
    steps = np.diag([d.step for d in directions]).repeat(len(rows), axis=0)
    moved = move_along(rows_of(states, np.tile(rows, len(directions))), directions, steps)
    return stack([states, moved])

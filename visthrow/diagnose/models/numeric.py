"""Base class of models that are simulated in NumPy and linearised by central differences, all
windows and all lanes at once.

A lane is one simulation of one window with given effects, initial state and latent forces. Initial
states are fitted first, so that the linearisation is at a path near the measured one."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy import ndarray

from sim.params import LawParams
from visthrow.common.errors import DiagnoseError, LogError, expect_known
from visthrow.diagnose.models.catalogue import ModelEffect, beyond_bounds, effects_of
from visthrow.diagnose.models.law_terms import Term, carries, term_of
from visthrow.diagnose.models.law_terms import exert as exert  # for users' models
from visthrow.diagnose.models.model_interface import Indices, Linearised, Model, Sizes, Window
from visthrow.logs.check.signals import noise
from visthrow.logs.flightlog import Channel, FlightLog
from visthrow.logs.samples import interpolate as interpolate

EFFECT_STEP = 0.05
"""Step of the central differences by effects, in prior deviations. Second-order errors cancel, and
rounding does not matter.
"""
NUISANCE_STEP = 1e-3  # step of the differences by initial states, in prior deviations
SETTLE_STEPS = 5  # Gauss-Newton steps of the initial states
SETTLED = 1e-3  # smallest predicted gain of such a step [nats]
MOST_LANES = 6000  # simulated in one batch


@dataclass(frozen=True, kw_only=True)
class Stretch(Window):
    """A window before any simulation: its residual holds the measurements, without derivatives.

    All stretches of a model have the same D and G.
    """

    start: ndarray
    """First guess of the initial state, shape (D,)."""
    data: Mapping[str, Any]
    """Inputs of simulation and sensors, such as stamps and commands."""


@dataclass(frozen=True)
class Lanes:
    """A batch of simulations."""

    owner: ndarray  # index of the stretch, shape (B,)
    theta: ndarray  # sizes of the effects, shape (B, K)
    nuisance: ndarray  # initial states, shape (B, D)
    latent: ndarray  # coefficients of the latent forces, shape (B, G)

    def part(self, rows: Any) -> "Lanes":
        """Return some of the lanes."""
        return Lanes(self.owner[rows], self.theta[rows], self.nuisance[rows], self.latent[rows])


class NumericModel(Model, ABC):
    """A model whose subclasses implement :meth:`windows_of`, :meth:`simulate` and
    :meth:`measure`.
    """

    cheap = True
    anchored = False  # whether the mean of the initial states' prior counts, rather than their fit
    latent_step = 1.0  # finite difference of latent forces [N or N m]
    pushes: Sequence[tuple[int, int]]  # latent block and axis of each latent force
    knot_count: int  # knots of a latent force in a window
    table: str  # catalogue: name of a file in configs/model_effects, or a path
    needed: Sequence[str] = ()  # channels that a log must have
    inputs: Sequence[str] = ()  # channels that drive the simulation

    def __init__(self, logs: Sequence[FlightLog], params: Any):
        """Cut the logs into windows; ``params``: of the subclass.

        An effect is observable if its channels are among the residuals or the inputs. Raises
        LogError if there is no window."""
        self.params = params
        self.stretches = self.cut(logs)
        if not self.stretches:
            full = [log for log in logs if all(log.samples(name, 1) for name in self.needed)]
            raise LogError(
                f"no stretch of these logs shows {', '.join(self.channels)} in a way that this"
                f" model explains{self.without_windows(full)}"
            )
        driving = set(self.inputs) - set(self.channels)
        self.effects = tuple(
            replace(effect, channels=tuple(c for c in effect.channels if c not in driving))
            for effect in self.catalogue()
        )
        self.numbers = {effect.name: i for i, effect in enumerate(self.effects)}
        self._start = np.array([stretch.start for stretch in self.stretches], dtype=float)
        self._slopes: list[ndarray] = []  # derivatives by the initial states
        self._base = np.zeros(len(self.effects))  # sizes that correspond to theta = 0
        self.laws: tuple[LawParams, ...] = ()  # laws outside the catalogue
        self._flown: NumericModel | None = None  # a copy with further laws

    def catalogue(self) -> list[ModelEffect]:
        """Return the effects of the model, scaled by its parameters."""
        return effects_of(self.table, self.params)

    def cut(self, logs: Sequence[FlightLog]) -> list[Stretch]:
        """Cut logs into windows, except those that lack a channel.

        Raises LogError: all logs lack one.
        """
        lacking = [[name for name in self.needed if not log.samples(name, 1)] for log in logs]
        usable = [i for i, names in enumerate(lacking) if not names]
        if not usable:
            missing = sorted(set(self.needed).intersection(*lacking))
            raise LogError(
                f"no log has all of {', '.join(self.needed)}; missing everywhere:"
                f" {', '.join(missing) or 'none'}"
            )
        return [stretch for i in usable for stretch in self.windows_of(logs[i], i)]

    def windows_of(self, log: FlightLog, number: int) -> list[Stretch]:
        """Cut one log, with the index ``number``, into windows."""
        raise NotImplementedError

    def without_windows(self, logs: Sequence[FlightLog]) -> str:
        """Return why these logs hold no window, as the end of an error message."""
        return ""

    def lay_out(
        self,
        flight: int,
        phase: str,
        channels: Sequence[tuple[ndarray, ndarray, ndarray]],
        span: tuple[float, float],
        data: Mapping[str, Any],
        start: Sequence[float] = (),
        start_sd: Sequence[float] = (),
    ) -> Stretch:
        """Make a stretch from the samples of channels, with latent forces over a span of time.

        ``channels``: stamps, shape (n,), values, shape (n, C), and their standard deviations, which
        broadcast to the values; ``span``: [s]; ``start, start_sd``: guess of the initial state, and
        its standard deviation.
        """
        rows = []
        for number, (stamps, values, deviation) in enumerate(channels):
            columns = np.broadcast_arrays(stamps[:, None], number, values, deviation)
            rows.append([column.ravel() for column in columns])
        time, channel, measured, sigma = np.concatenate(rows, axis=1)
        none = np.zeros((len(time), 0))
        block, axis = np.repeat(self.pushes, self.knot_count, axis=0).T
        knots = np.linspace(*span, self.knot_count)
        return Stretch(
            flight,
            phase,
            time,
            channel.astype(int),
            measured,
            sigma,
            effects=none,
            nuisance=none,
            nuisance_sd=np.array(start_sd, dtype=float),
            latent_block=block,
            latent_axis=axis,
            latent_time=np.tile(knots, len(self.pushes)),
            start=np.array(start, dtype=float),
            data=data,
        )

    def pushes_at(self, lanes: Lanes, shares: ndarray) -> ndarray:
        """Return the latent forces of lanes at fractions of a window's span, shape (T, B,
        pushes).
        """
        weights = triangles(shares, np.linspace(0.0, 1.0, self.knot_count))
        latent = lanes.latent.reshape(len(lanes.latent), -1, self.knot_count)
        forces: ndarray = np.einsum("bpk,tk->tbp", latent, weights)
        return forces

    def extend(self, sizes: Sizes, laws: Sequence[LawParams] = ()) -> None:
        """Extend the model by a diagnosis: add sizes, from which further ones are counted and
        bounded, and laws.

        Raises LogError for a size outside its bounds, and for a law that cannot act in this model.
        """
        base = self.size(sizes)
        for effect, size in zip(self.effects, base):
            if beyond := beyond_bounds(effect, size):
                raise LogError(f"{beyond} in this model")
        if laws:
            known = self.knots(self._lanes(base))[0]
            for law in laws:
                self._expect_law(term_of(law), known)
        self._base = base
        self.laws = (*self.laws, *laws)
        shifted = []
        for effect, size in zip(self.effects, base):
            low, high = effect.bounds
            shifted.append(replace(effect, bounds=(low - size, high - size)))
        self.effects = tuple(shifted)

    def _expect_law(self, term: Term, known: Mapping[str, ndarray]) -> None:
        lacking = sorted(term.needs - known.keys())
        if not lacking and not carries(self.stretches[0].latent_block, term.block):
            lacking = [term.block]
        if lacking:
            reason = self.lawless or f"this model has no {', '.join(lacking)}"
            raise LogError(f"the law {term.formula} cannot act here: {reason}")

    def choose(self, names: Sequence[str]) -> None:
        """Keep only these effects. Raises DiagnoseError for an unknown one."""
        by_name = {effect.name: effect for effect in self.effects}
        expect_known(names, by_name, "no effect '{}' for these logs", DiagnoseError)
        self.effects = tuple(by_name[name] for name in names)
        self.not_offered = len(by_name) - len(names)

    def plain(self) -> "NumericModel":
        """See the base class."""
        model = copy(self)
        model._base = np.zeros_like(self._base)
        model.laws = ()
        model._flown = None
        return model

    def with_laws(self, laws: Sequence[LawParams]) -> "NumericModel":
        """See the base class."""
        if self._flown is None:  # one copy, whose initial states are carried on between calls
            self._flown = copy(self)
        self._flown.laws = (*self.laws, *laws)
        return self._flown

    def simulate(self, lanes: Lanes) -> ndarray:
        """Simulate lanes; return the states on their grids, shape (B, T, S).

        Models without a state need not override this.
        """
        return np.zeros((len(lanes.owner), 2, 0))

    @abstractmethod
    def measure(self, stretch: Stretch, path: ndarray, lanes: Lanes) -> ndarray:
        """Return the sensors' measurements in lanes of one stretch, shape (L, N)."""

    def knots(self, lanes: Lanes) -> list[Mapping[str, ndarray]]:
        """Return the quantities for laws at the knots of each stretch; ``lanes``: one for each
        stretch.
        """
        knots = []
        for stretch, path in zip(self.stretches, self.simulate(lanes)):
            time = np.unique(stretch.latent_time)
            weights = triangles(time, np.linspace(time[0], time[-1], len(path)))
            knots.append(self.quantities(time, weights @ path))
        return knots

    def quantities(self, time: ndarray, state: ndarray) -> Mapping[str, ndarray]:
        """Return the quantities for laws outside the catalogue at states, shape (k, S); none by
        default.
        """
        return {}

    def exert(self, block: str, state: ndarray) -> ndarray:
        """Return the force or torque of the model's laws on a latent block, shape (B, 3)."""
        if not self.laws:
            return np.zeros((len(state), 3))
        return exert(self.laws, self.quantities(np.zeros(len(state)), state))[block]

    def size(self, theta: Sizes) -> ndarray:
        """Return the total sizes of all effects in order, shape (K,).

        Raises LogError for an unknown effect.
        """
        expect_known(theta, self.numbers, "no effect '{}'", LogError)
        sizes = np.array([theta.get(name, 0.0) for name in self.numbers])
        total: ndarray = self._base + sizes
        return total

    def of_windows(self, lanes: Lanes, name: str) -> ndarray:
        """Return an entry of the windows' data, which has one shape in all windows, for each
        lane.
        """
        values = np.array([s.data[name] for s in self.stretches])
        return np.take(values, lanes.owner, axis=0)

    def size_of(self, lanes: Lanes, name: str) -> ndarray:
        """Return the sizes of an effect, shape (B,); zeros if the catalogue lacks it."""
        if name not in self.numbers:
            return np.zeros(len(lanes.owner))
        return lanes.theta[:, self.numbers[name]]

    def stack(self, lanes: Lanes, *names: str) -> ndarray:
        """Return the sizes of several effects, shape (B, N); zeros for an empty name."""
        return np.stack([self.size_of(lanes, name) for name in names], axis=1)

    def windows(self, theta: Sizes) -> list[Window]:
        """See :class:`visthrow.diagnose.models.model_interface.Model`."""
        size = self.size(theta)
        self._slopes = []
        residuals = self._settle(size)
        self._slopes = self._slopes_by_start(size)
        residuals = self._from_prior(residuals)
        numbers = [self.numbers[effect.name] for effect in self.effects]
        steps = EFFECT_STEP * np.array([effect.prior_sd for effect in self.effects])
        effects = self._slopes_by(size, "theta", steps, numbers)
        steps = np.full(len(self.stretches[0].latent_block), self.latent_step)
        latent = self._slopes_by(size, "latent", steps, range(len(steps)))
        knots = self.knots(self._lanes(size))
        windows: list[Window] = []
        for i, stretch in enumerate(self.stretches):
            window = replace(
                stretch,
                residual=residuals[i],
                effects=effects[i],
                nuisance=self._slopes[i],
                latent=latent[i],
                knots=knots[i],
            )
            windows.append(window)
        return windows

    def residuals(self, theta: Sizes, linearised: Linearised | None = None) -> list[ndarray]:
        """See :class:`.model_interface.Model`; initial states are fitted anew."""
        return self._from_prior(self._settle(self.size(theta)))

    def _from_prior(self, residuals: list[ndarray]) -> list[ndarray]:
        """Extrapolate residuals to initial states at their prior means, if these count."""
        if not self.anchored:
            return residuals
        moves = [start - s.start for start, s in zip(self._start, self.stretches)]
        return [r + slope @ move for r, slope, move in zip(residuals, self._slopes, moves)]

    def _lanes(self, size: ndarray, start: ndarray | None = None) -> Lanes:
        """Return one lane for each stretch."""
        count = len(self.stretches)
        start = self._start if start is None else start
        latent = np.zeros((count, len(self.stretches[0].latent_block)))
        return Lanes(np.arange(count), np.tile(size, (count, 1)), start, latent)

    def _simulate_measurements(self, lanes: Lanes) -> list[ndarray]:
        """Simulate the measurements of lanes, shape (L, N) for each stretch; all stretches have the
        same number L of lanes, one stretch after the other.
        """
        each = len(lanes.owner) // len(self.stretches)
        batch = max(1, MOST_LANES // each)
        measured = []
        for first in range(0, len(self.stretches), batch):
            part = lanes.part(slice(first * each, (first + batch) * each))
            paths = self.simulate(part)
            for i, stretch in enumerate(self.stretches[first : first + batch]):
                rows = slice(i * each, (i + 1) * each)
                measured.append(self.measure(stretch, paths[rows], part.part(rows)))
        return measured

    def _off(self, size: ndarray, start: ndarray) -> list[ndarray]:
        """Return the residuals of all stretches from given initial states, shape (N,) each."""
        measured = self._simulate_measurements(self._lanes(size, start))
        return [s.residual - only for s, (only,) in zip(self.stretches, measured)]

    def _settle(self, size: ndarray) -> list[ndarray]:
        """Fit the initial state of each window; return the residuals."""
        residuals = self._off(size, self._start)
        if not self._start.shape[1]:
            return residuals
        if not self._slopes:
            self._slopes = self._slopes_by_start(size)
        aims = self._aims(residuals, self._start)
        for _ in range(SETTLE_STEPS):
            steps = np.array([self._newton(i, aim) for i, aim in enumerate(aims)])
            before = _costs(aims)
            for shrink in (1.0, 0.3):
                if not np.any(steps):
                    break
                trial = self._start + shrink * steps
                trial_residuals = self._off(size, trial)
                trial_aims = self._aims(trial_residuals, trial)
                better = _costs(trial_aims) < _costs(aims)
                for i in np.flatnonzero(better):
                    residuals[i] = trial_residuals[i]
                    aims[i] = trial_aims[i]
                self._start = np.where(better[:, None], trial, self._start)
                steps[better] = 0.0
            if np.max(before - _costs(aims)) < 2 * SETTLED:
                break
        return residuals

    def _aims(self, residuals: list[ndarray], start: ndarray) -> list[ndarray]:
        """Return residuals followed by the distances from the prior mean, in standard
        deviations.
        """
        aims = []
        for s, residual, state in zip(self.stretches, residuals, start):
            back = (s.start - state) / s.nuisance_sd
            aims.append(np.concatenate([residual / s.sigma, back]))
        return aims

    def _newton(self, i: int, aim: ndarray) -> ndarray:
        """Return the Gauss-Newton step of a window's initial state; 0 if it would gain little."""
        s = self.stretches[i]
        none = np.zeros(len(s.start))
        prior = np.diag(1.0 / s.nuisance_sd)
        rows = np.concatenate([self._slopes[i] / s.sigma[:, None], prior])
        if not (np.all(np.isfinite(aim)) and np.all(np.isfinite(rows))):
            return none  # the search drops this window and reports it
        step = np.linalg.lstsq(rows, aim, rcond=None)[0]
        return step if 0.5 * aim @ rows @ step > SETTLED else none

    def _slopes_by_start(self, size: ndarray) -> list[ndarray]:
        """Return the derivatives of the samples by the initial states."""
        steps = NUISANCE_STEP * np.array([s.nuisance_sd for s in self.stretches])
        return self._slopes_by(size, "nuisance", steps, range(steps.shape[1]))

    def _slopes_by(
        self, size: ndarray, name: str, steps: ndarray, columns: Indices
    ) -> list[ndarray]:
        """Return the derivatives of the samples by central differences, shape (N, C) for each
        stretch.

        Args:
            size: of the effects.
            name: field of :class:`Lanes` that is varied.
            steps: of its columns, for all stretches or for each, shape (C,) or (S, C).
            columns: columns that are varied.
        """
        stretches = self.stretches
        count = len(columns)
        if not count:
            return [np.zeros((len(s.residual), 0)) for s in stretches]
        lanes = self._lanes(size)
        steps = np.broadcast_to(steps, (len(stretches), count))
        axes = np.eye(getattr(lanes, name).shape[1])[list(columns)]
        moves = np.concatenate([step[:, None] * axes for step in steps])
        lanes = lanes.part(np.repeat(lanes.owner, count))
        middle = getattr(lanes, name)
        above = self._simulate_measurements(replace(lanes, **{name: middle + moves}))
        below = self._simulate_measurements(replace(lanes, **{name: middle - moves}))
        slopes = []
        for higher, lower, step in zip(above, below, steps):
            slopes.append((0.5 * (higher - lower)).T / step)
        return slopes


def _costs(aims: list[ndarray]) -> ndarray:
    """Return the sum of squares of each window; infinite if a simulation diverged."""
    squares = np.array([aim @ aim for aim in aims])
    return np.where(np.isnan(squares), np.inf, squares)


def sigma_of(channel: Channel, floor: float) -> ndarray:
    """Estimate the noise of a channel's components from its samples.

    ``floor``: smallest noise; ten times that is returned if there are too few samples.
    """
    estimate = noise(channel)
    return np.maximum(np.where(np.isfinite(estimate), estimate, 10.0 * floor), floor)


def take_samples(channel: Channel, params: Any, start: float) -> tuple[ndarray, ndarray]:
    """Return stamps and values of a window's samples, every n-th one; ``params``: window length and
    n.
    """
    inside = (channel.time >= start) & (channel.time < start + params.window)
    rows = np.flatnonzero(channel.valid & inside)[:: params.every]
    return channel.time[rows], channel.values[rows].astype(float).reshape(len(rows), -1)


def command_of(thrust_map: Sequence[float], thrust: ndarray) -> ndarray:
    """Return the command at which a map gives a thrust.

    ``thrust_map``: thrust by powers 0, 1, 2 of the command [N]; ``thrust``: [N], of any shape.
    """
    constant, linear, quadratic = thrust_map
    if quadratic == 0.0:
        return (thrust - constant) / linear
    inner = linear**2 - 4.0 * quadratic * (constant - thrust)
    root: ndarray = np.sqrt(np.maximum(inner, 0.0))
    return (root - linear) / (2.0 * quadratic)


def halves(steps: int) -> ndarray:
    """Return the half steps of a window as shares of it."""
    return np.linspace(0.0, 1.0, 2 * steps + 1)


def integrate(
    slope: Callable[[int, ndarray], ndarray],
    state: ndarray,
    steps: int,
    step: ndarray | float,
) -> ndarray:
    """Integrate lanes by the classical fourth-order Runge-Kutta method; return their paths, shape
    (B, steps + 1, S).

    ``slope``: function of the number of half steps since the start, and the state; ``state``: at
    the start, shape (B, S); ``step``: [s], for all lanes or for each, shape (B, 1)."""
    path = np.empty((len(state), steps + 1, state.shape[1]))
    half = 0.5 * step
    path[:, 0] = state
    for i in range(steps):
        k1 = slope(2 * i, state)
        k2 = slope(2 * i + 1, state + half * k1)
        k3 = slope(2 * i + 1, state + half * k2)
        k4 = slope(2 * i + 2, state + step * k3)
        state = path[:, i + 1] = state + step / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
    return path


def triangles(time: ndarray, knots: ndarray) -> ndarray:
    """Return the weights of linear interpolation between knots, shape (T, knots)."""
    return np.column_stack([np.interp(time, knots, row) for row in np.eye(len(knots))])

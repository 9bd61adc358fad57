"""A model that is simulated in NumPy and linearised by central differences, all windows and all
lanes at once.

A lane is one simulation of one window with sizes of effects, unknowns at its start and latent
forces of its own. What is not known at the start is fitted before the linearisation, so that the
linearisation is about a path near the measured one."""

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
from visthrow.diagnose.models.law_terms import exerted as exerted  # for users' models
from visthrow.diagnose.models.model_interface import Linearised, Model, Window
from visthrow.logs.check.signals import noise
from visthrow.logs.flightlog import Channel, FlightLog
from visthrow.logs.samples import on_grid as on_grid

EFFECT_STEP = 0.05
"""Step of the differences by effects, in their prior deviations: errors of curvature cancel, those
of rounding do not matter.
"""
NUISANCE_STEP = 1e-3  # step of the differences by unknowns at the start, in their prior deviations
SETTLE_STEPS = 5
# a Gauss-Newton step on the unknowns at the start that promises less than this [nats] is not tried
SETTLED = 1e-3
MOST_LANES = 6000  # simulated in one batch


@dataclass(frozen=True, kw_only=True)
class Stretch(Window):
    """A window before any simulation: its residual is what was measured, and it has no derivatives.

    All stretches of a model have the same D and G.
    """

    start: ndarray
    """First guess of what is not known at the start, shape (D,)."""
    data: Mapping[str, Any]
    """What simulation and sensors read: inputs, stamps."""


@dataclass(frozen=True)
class Lanes:
    """Simulations of one batch."""

    owner: ndarray  # index of the stretch, shape (B,)
    theta: ndarray  # sizes of the effects, shape (B, K)
    nuisance: ndarray  # unknowns at the start, shape (B, D)
    latent: ndarray  # coefficients of the latent forces, shape (B, G)

    def part(self, rows: Any) -> "Lanes":
        """Some of them."""
        return Lanes(self.owner[rows], self.theta[rows], self.nuisance[rows], self.latent[rows])


class NumericModel(Model, ABC):
    """A model whose subclasses give :meth:`windows_of`, :meth:`simulate` and :meth:`measure`."""

    cheap = True
    # whether the prior of the unknowns at the start says something: else it is about their fit
    anchored = False
    latent_step = 1.0  # of the differences by latent forces [N or N m]
    # latent block and axis of each latent force, and the number of its knots over a window
    pushes: Sequence[tuple[int, int]]
    knot_count: int
    table: str  # effects: a file of configs/model_effects by its name, or another by its path
    needed: Sequence[str] = ()  # channels without which a log holds no window
    inputs: Sequence[str] = ()  # channels that are there and drive the simulation

    def __init__(self, logs: Sequence[FlightLog], params: Any):
        """Cut the logs into windows; ``params``: of the subclass.

        An effect that needs any other channel than those that residuals are taken of, or that drive
        the simulation, cannot be seen. Raises LogError where there is no window."""
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
        self._slopes: list[ndarray] = []  # by the unknowns at the start
        self._base = np.zeros(
            len(self.effects)
        )  # sizes that the model has before anything is found
        self.laws: tuple[LawParams, ...] = ()  # that act in it besides
        self._flown: NumericModel | None = None  # the same with more laws

    def catalogue(self) -> list[ModelEffect]:
        """Return the effects of the model in the numbers of its parameters."""
        return effects_of(self.table, self.params)

    def cut(self, logs: Sequence[FlightLog]) -> list[Stretch]:
        """Cut logs into windows; those that lack a channel hold none.

        Raises LogError: all lack one.
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
        """Cut one log, the flight of a number, into windows."""
        raise NotImplementedError

    def without_windows(self, logs: Sequence[FlightLog]) -> str:
        """Say what of logs that hold no window is unlike a flight."""
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
        """Lay out the samples of channels and the knots of latent forces over a span of time.

        ``channels``: stamps, shape (n,), values, shape (n, C), and their deviations, which
        broadcast to the values; ``span``: [s]; ``start, start_sd``: guess of what is not known at
        the start, and its deviation.
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
        """Return latent forces of lanes at shares of a window's span, shape (T, B, pushes)."""
        weights = triangles(shares, np.linspace(0.0, 1.0, self.knot_count))
        latent = lanes.latent.reshape(len(lanes.latent), -1, self.knot_count)
        forces: ndarray = np.einsum("bpk,tk->tbp", latent, weights)
        return forces

    def extend(self, sizes: Mapping[str, float], laws: Sequence[LawParams] = ()) -> None:
        """Give the model what a diagnosis found: sizes are counted, and bounded, from there; laws
        act besides.

        Raises LogError for a size outside its bounds, and a law that cannot act in this model.
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
        for effect, size in zip(self.effects, base.tolist()):
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
        """Keep these effects alone. Raises DiagnoseError for one that it does not know."""
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
        if self._flown is None:  # its initial states follow from call to call
            self._flown = copy(self)
        self._flown.laws = (*self.laws, *laws)
        return self._flown

    def simulate(self, lanes: Lanes) -> ndarray:
        """Simulate lanes; returns the states on each one's grid, shape (B, T, S).

        Models without a state need not override it.
        """
        return np.zeros((len(lanes.owner), 2, 0))

    @abstractmethod
    def measure(self, stretch: Stretch, path: ndarray, lanes: Lanes) -> ndarray:
        """Return the sensors' measurements in lanes of one stretch, shape (L, N)."""

    def knots(self, lanes: Lanes) -> list[Mapping[str, ndarray]]:
        """Return quantities of laws at the knots of each stretch's latent forces; ``lanes``: one a
        stretch.
        """
        knots = []
        for stretch, path in zip(self.stretches, self.simulate(lanes)):
            time = np.unique(stretch.latent_time)
            weights = triangles(time, np.linspace(time[0], time[-1], len(path)))
            knots.append(self.quantities(time, weights @ path))
        return knots

    def quantities(self, time: ndarray, state: ndarray) -> Mapping[str, ndarray]:
        """Return quantities of laws outside the catalogue at states, shape (k, S); none by
        default.
        """
        return {}

    def exerted(self, block: str, state: ndarray) -> ndarray:
        """Return what the model's laws exert in a latent block at states of lanes, shape (B, 3)."""
        if not self.laws:
            return np.zeros((len(state), 3))
        return exerted(self.laws, self.quantities(np.zeros(len(state)), state))[block]

    def size(self, theta: Mapping[str, float]) -> ndarray:
        """Sizes of all effects in order, with those it had before, shape (K,).

        Raises LogError for an effect that it does not know.
        """
        expect_known(theta, self.numbers, "no effect '{}'", LogError)
        sizes = np.array([theta.get(name, 0.0) for name in self.numbers])
        total: ndarray = self._base + sizes
        return total

    def of_windows(self, lanes: Lanes, name: str) -> ndarray:
        """Return an entry of the windows' data, of one shape in all windows, a row for each
        lane.
        """
        values = np.array([s.data[name] for s in self.stretches])
        return np.take(values, lanes.owner, axis=0)

    def size_of(self, lanes: Lanes, name: str) -> ndarray:
        """Sizes of one effect, shape (B,); zeros where the catalogue leaves it out."""
        if name not in self.numbers:
            return np.zeros(len(lanes.owner))
        return lanes.theta[:, self.numbers[name]]

    def stack(self, lanes: Lanes, *names: str) -> ndarray:
        """Sizes of several effects, shape (B, N); zeros for an empty name."""
        return np.stack([self.size_of(lanes, name) for name in names], axis=1)

    def windows(self, theta: Mapping[str, float]) -> list[Window]:
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

    def residuals(
        self, theta: Mapping[str, float], linearised: Linearised | None = None
    ) -> list[ndarray]:
        """See :class:`.model_interface.Model`; initial states are fitted anew."""
        return self._from_prior(self._settle(self.size(theta)))

    def _from_prior(self, residuals: list[ndarray]) -> list[ndarray]:
        """Return residuals as with the unknowns in the middle of their prior, where that counts."""
        if not self.anchored:
            return residuals
        moves = [start - s.start for start, s in zip(self._start, self.stretches)]
        return [r + slope @ move for r, slope, move in zip(residuals, self._slopes, moves)]

    def _lanes(self, size: ndarray, start: ndarray | None = None) -> Lanes:
        """One lane a stretch."""
        count = len(self.stretches)
        start = self._start if start is None else start
        latent = np.zeros((count, len(self.stretches[0].latent_block)))
        return Lanes(np.arange(count), np.tile(size, (count, 1)), start, latent)

    def _measured(self, lanes: Lanes) -> list[ndarray]:
        """Return what lanes measure, (lanes of it, N) a stretch; all have as many, in turn."""
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
        """Return the residuals of all stretches from states at their starts, shape (N,) each."""
        measured = self._measured(self._lanes(size, start))
        return [s.residual - only for s, (only,) in zip(self.stretches, measured)]

    def _settle(self, size: ndarray) -> list[ndarray]:
        """Fit what is not known at the start, window by window; returns the residuals."""
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
        """Return residuals, and behind them the way back to the prior's middle, in their
        deviations.
        """
        aims = []
        for s, residual, state in zip(self.stretches, residuals, start):
            back = (s.start - state) / s.nuisance_sd
            aims.append(np.concatenate([residual / s.sigma, back]))
        return aims

    def _newton(self, i: int, aim: ndarray) -> ndarray:
        """Return the Gauss-Newton step of a window's unknowns; 0 where it promises little."""
        s = self.stretches[i]
        none = np.zeros(len(s.start))
        prior = np.diag(1.0 / s.nuisance_sd)
        rows = np.concatenate([self._slopes[i] / s.sigma[:, None], prior])
        if not (np.all(np.isfinite(aim)) and np.all(np.isfinite(rows))):
            return none  # no step mends that; the search says which window it is
        step = np.linalg.lstsq(rows, aim, rcond=None)[0]
        return step if 0.5 * aim @ rows @ step > SETTLED else none

    def _slopes_by_start(self, size: ndarray) -> list[ndarray]:
        """Return the derivatives of the samples by what is not known at the start."""
        steps = NUISANCE_STEP * np.array([s.nuisance_sd for s in self.stretches])
        return self._slopes_by(size, "nuisance", steps, range(steps.shape[1]))

    def _slopes_by(
        self, size: ndarray, name: str, steps: ndarray, columns: Sequence[int]
    ) -> list[ndarray]:
        """Return derivatives of the samples by central differences, (N, C) a stretch.

        Args:
            size: of the effects.
            name: of the field of :class:`Lanes` that is moved.
            steps: of its columns, for all stretches or each, shape (C,) or (S, C).
            columns: those that are moved.
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
        above = self._measured(replace(lanes, **{name: middle + moves}))
        below = self._measured(replace(lanes, **{name: middle - moves}))
        slopes = []
        for higher, lower, step in zip(above, below, steps):
            slopes.append((0.5 * (higher - lower)).T / step)
        return slopes


def _costs(aims: list[ndarray]) -> ndarray:
    """Return the sum of squares of each window; infinite where a simulation ran away."""
    squares = np.array([aim @ aim for aim in aims])
    return np.where(np.isnan(squares), np.inf, squares)


def sigma_of(channel: Channel, floor: float) -> ndarray:
    """Noise of a channel's components as the samples show it.

    ``floor``: below which none is believed; ten times that stands where too few samples tell.
    """
    estimate = noise(channel)
    return np.maximum(np.where(np.isfinite(estimate), estimate, 10.0 * floor), floor)


def take_samples(channel: Channel, params: Any, start: float) -> tuple[ndarray, ndarray]:
    """Return stamps and values of every n-th sample in a window of a model's parameters."""
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
    """Path of lanes on their grids by Runge-Kutta steps of fourth order, shape (B, steps + 1, S).

    ``slope``: of the half step counted from the start, and the state; ``state``: at the start,
    shape (B, S); ``step``: [s], of all lanes or of each, shape (B, 1)."""
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
    """Weights of the knots at each time: linear between neighbours, shape (T, knots)."""
    return np.column_stack([np.interp(time, knots, row) for row in np.eye(len(knots))])

"""A point of the search: the model linearised at some sizes of its effects, with fitted noise
levels.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy import ndarray

from visthrow.diagnose.likelihood import noise_levels as levels
from visthrow.diagnose.likelihood.correlation import Correlation, correlations, with_correlations
from visthrow.diagnose.likelihood.evidence import (
    INEXACT,
    LOST_SHARE,
    MODEL_ERROR_FLOOR,
    UNKNOWN_RATIO,
    Posterior,
    Priors,
)
from visthrow.diagnose.likelihood.grammar import TermEffect, forces
from visthrow.diagnose.likelihood.integrals import Integrals
from visthrow.diagnose.likelihood.marginal import (
    Gram,
    Noise,
    Statistics,
    correlate_all,
    grams_of,
    with_residuals,
)
from visthrow.diagnose.likelihood.threads import parallel_map
from visthrow.diagnose.models.model_interface import (
    Effect,
    Indices,
    Linearised,
    Model,
    Sizes,
    Window,
)
from visthrow.diagnose.select.candidates import (
    Shares,
    estimate_shares,
    evidence_of,
    integrate_shares,
)

ROUNDS = 3
"""Limit for Gauss-Newton steps between two linearisations, for successive linearisations, and for
rounds of dropping windows. Each of them leaves about a tenth of the error.
"""

SMALL_STEP = 0.5 * MODEL_ERROR_FLOOR
"""A smaller step is not simulated, and an estimate this close to a bound counts as on it
[floors].
"""

TURNS = 8  # largest number of alternations between sizes and noise levels
TURNED = 0.5  # predicted gain of a step of the sizes below which these end [nats]


@dataclass(frozen=True)
class Problem:
    """The fixed part of a search: model, windows and noise correlation."""

    model: Model
    kept: tuple[int, ...]  # indices of the windows that are used
    correlated: Mapping[int, Correlation] = field(default_factory=dict)  # by index of the channel
    # terms of laws: further effects, whose columns follow from those of the latent forces
    terms: tuple[TermEffect, ...] = ()
    # probability that each command of each window was lost; empty: none was
    lost: tuple[ndarray, ...] = ()

    @staticmethod
    def of(model: Model, windows: Sequence[Window], numbers: Indices) -> "Problem":
        """Set up a problem with some of a model's windows; estimate their noise correlation."""
        plain = Problem(model, tuple(numbers))
        slabs = plain.priors.slab * plain.priors.floor
        kept = [windows[i] for i in numbers]
        return replace(plain, correlated=correlations(kept, slabs, len(model.channels)))

    @cached_property
    def priors(self) -> Priors:
        """Return the priors of the effects."""
        return Priors.of(self.effects, tuple(self.model.channels))

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Return the effects of the model, then the terms: K in all."""
        return (*self.model.effects, *self.terms)

    @property
    def switches(self) -> ndarray:
        """Return which effects are switches to another kind of block, shape (K,), bool."""
        return np.array([e.switch for e in self.effects], dtype=bool)

    def only(self, windows: Indices) -> "Problem":
        """Return the problem with some of its windows."""
        lost = tuple(self.lost[w] for w in windows) if self.lost else ()
        return replace(self, kept=tuple(self.kept[w] for w in windows), lost=lost)

    def build_model(self, theta: ndarray) -> Model | None:
        """Return the model with the terms at their sizes as laws; None if linear columns represent
        them. ``theta`` is in floors.
        """
        if not self.terms or not self.model.bends:
            return None
        laws = []
        for effect, size in zip(self.terms, theta[-len(self.terms) :]):
            if size != 0.0:
                laws.append(effect.term.law(float(size * effect.floor)))
        return self.model.with_laws(laws)

    def sizes(self, theta: ndarray) -> dict[str, float]:
        """Return the non-zero sizes of the model's effects in their units, limited to what is
        possible together; ``theta`` is in floors.
        """
        sizes = {}
        for effect, size in zip(self.model.effects, theta):
            if size != 0.0:
                sizes[effect.name] = float(np.clip(size * effect.floor, *effect.bounds))
        return dict(self.model.possible(sizes))

    def possible(self, theta: ndarray) -> ndarray:
        """Limit sizes to what is possible together; both in floors, shape (K,)."""
        sizes = self.sizes(theta)
        together = [sizes.get(effect.name, 0.0) for effect in self.model.effects]
        count = len(together)
        return np.append(together / self.priors.floor[:count], theta[count:])


@dataclass(frozen=True, eq=False)
class Point:
    """Windows and statistics of a problem at sizes theta [floors], shape (K,)."""

    problem: Problem
    theta: ndarray
    windows: Sequence[Window]
    grams: Sequence[Gram]  # latents correlated
    noise: Noise
    plain: Statistics  # of flights, without random shares
    shares: Shares  # of effects that vary between flights or days
    integrals: Integrals  # of the grams under these noise levels
    about: Linearised  # windows and sizes at which the model's derivatives were taken
    # change of each window if a command is lost, shape (N, T); empty if no commands may be lost
    commands: Sequence[ndarray]

    @cached_property
    def by_window(self) -> Statistics:
        """Return the statistics of windows, without random shares."""
        return self.integrals.statistics(self.grams, self.theta)

    @cached_property
    def statistics(self) -> Statistics:
        """Return the statistics of flights with their random shares integrated out."""
        return integrate_shares(self.plain, self.shares)

    @cached_property
    def posterior(self) -> Posterior:
        """Return the posterior of the effects from all flights."""
        return Posterior.of(self.statistics, self.problem.priors)

    @property
    def information(self) -> ndarray:
        """Return the information of all flights, shape (K, K)."""
        return self.posterior.information

    def sigma(self, channel: int) -> float:
        """Return the median of the stated noise of a channel, in its unit; NaN without samples."""
        sigmas = np.concatenate([w.sigma[w.channel == channel] for w in self.windows])
        return float(np.median(sigmas)) if len(sigmas) else float("nan")

    @cached_property
    def with_all_effects_noise(self) -> "Point":
        """Return the point with noise levels estimated with every effect at its linear estimate.

        As long as a large effect is not selected, it raises the noise levels, which hide other
        effects. These levels show what may be hidden."""
        visible = np.flatnonzero(self.problem.priors.visible & ~self.problem.switches)
        return with_noise_at(self, self.posterior.estimate(visible))

    def evidence(self, active: Indices) -> float:
        """Return log Z of a set of effects, comparable between points with other noise levels."""
        nats = evidence_of(self.statistics, self.problem.priors, active)
        return nats + self.noise.log_prior


def regather(point: Point, integrals: Integrals | None = None, **changes: Any) -> Point:
    """Replace fields of a point and compute its statistics.

    ``integrals``: of the grams under the noise levels, if known; ``changes``: fields of the
    point."""
    changed = replace(point, **changes)
    if integrals is None:
        integrals = Integrals(changed.grams, changed.noise)
    plain = _sum_by_flight(changed.problem, integrals, changed.grams, changed.theta)
    return replace(changed, integrals=integrals, plain=plain)


def _sum_by_flight(
    problem: Problem, integrals: Integrals, grams: Sequence[Gram], theta: ndarray
) -> Statistics:
    statistics = integrals.statistics(grams, theta)
    by_flight = statistics.sum_by(statistics.flights)
    days = problem.model.days
    return replace(by_flight, days=[days[f] for f in by_flight.flights] if days else ())


def linearise(
    problem: Problem,
    theta: ndarray,
    start: Noise | None = None,
    windows: Sequence[Window] | None = None,
    shares: Shares | None = None,
) -> Point:
    """Simulate and linearise at ``theta``, and fit the noise levels.

    ``theta``: in floors, shape (K,); ``start``: noise levels from which their fit starts;
    ``windows``: the model's windows at ``theta``, if known; ``shares``: random shares."""
    theta = problem.possible(theta)
    sizes = problem.sizes(theta)
    flown = problem.build_model(theta)
    if windows is None:
        windows = (flown or problem.model).windows(sizes)
    windows_of = with_correlations([windows[i] for i in problem.kept], problem.correlated)
    commands = _commands(problem, sizes, windows_of) if problem.lost else []
    extended = windows_of
    if problem.terms:
        sizes_of = theta if flown is None else 0.0 * theta
        extended = parallel_map(lambda w: with_terms(w, problem.terms, sizes_of), windows_of)
    if commands:
        extended = [_lose_commands(*parts) for parts in zip(extended, commands, problem.lost)]
    cleaned, raw = _clean(problem, extended)
    noise, grams = levels.fit(cleaned, raw, start)
    integrals = Integrals(grams, noise)
    plain = cleaned
    if extended is not windows_of:
        plain = [replace(o, sigma=w.sigma) for w, o in zip(cleaned, windows_of)]
    linearised = Linearised(sizes, dict(zip(problem.kept, plain)))
    statistics = _sum_by_flight(problem, integrals, grams, theta)
    return Point(
        problem,
        theta,
        cleaned,
        grams,
        noise,
        statistics,
        shares or {},
        integrals,
        linearised,
        commands,
    )


def _commands(problem: Problem, sizes: Sizes, windows: Sequence[Window]) -> list[ndarray]:
    """Return the change of each window if a command is lost, shape (N, T) each."""
    commands = []
    for change, window in zip(problem.model.without_commands(sizes, problem.kept), windows):
        behind = len(window.residual) - len(change)  # direct measurements do not change
        commands.append(np.pad(change, ((0, behind), (0, 0))))
    return commands


def _clean(problem: Problem, windows: Sequence[Window]) -> tuple[list[Window], list[Gram]]:
    """Reduce the weight of outliers in windows; return the windows and their inner products."""
    floors = problem.priors.floor
    channels = len(problem.model.channels)
    grams = grams_of(windows, floors, channels)
    cleaned = levels.without_outliers(windows, grams)
    mended = [w for w in range(len(cleaned)) if cleaned[w] is not windows[w]]
    for w, gram in zip(mended, grams_of([cleaned[w] for w in mended], floors, channels)):
        grams[w] = gram
    return cleaned, grams


def with_terms(window: Window, terms: Sequence[TermEffect], theta: ndarray) -> Window:
    """Append terms to the effects of a window, linearised at their sizes in ``theta`` [floors]."""
    columns = window.latent @ forces(window, terms)
    sizes = theta[-len(terms) :] * [e.floor for e in terms]
    effects = np.hstack((window.effects, columns))
    return replace(window, effects=effects, residual=window.residual - columns @ sizes)


def _lose_commands(window: Window, columns: ndarray, lost: ndarray) -> Window:
    """Return a window some of whose commands may be lost: their mean effect is subtracted, and the
    uncertainty of each becomes a nuisance.

    ``columns``: change by each command, shape (N, T); ``lost``: probability of each that it was
    lost, shape (T,)."""
    sd = np.append(window.nuisance_sd, np.sqrt(lost * (1.0 - lost)))
    nuisance = np.hstack((window.nuisance, columns))
    residual = window.residual - columns @ lost
    return replace(window, residual=residual, nuisance=nuisance, nuisance_sd=sd)


def statistics_of(
    point: Point, windows: Sequence[Window], columns: Sequence[ndarray], rows: Indices
) -> Statistics:
    """Return the statistics of windows with further columns after those of the effects; windows
    with fewer columns are padded with 0.

    Args:
        point: gives the noise levels.
        windows: with residuals at the point.
        columns: of each window, shape (N, T).
        rows: indices of the windows among the point's.
    """
    longest = max(changes.shape[1] for changes in columns)
    wide = []
    for window, changes in zip(windows, columns):
        padded = np.zeros((len(window.residual), longest))
        padded[: len(changes), : changes.shape[1]] = changes
        wide.append(replace(window, effects=np.hstack((window.effects, padded))))
    problem = point.problem
    floors = np.append(problem.priors.floor, np.ones(longest))
    grams = grams_of(wide, floors, len(problem.model.channels))
    grams = correlate_all(grams, wide, point.noise.correlation_time)
    noise = levels.only(point.noise, grams, rows)
    return Integrals(grams, noise).statistics(grams, point.theta)


def only(point: Point, windows: Indices) -> Point:
    """Return the point with some of its windows, and noise levels estimated from these."""
    grams = [point.grams[w] for w in windows]
    noise = levels.maximise(grams, levels.only(point.noise, grams, windows))[0]
    kept = [point.windows[w] for w in windows]
    commands = [point.commands[w] for w in windows] if point.commands else []
    problem = point.problem.only(windows)
    return regather(
        point, problem=problem, noise=noise, grams=grams, windows=kept, commands=commands
    )


def untracked_windows(point: Point) -> list[int]:
    """Return the indices of windows that the simulation does not follow under any latent forces,
    such as a crash or an unpredictably whipping rope.

    Their derivatives are meaningless, so they carry no information on effects. If there are many,
    an effect is missing instead, and none is returned."""
    statistics = point.integrals.statistics(with_shares(point, point.theta), point.theta)
    squares = statistics.square - point.integrals.log_dets
    misfit = squares / np.maximum(statistics.samples, 1.0)
    shaken = np.array([window.shaken for window in point.windows], dtype=bool)
    # after an unknown motion, a smaller misfit suffices
    limit = min((1.0 + INEXACT) * np.median(misfit), UNKNOWN_RATIO)
    distant = np.flatnonzero(misfit > np.where(shaken, limit, UNKNOWN_RATIO))
    if len(distant) > LOST_SHARE * len(misfit):
        return []
    return distant.tolist()


def move(point: Point, theta: ndarray) -> Point | None:
    """Simulate at ``theta`` with the same kinds of blocks, and keep the derivatives and noise
    levels of ``point``; None if the simulation fails.
    """
    problem = point.problem
    theta = problem.possible(theta)
    flown = problem.build_model(theta)
    count = len(problem.model.effects)  # columns of terms are not taken anew
    sizes = problem.priors.floor[count:] * theta[count:] * (flown is None)
    simulated = (flown or problem.model).residuals(problem.sizes(theta), point.about)
    residuals = []
    for k, (i, window) in enumerate(zip(problem.kept, point.windows)):
        residual = simulated[i] - window.effects[:, count:] @ sizes
        if point.commands:
            residual = residual - point.commands[k] @ problem.lost[k]
        if not np.all(np.isfinite(residual)):
            return None
        residuals.append(residual)
    windows = [replace(w, residual=r) for w, r in zip(point.windows, residuals)]
    grams = with_residuals(point.grams, point.windows, problem.priors.floor, residuals)
    return regather(
        point,
        point.integrals,
        theta=np.array(theta, dtype=float),
        windows=windows,
        grams=grams,
    )


def curvature(origin: Point, moved_point: Point) -> float:
    """Express the linearisation error by effects: return the largest size that any effect would get
    from the difference of simulation and linearisation, in floors.

    ``origin``: where the derivatives were taken; ``moved_point``: a point moved from it, with the
    same derivatives."""
    floors = origin.problem.priors.floor
    change = floors * (moved_point.theta - origin.theta)
    bent = []
    for old, new in zip(origin.windows, moved_point.windows):
        bent.append(new.residual - (old.residual - old.effects @ change))
    grams = with_residuals(moved_point.grams, moved_point.windows, floors, bent)
    total = moved_point.integrals.statistics(grams, moved_point.theta).score.sum(0)
    sizes = moved_point.posterior.covariance(()) @ total
    return np.abs(sizes).max(initial=0.0)


def with_floors_noise(point: Point, active: Indices) -> Point:
    """Return the point with noise levels estimated with every effect at its posterior mean, where
    effects that are not selected stay below their floors.

    So neither the sum of a dozen negligible effects nor random shares raise the levels. ``point``:
    gives derivatives and residuals."""
    return with_noise_at(point, point.posterior.mean(active))


def with_noise_at(point: Point, theta: ndarray) -> Point:
    """Return the point with noise levels estimated from the residuals at ``theta`` plus each
    flight's random shares.
    """
    grams = with_shares(point, theta)
    return regather(point, noise=levels.maximise(grams, point.noise)[0])


def with_shares(point: Point, theta: ndarray) -> list[Gram]:
    """Return the inner products of a point's windows at ``theta`` plus each flight's random
    shares.
    """
    shares = estimate_shares(point.plain, theta, point.shares) + theta - point.theta
    if not shares.any():
        return list(point.grams)
    row = np.searchsorted(point.plain.flights, [gram.flight for gram in point.grams])
    return [shift(gram, change) for gram, change in zip(point.grams, shares[row])]


def shift(gram: Gram, change: ndarray) -> Gram:
    """Return the inner products with the residual r - S change in place of r."""
    begin = gram.hidden
    part = gram.inner[:, :, begin:] @ change
    mixed = gram.cross[:, begin:] @ change
    square = gram.square - 2.0 * mixed + part[:, begin:] @ change
    return replace(gram, cross=gram.cross - part, square=np.maximum(square, 0.0))


def fit(point: Point, active: Indices) -> Point:
    """Fit the sizes of effects by Gauss-Newton steps, with fixed derivatives and simulated
    residuals; a step that does not lower the misfit is halved.

    ``point``: where the derivatives were taken; ``active``: effects that are fitted; all others
    become 0."""
    named = np.isin(np.arange(len(point.theta)), list(active))
    best = point
    if np.any(point.theta[~named] != 0.0):
        best = move(point, np.where(named, point.theta, 0.0))
    if best is None:
        return point
    kinds = point.problem.switches
    for _ in range(ROUNDS):
        goal = best.posterior.estimate(active)
        goal[kinds] = best.theta[kinds]  # steps do not switch blocks
        trial = _step(best, goal)
        if trial is None:
            break
        best = trial
        if predicted_gain(best, active) < 0.05:
            break
    return best


def predicted_gain(point: Point, active: Indices, switches: bool = False) -> float:
    """Return the gain that another step of these effects' sizes promises [nats]; ``switches``:
    whether switches take part in it.
    """
    remaining = point.posterior.estimate(active) - point.theta
    if not switches:
        remaining[point.problem.switches] = 0.0
    return float(0.5 * remaining @ point.information @ remaining)


def _step(point: Point, goal: ndarray) -> Point | None:
    """Return the point after the largest part of a step that lowers the misfit; None if no part
    does.

    Shorter steps are tried even if a longer one fails badly: beyond some size, the simulation may
    lose a window."""
    share = 1.0
    while share > 0.1:
        change = share * (goal - point.theta)
        if np.abs(change).max() <= SMALL_STEP:
            break
        trial = move(point, point.theta + change)
        if trial is not None and _misfit(trial) < _misfit(point):
            return trial
        share /= 2.0
    return None


def _misfit(point: Point) -> float:
    prior = (point.theta / point.problem.priors.slab)[point.theta != 0.0]
    return point.statistics.square.sum() + prior @ prior


def candidate(point: Point, active: Indices) -> Point:
    """Fit the sizes of a set and the noise levels alternately: what counted as gusts at first is
    gradually explained by the sizes.

    ``point``: gives derivatives, initial noise levels and kinds of blocks.
    """
    point = fit(point, active)
    point = with_noise_at(point, point.theta)
    for _ in range(TURNS):
        if predicted_gain(point, active) < TURNED:
            break
        before = point
        point = fit(point, active)
        if np.array_equal(point.theta, before.theta):
            break
        point = with_noise_at(point, point.theta)
    return point

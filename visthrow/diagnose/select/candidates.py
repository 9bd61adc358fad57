"""Candidates of the selection: effects, other kinds of blocks, terms of laws, and random shares of
effects.

A candidate is a group of columns of the windows, with a prior and a penalty. The value of a set of
candidates is its log marginal likelihood minus the penalties of its members.

A random share is the deviation of an effect's size in one flight, or on one day, from the size that
all flights have in common. It is normal with standard deviation theta and is integrated out of the
statistics (:func:`integrate_shares`). A flight far from the others is simulated again at other
sizes, because the derivative is inexact that far away: it doubles the size of a release that is
40 ms early.

Source: Laird and Ware 1982 (random effects).
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy import ndarray
from scipy.interpolate import PchipInterpolator

from sim.effects.effect import Effect, RandomEffect
from visthrow.config.effects import random_effects
from visthrow.diagnose.likelihood.evidence import FEWEST, INEXACT, Posterior, Priors
from visthrow.diagnose.likelihood.grammar import TermEffect
from visthrow.diagnose.likelihood.marginal import Statistics
from visthrow.diagnose.models.model_interface import Indices

ALL = "all"  # group of a candidate that has one size in all flights
FLIGHT = "flight"  # group of a candidate with a random share for each flight
DAY = "day"  # with a random share for each day
EVENT = "event"  # with a share in a single flight
COMMAND = "command"  # lost commands, which vary by command

REACH = np.geomspace(0.02, 6.0, 25)
"""Standard deviations of random shares that are tried, relative to the prior's."""
COARSE = 3  # every third of them suffices to compare candidates
SIZES = np.array([-1.0, -0.7, -0.45, -0.25, -0.1, 0.0, 0.1, 0.25, 0.45, 0.7, 1.0])
"""Sizes at which flights are simulated again, relative to the largest estimate of any flight."""
FINE = 400  # points at which the curve through them is evaluated


@dataclass(frozen=True)
class Candidate:
    """A candidate of the selection."""

    name: str
    columns: tuple[int, ...]  # indices of its effects
    group: str = ALL  # ALL, FLIGHT, DAY or EVENT: which flights have a common size
    penalty: float = 0.0  # beyond the threshold [nats]
    deviations: tuple[float, ...] = ()  # prior deviation of random shares by column, in floors
    floors: float = 0.0  # negligible deviation of random shares, relative to the prior's
    flight: int = -1  # of an event
    law: str = ""  # block of the law, for a term
    claims: int = 1  # number of thresholds to exceed: that an effect exists, that it varies

    def __hash__(self) -> int:
        """Hash numbers alone; hashes of strings would change the order of sets between runs."""
        return hash((self.columns, self.flight))


Names = frozenset[Candidate]
NOTHING: Names = frozenset()
Shares = Mapping[Candidate, float]
"""Standard deviation of random shares, relative to the prior's."""
Deviations = Iterable[tuple[int, float | ndarray]]
"""Index of each effect with random shares, and their standard deviation in floors: one for all
rows, or one for each, shape (F,).
"""


def list_shared(effects: Sequence[Effect]) -> list[Candidate]:
    """Return a candidate for every effect, with one size in all flights."""
    offered = []
    for j, e in enumerate(effects):
        penalty, law = (e.price, e.block) if isinstance(e, TermEffect) else (0.0, "")
        offered.append(Candidate(e.name, (j,), penalty=penalty, law=law))
    return offered


def random_shares(
    effects: Sequence[Effect],
    priors: Priors,
    statistics: Statistics,
    all_effects: bool = True,
) -> list[Candidate]:
    """Return the random shares that at least two flights, or days, can show.

    Args:
        effects: of the model, without terms of laws, shape (K,).
        statistics: of the flights.
        all_effects: whether any effect may vary, rather than the catalogue's random effects alone.
    """
    flown = statistics.information.diagonal(axis1=1, axis2=2)[:, : len(effects)] > 0.0
    groups = {FLIGHT: flown}  # which effects each flight or day shows
    days = np.array(statistics.days)
    by_day = [flown[days == day].any(0) for day in np.unique(days)]
    if 1 < len(by_day) < len(flown):
        groups[DAY] = np.array(by_day)
    offered = []
    for effect, penalty in _varying(effects):
        named = effect.name not in effect.of
        if not (named or all_effects):
            continue
        columns = [j for j, e in enumerate(effects) if e.name in effect.of and priors.visible[j]]
        deviations = tuple(effect.prior_sd / priors.floor[columns])
        floors = effect.floor / effect.prior_sd
        for group, informative in groups.items():
            if columns and informative[:, columns].any(1).sum() > 1:
                candidate = Candidate(
                    effect.name if named else f"{effect.name}_by_{group}",
                    tuple(columns),
                    group,
                    penalty,
                    deviations,
                    floors,
                    claims=1 if named else 2,
                )
                offered.append(candidate)
    return offered + _events(effects, priors, statistics.flights, flown)


def _varying(effects: Sequence[Effect]) -> Iterable[tuple[RandomEffect, float]]:
    """Yield the catalogue's random effects, then every other effect as a random one, with their
    penalties: among many effects, one seems to vary by chance.
    """
    named = [v for v in random_effects() if v.of]
    yield from ((v, 0.0) for v in named)
    covered = {name for v in named for name in v.of}
    for e in effects:
        if e.name not in covered and not e.switch:
            yield as_random(e), np.log(len(effects))


def as_random(effect: Effect) -> RandomEffect:
    """Convert an effect into a random effect, whose size differs from flight to flight."""
    return RandomEffect(
        effect.name,
        f"{effect.cause}, varying between flights",
        f"{effect.name} ~ N({effect.name}, theta^2) in each flight",
        (effect.name,),
        effect.unit,
        effect.block,
        effect.prior_sd,
        effect.floor,
        effect.source,
        manoeuvres=tuple(effect.manoeuvres),
    )


def _events(
    effects: Sequence[Effect], priors: Priors, flights: ndarray, flown: ndarray
) -> list[Candidate]:
    """Return candidates for each effect in each single flight."""
    penalty = np.log(max(flown.size, 1))
    offered = []
    for j, e in enumerate(effects):
        flights_with = flights[flown[:, j]].tolist()
        if not priors.visible[j] or e.switch or len(flights_with) < FEWEST:
            continue
        deviation = (priors.slab[j],)
        for flight in flights_with:
            name = f"{e.name} in flight {flight}"
            offered.append(Candidate(name, (j,), EVENT, penalty, deviation, flight=flight))
    return offered


def without_means(chosen: Iterable[Candidate]) -> list[Candidate]:
    """Drop effects that also occur as random shares, as the claims of these include existence."""
    varying = {c.columns for c in chosen if c.claims > 1}
    return [c for c in chosen if c.claims > 1 or c.columns not in varying]


def columns_of(chosen: Iterable[Candidate]) -> list[int]:
    """Return the indices of the effects that have one size in all flights."""
    return sorted(j for c in chosen if c.group == ALL for j in c.columns)


def laws_of(chosen: Iterable[Candidate]) -> list[Candidate]:
    """Return the terms of laws."""
    return [c for c in chosen if c.law]


def unit_suffix(unit: str) -> str:
    """Return a unit for printing after a number, empty if dimensionless."""
    return "" if unit == "1" else f" {unit}"


@dataclass(frozen=True, kw_only=True)
class Scatter(RandomEffect):
    """The verdict on a quantity that may vary between flights, days or commands."""

    found: bool
    size: float  # most probable deviation [unit]
    low: float  # 95 % interval [unit]
    high: float
    nats: float  # evidence that it varies
    flights: int  # number of flights, days or commands that show it
    by: str = FLIGHT  # or DAY, or COMMAND
    # effect -> mean over these flights [unit], which is expected in another flight
    mean: Mapping[str, float] = field(default_factory=dict)

    @property
    def sentence(self) -> str:
        """Describe the verdict for the report."""
        unit = unit_suffix(self.unit)
        size = f"{self.name} = {self.size:.3g}{unit} (95 %: {self.low:.3g} to {self.high:.3g})"
        drifts = "drifts, a value for each day. " if self.by == DAY else ""
        return f"{drifts}{self.cause}: {size}, {self.nats:.0f} nats from {self.flights} {self.by}s."


def relinearise_per_flight(
    statistics: Statistics,
    theta: ndarray,
    priors: Priors,
    j: int,
    simulate: Callable[[ndarray], Statistics | None],
) -> Statistics:
    """Correct the scores of flights for the curvature of one effect: simulate it at several sizes
    and linearise each flight at the size that fits it best.

    ``theta``: estimated sizes, in floors; ``simulate``: simulates the flights at other sizes, in
    floors, or returns None if that fails.
    """
    information = statistics.information[:, j, j]
    misfit = statistics.extrapolate(theta).score[:, j]
    flown = np.flatnonzero(information > 0.0)
    reach = np.abs(misfit[flown] / information[flown]).max(initial=0.0)
    if INEXACT * reach < 1.0:  # the derivative's error is below a floor
        return statistics
    unit = np.eye(len(theta))[j]
    places = np.clip(theta[j] + reach * SIZES, priors.low[j], priors.high[j])
    simulated = {}
    for size in np.unique(places) - theta[j]:
        part = simulate(theta + size * unit)
        if part is not None:
            simulated[size] = part
    if len(simulated) < len(SIZES) // 2:
        return statistics
    sizes = list(simulated)
    scores = np.stack([part.score for part in simulated.values()], axis=1)
    score = statistics.score.copy()
    for f in flown:
        scores_of = scores[f]
        best = np.interp(0.0, -scores_of[:, j], sizes)
        misfit = [np.interp(best, sizes, column) for column in scores_of.T]
        change = theta + best * unit - statistics.theta
        score[f] = misfit + statistics.information[f] @ change
    return replace(statistics, score=score)


def over_deviations(
    sizes: ndarray, nats: ndarray, none: float | None = None
) -> tuple[float, tuple[float, float], float]:
    """Return the most probable standard deviation of random shares, its 95 % interval, and the
    evidence integrated over a half-normal prior.

    Args:
        sizes: deviations that were tried, ascending, above 0, relative to the prior's.
        nats: evidence of each.
        none: evidence of a deviation of 0, if that is possible.
    """
    size = np.geomspace(sizes[0], sizes[-1], FINE)
    value = PchipInterpolator(np.log(sizes), nats)(np.log(size))
    if none is not None:
        size = np.append(0.0, size)
        value = np.append(none, value)
    best = value.max()
    density = np.exp(value - best - 0.5 * size**2) * np.sqrt(2.0 / np.pi)
    mass = density * np.gradient(size)
    total = mass.sum()
    ends = np.searchsorted(mass.cumsum() / total, (0.025, 0.975))
    mode = float(size[density.argmax()])
    return mode, tuple(size[ends].tolist()), float(np.log(total) + best)


def judge(
    v: RandomEffect,
    reach: ndarray,
    nats: ndarray,
    threshold: float,
    flights: int,
    group: str = FLIGHT,
) -> Scatter:
    """Judge whether a quantity varies, from the evidence of several deviations.

    Args:
        reach: deviations that were tried, ascending, above 0, in the quantity's unit.
        nats: evidence of each, relative to a deviation of 0.
        threshold: evidence that a finding needs.
        flights: number of flights, days or commands that show it.
        group: FLIGHT, DAY or COMMAND.
    """
    mode, (low, high), evidence = over_deviations(reach / v.prior_sd, nats, none=0.0)
    mode *= v.prior_sd
    return Scatter(
        **vars(v),
        found=evidence > threshold and mode > v.floor,
        size=mode,
        low=v.prior_sd * low,
        high=v.prior_sd * high,
        nats=evidence,
        flights=flights,
        by=group,
    )


def find_tolerance(size: float) -> float:
    """Return the standard deviation between flights that is tolerated: a floor and a part of the
    effect's size, in floors.
    """
    return float(np.hypot(1.0, INEXACT * size))


def between_flights(
    statistics: Statistics, priors: Priors, active: Indices, theta: ndarray
) -> tuple[float, ndarray]:
    """Estimate the variance of selected effects between flights, relative to the square of
    :func:`find_tolerance`; return it and the part of it that remains in the mean of these flights,
    shape (K,).

    Each flight may have a share of each selected effect, with a standard deviation of u times the
    allowed one. The variance is averaged over the posterior of u, whose prior is half normal. One
    flight says nothing about u; many that agree leave a small one. It is 0 if no effect is
    selected. ``theta``: sizes, in floors.

    Source: Laird and Ware 1982; Gelman 2006 (half-normal deviations of few groups).
    """
    information = statistics.information.diagonal(axis1=1, axis2=2)
    share = information / np.maximum(information.sum(0), 1e-300)  # 1 / F for F equal flights
    sd = {j: find_tolerance(theta[j]) for j in active}
    nats = []
    for u in REACH:
        unlike = integrate(statistics, [(j, u * size) for j, size in sd.items()])
        nats.append(evidence_of(unlike, priors, active))
    value = np.array(nats) - max(nats)
    weight = REACH * np.exp(value - 0.5 * REACH**2)  # steps of u grow with u
    variance = weight @ REACH**2 / weight.sum()
    return variance * bool(active), (share**2).sum(0)


def evidence_of(statistics: Statistics, priors: Priors, named: Indices) -> float:
    """Return log Z of a set of effects, comparable between different integrated shares."""
    square = float(statistics.absolute.square.sum())
    return Posterior.of(statistics, priors).log_evidence(named) - 0.5 * square


def integrate_shares(statistics: Statistics, shares: Shares) -> Statistics:
    """Integrate the random shares out of the statistics.

    The rows of the result are days if days have shares, else flights."""
    of_flights = integrate(statistics, _of_rows(shares, statistics.flights))
    if not find_day_shares(shares):
        return of_flights
    of_days = of_flights.sum_by(statistics.days)
    return integrate(of_days, _of_rows(shares, of_days.flights, DAY))


def find_day_shares(shares: Shares) -> Shares:
    """Return the random shares of days."""
    return {c: size for c, size in shares.items() if c.group == DAY}


def _of_rows(shares: Shares, numbers: ndarray, group: str = FLIGHT) -> Deviations:
    """Yield the random shares of flights (or of the one flight of an event), or those of days.

    ``numbers``: of the flights or days."""
    for c, size in shares.items():
        if (c.group == DAY) == (group == DAY):
            has_share = (c.group != EVENT) | (numbers == c.flight)
            for j, deviation in zip(c.columns, c.deviations):
                yield j, size * deviation * has_share


def integrate(statistics: Statistics, deviations: Deviations) -> Statistics:
    """Integrate out each row's shares of some effects."""
    columns, root, part, precision = _unit_shares(statistics, deviations)
    if not columns:
        return statistics
    score = (root * statistics.score[:, columns])[..., None]
    solved = np.linalg.solve(precision, np.concatenate((part, score), axis=2))
    explained = np.swapaxes(part, 1, 2) @ solved
    log_det = np.linalg.slogdet(precision)[1]
    return replace(
        statistics,
        information=statistics.information - explained[..., :-1],
        score=statistics.score - explained[..., -1],
        square=statistics.square - (score * solved[..., -1:]).sum((1, 2)) + log_det,
    )


def _unit_shares(
    statistics: Statistics, deviations: Deviations
) -> tuple[list[int], ndarray, ndarray, ndarray]:
    """Return, for shares scaled to unit deviation: the effects' indices, the deviations (F, m), the
    information on shares and effects (F, m, K), and the shares' posterior precision (F, m, m).
    """
    pairs = list(deviations)
    columns = [j for j, _ in pairs]
    root = np.zeros((len(statistics.score), len(pairs)))
    for i, (_, size) in enumerate(pairs):
        root[:, i] = size
    part = root[..., None] * statistics.information[:, columns]
    return columns, root, part, np.eye(len(pairs)) + part[..., columns] * root[:, None]


def estimate_shares(statistics: Statistics, theta: ndarray, shares: Shares) -> ndarray:
    """Estimate each flight's random shares, in floors, shape (F, K).

    ``theta``: common sizes of the effects, in floors. Shares of days are estimated first, those of
    flights from the remainder."""
    sizes = np.zeros(statistics.score.shape)
    of_flights = list(_of_rows(shares, statistics.flights))
    if find_day_shares(shares):
        of_days = integrate(statistics, of_flights).sum_by(statistics.days)
        row = np.searchsorted(of_days.flights, statistics.days)
        sizes += _shares(of_days, theta, _of_rows(shares, of_days.flights, DAY))[row]
    return sizes + _shares(statistics, theta + sizes, of_flights)


def _shares(statistics: Statistics, theta: ndarray, deviations: Deviations) -> ndarray:
    """Return the most probable shares of each row, shape (F, K), given the sizes ``theta``."""
    columns, root, _, precision = _unit_shares(statistics, deviations)
    off = root * statistics.extrapolate(theta).score[:, columns]
    sizes = root * np.linalg.solve(precision, off[..., None])[..., 0]
    return sizes @ np.eye(len(statistics.theta))[columns]

"""Candidates of a selection: effects, other kinds of blocks, terms of laws, and shares of effects
that flights or days have for themselves.

A candidate is a group of columns of the windows with a prior and a penalty. Whatever it stands for,
a set of candidates is worth its marginal likelihood less the penalties of its members.

A flight, or a day, has its own share of an effect, normal about what all share, with a deviation
theta. These random shares are integrated out of the statistics (:func:`freed`). A flight far from
the others is simulated again at other sizes: a release 40 ms early tells twice of it by its
derivative.

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

ALL = "all"  # group of a candidate whose size all flights share
FLIGHT = "flight"  # of one of which each flight has a share of its own
DAY = "day"
EVENT = "event"  # one flight alone has one
COMMAND = "command"  # what has a share of its own, beside flights and days

REACH = np.geomspace(0.02, 6.0, 25)
"""Deviations that are tried, in their prior's."""
COARSE = 3  # one of so many of them suffices to compare candidates
SIZES = np.array([-1.0, -0.7, -0.45, -0.25, -0.1, 0.0, 0.1, 0.25, 0.45, 0.7, 1.0])
"""At which flights are simulated again, in the largest estimate of any flight."""
FINE = 400  # places between them at which a curve is looked at


@dataclass(frozen=True)
class Candidate:
    """A cause that may be selected."""

    name: str
    columns: tuple[int, ...]  # numbers of the effects that it concerns
    group: str = ALL  # who has a size: ALL flights one, each FLIGHT, each DAY, or one in an EVENT
    penalty: float = 0.0  # beyond the threshold [nats]
    deviations: tuple[float, ...] = ()  # prior of random shares, in floors; one a column
    floors: float = 0.0  # negligible deviation of random shares, in the prior's
    flight: int = -1  # of an event
    law: str = ""  # block of the law whose term it is
    claims: int = 1  # thresholds that it must beat: that an effect exists, that it differs

    def __hash__(self) -> int:
        """Hash numbers alone: with names, the order of a set would differ from run to run."""
        return hash((self.columns, self.flight))


Names = frozenset[Candidate]
NOTHING: Names = frozenset()
Shares = Mapping[Candidate, float]
"""Deviation of random shares, in their prior's."""
Deviations = Iterable[tuple[int, float | ndarray]]
"""Number of each effect of which rows have shares, and the shares' deviation in floors, of all rows
or of each, shape (F,).
"""


def shared(effects: Sequence[Effect]) -> list[Candidate]:
    """Return every effect as a candidate whose size all flights share."""
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
    """Return what flights, or days, may have for themselves, where at least two of them show it.

    Args:
        effects: of the model, without terms of laws, shape (K,).
        statistics: of the flights.
        all_effects: whether of every effect, not of the catalogue's random effects alone.
    """
    flown = statistics.information.diagonal(axis1=1, axis2=2)[:, : len(effects)] > 0.0
    groups = {FLIGHT: flown}  # which effects each shows
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
    """Yield the catalogue's random effects, then every other effect as one, with their penalties:
    of all effects, one varies more by chance.
    """
    named = [v for v in random_effects() if v.of]
    yield from ((v, 0.0) for v in named)
    covered = {name for v in named for name in v.of}
    for e in effects:
        if e.name not in covered and not e.switch:
            yield as_random(e), np.log(len(effects))


def as_random(effect: Effect) -> RandomEffect:
    """Return an effect as one whose size differs from flight to flight."""
    return RandomEffect(
        effect.name,
        f"{effect.cause}, now more, now less",
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
    """Return each effect in each flight alone."""
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
    """Return candidates without the means of those whose existence is one of their claims."""
    varying = {c.columns for c in chosen if c.claims > 1}
    return [c for c in chosen if c.claims > 1 or c.columns not in varying]


def columns_of(chosen: Iterable[Candidate]) -> list[int]:
    """Return the numbers of the effects whose size all flights share."""
    return sorted(j for c in chosen if c.group == ALL for j in c.columns)


def laws_of(chosen: Iterable[Candidate]) -> list[Candidate]:
    """Return the terms of laws."""
    return [c for c in chosen if c.law]


def unit_suffix(unit: str) -> str:
    """Return a unit as it stands after a number: nothing where it is dimensionless."""
    return "" if unit == "1" else f" {unit}"


@dataclass(frozen=True)
class Scatter:
    """The verdict on one quantity that may vary."""

    name: str
    cause: str
    equation: str
    block: str
    unit: str
    of: tuple[str, ...]
    found: bool
    size: float  # most probable deviation [unit]
    low: float  # 95 % interval [unit]
    high: float
    floor: float  # [unit]
    nats: float  # of evidence that it varies at all
    flights: int  # or days or commands, that say something about it
    manoeuvres: tuple[str, ...] = ()
    by: str = FLIGHT  # or DAY, or COMMAND
    # effect -> mean of these flights [unit]: what is expected of another flight
    mean: Mapping[str, float] = field(default_factory=dict)

    @property
    def sentence(self) -> str:
        """For people."""
        unit = unit_suffix(self.unit)
        size = f"{self.name} = {self.size:.3g}{unit} (95 %: {self.low:.3g} to {self.high:.3g})"
        drifts = "drifts, a value for each day. " if self.by == DAY else ""
        return f"{drifts}{self.cause}: {size}, {self.nats:.0f} nats from {self.flights} {self.by}s."


def relinearised_per_flight(
    statistics: Statistics,
    theta: ndarray,
    priors: Priors,
    j: int,
    simulate: Callable[[ndarray], Statistics | None],
) -> Statistics:
    """Statistics whose scores are those about the size of one effect at which each flight fits best
    by itself.

    ``theta``: estimated sizes, in floors; ``simulate``: simulates the flights at other sizes, in
    floors, or returns None where that fails.
    """
    information = statistics.information[:, j, j]
    misfit = statistics.about(theta).score[:, j]
    flown = np.flatnonzero(information > 0.0)
    reach = np.abs(misfit[flown] / information[flown]).max(initial=0.0)
    if INEXACT * reach < 1.0:  # the derivative is off by less than a floor
        return statistics
    unit = np.eye(len(theta))[j]
    places = np.clip(theta[j] + reach * SIZES, priors.low[j], priors.high[j])
    simulated = {}
    for size in (np.unique(places) - theta[j]).tolist():
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
    """Return the most probable deviation, its 95 % interval, and the evidence of all, which are
    half normal before.

    Args:
        sizes: deviations that were tried, from small to large, above 0, in their prior's.
        nats: of evidence of each.
        none: nats of no deviation, if that is one of them.
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
    ends = np.searchsorted(np.cumsum(mass) / total, (0.025, 0.975))
    mode = float(size[np.argmax(density)])
    return mode, tuple(size[ends].tolist()), float(np.log(total) + best)


def judged(
    v: RandomEffect,
    reach: ndarray,
    nats: ndarray,
    threshold: float,
    flights: int,
    group: str = FLIGHT,
) -> Scatter:
    """The verdict on a quantity by the evidence of its sizes.

    Args:
        reach: sizes that were tried, from small to large, above 0.
        nats: of evidence of each against none.
        threshold: that a finding needs.
        flights: or days or commands, that say something of it.
        group: what has shares.
    """
    mode, (low, high), evidence = over_deviations(reach / v.prior_sd, nats, none=0.0)
    mode *= v.prior_sd
    return Scatter(
        v.name,
        v.cause,
        v.equation,
        v.block,
        v.unit,
        tuple(v.of),
        evidence > threshold and mode > v.floor,
        mode,
        v.prior_sd * low,
        v.prior_sd * high,
        v.floor,
        evidence,
        flights,
        v.manoeuvres,
        group,
    )


def allowed(size: float) -> float:
    """Deviation among flights that is no disagreement: a floor, and a part of the effect's size, in
    floors.
    """
    return float(np.hypot(1.0, INEXACT * size))


def between_flights(
    statistics: Statistics, priors: Priors, active: Sequence[int], theta: ndarray
) -> tuple[float, ndarray]:
    """Return the variance among flights that named effects may have, in that which is
    :func:`allowed`, and the part of it that the mean of these flights keeps, shape (K,).

    In each flight a name may have a share of its own, whose deviation is u times what is allowed.
    What the flights say of u, which is half normal before, is integrated over: one flight alone
    says nothing of it, and many that agree leave little. Where nothing is named, nothing varies.
    ``theta``: their sizes, in floors.

    Source: Laird and Ware 1982; Gelman 2006 (half-normal deviations of few groups).
    """
    information = statistics.information.diagonal(axis1=1, axis2=2)
    share = information / np.maximum(information.sum(0), 1e-300)  # 1 / F of F that say as much
    sd = {j: allowed(theta[j]) for j in active}
    nats = []
    for u in REACH:
        unlike = integrated(statistics, [(j, u * size) for j, size in sd.items()])
        nats.append(evidence_of(unlike, priors, active))
    value = np.array(nats) - max(nats)
    weight = REACH * np.exp(value - 0.5 * REACH**2)  # steps of u grow with u
    variance = weight @ REACH**2 / weight.sum()
    return variance * bool(active), (share**2).sum(0)


def evidence_of(statistics: Statistics, priors: Priors, named: Sequence[int]) -> float:
    """Return log Z of a set of effects, comparable between shares that were integrated out."""
    square = float(statistics.absolute.square.sum())
    return Posterior.of(statistics, priors).log_evidence(named) - 0.5 * square


def freed(statistics: Statistics, shares: Shares) -> Statistics:
    """Statistics of what flights, or days, share: the shares that each has of its own are
    integrated out.

    Where days have shares, what is returned is of days."""
    of_flights = integrated(statistics, _of_rows(shares, statistics.flights))
    if not drifting(shares):
        return of_flights
    of_days = of_flights.by(statistics.days)
    return integrated(of_days, _of_rows(shares, of_days.flights, DAY))


def drifting(shares: Shares) -> Shares:
    """Return the shares that days have."""
    return {c: size for c, size in shares.items() if c.group == DAY}


def _of_rows(shares: Shares, numbers: ndarray, group: str = FLIGHT) -> Deviations:
    """Yield the shares of flights, of all or of one alone, or those of days.

    ``numbers``: of the flights, or days."""
    for c, size in shares.items():
        if (c.group == DAY) == (group == DAY):
            has_share = (c.group != EVENT) | (numbers == c.flight)
            for j, deviation in zip(c.columns, c.deviations):
                yield j, size * deviation * has_share


def integrated(statistics: Statistics, deviations: Deviations) -> Statistics:
    """Integrate out the shares that each row has of some effects."""
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
    """Return the effects' numbers, the shares' deviations (F, m), the information on shares in
    these and on effects (F, m, K), and the posterior precision of the shares (F, m, m).
    """
    pairs = list(deviations)
    columns = [j for j, _ in pairs]
    root = np.zeros((len(statistics.score), len(pairs)))
    for i, (_, size) in enumerate(pairs):
        root[:, i] = size
    part = root[..., None] * statistics.information[:, columns]
    return columns, root, part, np.eye(len(pairs)) + part[..., columns] * root[:, None]


def estimate_shares(statistics: Statistics, theta: ndarray, shares: Shares) -> ndarray:
    """Most probable share of each flight of the effects that vary, beside the sizes of all, in
    floors, shape (F, K).

    ``theta``: sizes that all flights share, in floors. The shares of days come first, and flights
    share what is left of them."""
    sizes = np.zeros(statistics.score.shape)
    of_flights = list(_of_rows(shares, statistics.flights))
    if drifting(shares):
        of_days = integrated(statistics, of_flights).by(statistics.days)
        row = np.searchsorted(of_days.flights, statistics.days)
        sizes += _shares(of_days, theta, _of_rows(shares, of_days.flights, DAY))[row]
    return sizes + _shares(statistics, theta + sizes, of_flights)


def _shares(statistics: Statistics, theta: ndarray, deviations: Deviations) -> ndarray:
    """Return the most probable shares of each row, shape (F, K), beside its sizes ``theta``."""
    columns, root, _, precision = _unit_shares(statistics, deviations)
    off = root * statistics.about(theta).score[:, columns]
    sizes = root * np.linalg.solve(precision, off[..., None])[..., 0]
    return sizes @ np.eye(len(statistics.theta))[columns]

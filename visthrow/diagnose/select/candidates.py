"""Candidates of a selection: effects, other kinds of blocks, terms of laws, and shares of effects
that flights or days have for themselves.

A candidate is a group of columns of the windows with a prior and a penalty. Whatever it stands for,
a set of candidates is worth its marginal likelihood less the penalties of its members.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy import ndarray

from sim.effects.effect import Effect, RandomEffect
from visthrow.config.effects import random_effects
from visthrow.diagnose.likelihood.evidence import FEWEST, Priors
from visthrow.diagnose.likelihood.grammar import TermEffect
from visthrow.diagnose.likelihood.marginal import Statistics

ALL = "all"  # group of a candidate whose size all flights share
FLIGHT = "flight"  # of one of which each flight has a share of its own
DAY = "day"
EVENT = "event"  # one flight alone has one


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
    days: Sequence[int],
    all_effects: bool = True,
) -> list[Candidate]:
    """Return what flights, or days, may have for themselves, where at least two of them show it.

    Args:
        effects: of the model, without terms of laws, shape (K,).
        statistics: of the flights.
        days: of each flight, by its number; none where the logs do not say.
        all_effects: whether of every effect, not of the catalogue's random effects alone.
    """
    flown = statistics.information.diagonal(axis1=1, axis2=2)[:, : len(effects)] > 0.0
    groups = _informative(flown, [days[f] for f in statistics.flights.tolist()] if days else [])
    offered = []
    for effect, penalty in _varying(effects):
        named = effect.name not in effect.of
        if not (named or all_effects):
            continue
        columns = [j for j, e in enumerate(effects) if e.name in effect.of and priors.visible[j]]
        deviations = tuple(float(effect.prior_sd / priors.floor[j]) for j in columns)
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


def _informative(flown: ndarray, days: Sequence[int]) -> dict[str, ndarray]:
    """Return which flights, and which days if there are several, are informative on each effect.

    ``flown``: of each flight, shape (F, K), bool; ``days``: of each flight, or none."""
    groups = {FLIGHT: flown}
    day_of = np.array(days)
    by_day = [flown[day_of == day].any(0) for day in np.unique(day_of)]
    if 1 < len(by_day) < len(flown):
        groups[DAY] = np.array(by_day)
    return groups


def _varying(effects: Sequence[Effect]) -> Iterable[tuple[RandomEffect, float]]:
    """Yield the catalogue's random effects, then every other effect as one, with their penalties:
    of all effects, one varies more by chance.
    """
    named = [v for v in random_effects() if v.of]
    yield from ((v, 0.0) for v in named)
    covered = {name for v in named for name in v.of}
    for e in effects:
        if e.name not in covered and not e.switch:
            yield as_random(e), float(np.log(len(effects)))


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
    penalty = float(np.log(max(flown.size, 1)))
    offered = []
    for j, e in enumerate(effects):
        flights_with = flights[flown[:, j]].tolist()
        if not priors.visible[j] or e.switch or len(flights_with) < FEWEST:
            continue
        deviation = (float(priors.slab[j]),)
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

"""Occam's window: the sets of candidates that the statistics of some flights leave in question.

A set S of candidates has the value

    V(S) = log Z(S) - sum of its members' penalties

with log Z as in :mod:`visthrow.diagnose.likelihood.evidence`. The deviation of random shares is
integrated over its prior. The search opens the best set that was not opened yet, and lists its
neighbours: one candidate more, two more, one less, one in place of another. It ends where no set
near the best is unopened. What is left near the best is the answer: one set, or several that say
the same.

Source: Madigan and Raftery 1994 (Occam's window); Raftery 1995.
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import combinations

import numpy as np
from numpy import ndarray

from visthrow.diagnose.likelihood.evidence import STRONG, VERY_STRONG, Posterior, Priors
from visthrow.diagnose.likelihood.marginal import Statistics
from visthrow.diagnose.select.candidates import (
    ALL,
    COARSE,
    DAY,
    EVENT,
    FLIGHT,
    NOTHING,
    REACH,
    Candidate,
    Names,
    Shares,
    columns_of,
    drifting,
    evidence_of,
    freed,
    over_deviations,
)

MOST_NEW = 2  # candidates in one move: of where many lead together, derivatives tell too little

WINDOW = (MOST_NEW + 1) * VERY_STRONG
"""Nats behind the best up to which sets are kept: what the candidates of a move cost, those that it
adds and one that it takes away. Sets up to ``STRONG`` behind count as possible.
"""
PATIENCE = 8  # sets that are opened in vain before the search ends
RANDOM_TRIED = (
    4  # random shares whose evidence is calculated for each set, of those that may matter
)


class Linear:
    """Values of sets by the statistics of one point alone."""

    def __init__(
        self,
        statistics: Statistics,
        priors: Priors,
        candidates: Sequence[Candidate],
        penalty: Callable[[Names], float],
    ) -> None:
        """Keep what values are made of; ``penalty``: of a set [nats]."""
        self.statistics = statistics
        self.priors = priors
        self.penalty = penalty
        self.plain = [c for c in candidates if c.group == ALL and priors.visible[c.columns[0]]]
        self.random = [c for c in candidates if c.group != ALL]
        self._step = min((penalty(frozenset({c})) for c in self.plain), default=0.0)
        self._shares: dict[Names, tuple[dict[Candidate, float], float]] = {}
        self._values: dict[Names, float] = {}
        self._totals: dict[frozenset, Posterior] = {}
        self._added: dict[Names, dict[Names, float]] = {}

    def shares(self, chosen: Names) -> tuple[dict[Candidate, float], float]:
        """Return the deviations of a set's random shares, in their prior's, and the nats by which
        they are worth more at their best than over their prior.
        """
        if chosen not in self._shares:
            listed: dict[Candidate, float] = {}
            occam = 0.0
            random = [c for c in chosen if c.group != ALL]
            for c in sorted(random, key=lambda c: c.name):
                listed[c], bonus = self._deviation(chosen, listed, c)
                occam += bonus
            self._shares[chosen] = listed, occam
        return self._shares[chosen]

    def _deviation(
        self, chosen: Names, fixed: dict[Candidate, float], c: Candidate
    ) -> tuple[float, float]:
        if c.group == EVENT:  # a size like any other: the slab is its prior
            return 1.0, 0.0
        sizes, nats = self.profile(chosen, fixed, c, REACH[::COARSE])
        mode, _, evidence = over_deviations(sizes, nats)
        at_mode = self.profile(chosen, fixed, c, np.array([mode]))[1]
        return mode, float(at_mode[0]) - evidence

    def profile(
        self,
        chosen: Names,
        fixed: Shares,
        c: Candidate,
        sizes: ndarray = REACH,
    ) -> tuple[ndarray, ndarray]:
        """Return deviations of a random share that are not negligible, in its prior's, and the nats
        by which log Z is higher with each than without the share.
        """
        sizes = np.unique(np.maximum(sizes, min(c.floors, REACH[-1] / 2.0)))
        active = columns_of(chosen)
        days = drifting(fixed)
        flights = {share: size for share, size in fixed.items() if share not in days}
        statistics = freed(self.statistics, flights)
        nats = []
        for shares in (days, *({**days, c: size} for size in sizes.tolist())):
            varied = freed(statistics, shares)
            nats.append(evidence_of(varied, self.priors, active))
        return sizes, np.array(nats[1:]) - nats[0]

    def value(self, chosen: Names) -> float:
        """Return the value of a set."""
        if chosen not in self._values:
            penalty = self.penalty(chosen)
            value = -np.inf
            if np.isfinite(penalty):
                occam = self.shares(chosen)[1]
                whole = evidence_of(self._free(chosen), self.priors, columns_of(chosen))
                value = whole - occam - penalty
            self._values[chosen] = value
        return self._values[chosen]

    def _free(self, chosen: Names) -> Statistics:
        return freed(self.statistics, self.shares(chosen)[0])

    def total(self, chosen: Names) -> Posterior:
        """Return what all flights say beside a set's random shares."""
        shares = frozenset(self.shares(chosen)[0].items())
        if shares not in self._totals:
            self._totals[shares] = Posterior.of(self._free(chosen), self.priors)
        return self._totals[shares]

    def added(self, subset: Names) -> dict[Names, float]:
        """Return a set and its neighbours with one candidate more, with their values."""
        if subset not in self._added:
            base = self.value(subset)
            listed = {subset: base}
            if np.isfinite(base):
                gain = self.total(subset).additions(columns_of(subset)).tolist()
                price = self.penalty(subset)
                varying = {j for c in subset if c.group != ALL for j in c.columns}
                for c in self.plain:
                    new = subset | {c}
                    (j,) = c.columns
                    if j in varying:  # whose shares are others about a mean
                        listed[new] = self.value(new)
                    elif gain[j] > self._step - WINDOW:
                        self._shares.setdefault(new, self.shares(subset))
                        listed[new] = base + gain[j] - (self.penalty(new) - price)
                for c in self._list_varying(subset):
                    new = subset | {c}
                    listed[new] = self.value(new)
            self._added[subset] = listed
        return self._added[subset]

    def _list_varying(self, subset: Names) -> list[Candidate]:
        """Return the random shares that may be worth their penalty, those that promise most: each
        as if no other effect could stand in for it.
        """
        if not self.random:
            return []
        theta = self.total(subset).mean(columns_of(subset))
        close: dict[Candidate, float] = {}
        for group in (FLIGHT, DAY, EVENT):
            members = [c for c in self.random if c.group == group]
            if not members:
                continue
            for c, nats in zip(members, self._promises(group, members, theta)):
                if nats > self._step - STRONG and c not in subset:
                    close[c] = nats
        return sorted(close, key=close.get, reverse=True)[:RANDOM_TRIED]

    def _promises(self, group: str, members: Sequence[Candidate], theta: ndarray) -> list[float]:
        """Return the nats that random shares of one group promise beside these sizes [floors]."""
        flights = self.statistics.by(self.statistics.days) if group == DAY else self.statistics
        precision = np.maximum(np.diagonal(flights.information, axis1=1, axis2=2), 1e-12)
        misfit = (flights.about(theta).score) ** 2 / precision
        counts = [len(c.columns) for c in members]
        columns = [j for c in members for j in c.columns]
        deviations = [sd for c in members for sd in c.deviations]
        sizes = REACH[::COARSE]
        place = slice(None), columns
        if group == EVENT:  # each in its flight alone
            sizes = np.ones(1)
            rows = np.searchsorted(flights.flights, [c.flight for c in members])
            place = rows[None], columns
        part = precision[place] * np.multiply.outer(sizes, deviations)[:, None] ** 2
        gain = 0.5 * (misfit[place] * part / (1.0 + part) - np.log1p(part))
        begins = np.cumsum(counts) - counts
        nats = np.add.reduceat(gain.sum(1), begins, axis=1).max(0)
        return (nats - [c.penalty for c in members]).tolist()

    def neighbours(self, chosen: Names, centre: Names) -> dict[Names, float]:
        """Return sets one step away, with their values, and no more than ``MOST_NEW`` candidates
        that a set does not have.
        """
        listed = {}
        for subset in (chosen, *(chosen - {c} for c in chosen)):
            if len(subset - centre) < MOST_NEW:
                listed |= self.added(subset)
            else:
                listed[subset] = self.value(subset)
        return listed

    def pairs(self, chosen: Names) -> dict[Names, float]:
        """Return sets with two candidates more, or in place of one or two: of two that hide each
        other, neither shows alone.
        """
        listed: dict[Names, float] = {}
        for subset in (chosen - set(g) for n in range(3) for g in combinations(chosen, n)):
            offered = [c for c in self.plain if c not in subset and not c.law]
            base = self.value(subset)
            active = columns_of(subset)
            if len(offered) < 2 or not np.isfinite(base):
                continue
            columns = [c.columns[0] for c in offered]
            prices = [self.penalty(subset | {c}) for c in offered]
            price = np.array(prices) - self.penalty(subset)
            posterior = self.total(subset)
            alone = posterior.additions(active)[columns] - price
            both = posterior.pair_additions(active)[np.ix_(columns, columns)]
            worth = both - np.add.outer(price, price)
            alone = np.maximum(alone, -1e9)  # of a name that cannot be there, as well as none
            synergy = worth - np.maximum.outer(alone, alone)
            synergy[np.tril_indices(len(columns))] = -np.inf
            for place in np.argsort(-synergy, axis=None)[:RANDOM_TRIED].tolist():
                a, b = np.unravel_index(place, synergy.shape)
                if np.isfinite(synergy[a, b]):
                    new = subset | {offered[a], offered[b]}
                    self._shares.setdefault(new, self.shares(subset))
                    listed[new] = base + float(worth[a, b])
        return listed


def window(
    linear: Linear, begin: Iterable[Names], centre: Names = NOTHING, pairs: bool = True
) -> dict[Names, float]:
    """Return the sets near the best and their neighbours, with their values.

    Args:
        begin: sets that are opened first.
        centre: set that the derivatives belong to: others have at most ``MOST_NEW`` candidates
            more.
        pairs: whether two candidates are tried at once.
    """
    values = {chosen: linear.value(chosen) for chosen in begin}
    opened: set[Names] = set()
    paired: set[Names] = set()
    in_vain = 0
    while True:
        best = max(values.values())
        close = [s for s, v in values.items() if s not in opened and v > best - WINDOW]
        if close and in_vain < PATIENCE:
            chosen = max(close, key=values.get)
            opened.add(chosen)
            listed = linear.neighbours(chosen, centre)
        else:
            chosen = max(values, key=values.get)
            if chosen in paired or not pairs:
                break
            paired.add(chosen)
            listed = linear.pairs(chosen)
        values |= {s: v for s, v in listed.items() if len(s - centre) <= MOST_NEW}
        in_vain = 0 if max(values.values()) > best + 1e-6 else in_vain + 1
    return values

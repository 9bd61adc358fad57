"""Occam's window: the sets of candidates that are nearly as good as the best one.

A set S of candidates has the value

    V(S) = log Z(S) - sum of its members' penalties

with log Z as in :mod:`visthrow.diagnose.likelihood.evidence`. The standard deviation of random
shares is integrated over its prior. The best-first search expands the best set that it has not yet
expanded, and lists the neighbours: one candidate more, one less, or one replaced. After that, or
after ``PATIENCE`` expansions in vain, it tries pairs of further candidates beside the best set, and
ends if none is better. The sets near the best are the answer.

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
    evidence_of,
    find_day_shares,
    integrate_shares,
    over_deviations,
)

MOST_NEW = 2  # candidates added in one move; derivatives predict larger moves badly

WINDOW = (MOST_NEW + 1) * VERY_STRONG
"""Sets up to this many nats behind the best are kept: the sum of the penalties in a move, in which
at most ``MOST_NEW`` candidates are added and one is removed. Sets up to ``STRONG`` behind count as
possible.
"""
PATIENCE = 8  # expansions without a better set before pairs are tried
RANDOM_TRIED = 4  # most promising random shares, or pairs, that are evaluated for each set


class Linear:
    """Values of sets from the statistics at one point, without simulation."""

    def __init__(
        self,
        statistics: Statistics,
        priors: Priors,
        candidates: Sequence[Candidate],
        penalty: Callable[[Names], float],
    ) -> None:
        """Store statistics, priors and candidates; ``penalty``: of a set [nats]."""
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
        """Return the most probable deviations of a set's random shares, relative to the prior's,
        and by how many nats the evidence there exceeds that integrated over the prior.
        """
        if chosen not in self._shares:
            listed = {}
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
        if c.group == EVENT:  # one size, whose prior is the slab
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
        """Return the deviations of a random share that are not negligible, relative to the prior's,
        and the gain of log Z of each over a deviation of 0.
        """
        sizes = np.unique(np.maximum(sizes, min(c.floors, REACH[-1] / 2.0)))
        active = columns_of(chosen)
        days = find_day_shares(fixed)
        flights = {share: size for share, size in fixed.items() if share not in days}
        statistics = integrate_shares(self.statistics, flights)
        nats = []
        for shares in (days, *({**days, c: size} for size in sizes.tolist())):
            varied = integrate_shares(statistics, shares)
            nats.append(evidence_of(varied, self.priors, active))
        return sizes, np.array(nats[1:]) - nats[0]

    def value(self, chosen: Names) -> float:
        """Return the value of a set [nats]."""
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
        return integrate_shares(self.statistics, self.shares(chosen)[0])

    def total(self, chosen: Names) -> Posterior:
        """Return the posterior of all flights with a set's random shares integrated out."""
        shares = frozenset(self.shares(chosen)[0].items())
        if shares not in self._totals:
            self._totals[shares] = Posterior.of(self._free(chosen), self.priors)
        return self._totals[shares]

    def add(self, subset: Names) -> dict[Names, float]:
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
                    if j in varying:  # a mean changes the deviation of its random shares
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
        """Return the most promising random shares that may exceed their penalty, each judged as if
        no other effect could replace it.
        """
        if not self.random:
            return []
        theta = self.total(subset).mean(columns_of(subset))
        close = {}
        for group in (FLIGHT, DAY, EVENT):
            members = [c for c in self.random if c.group == group]
            if not members:
                continue
            for c, nats in zip(members, self._promises(group, members, theta)):
                if nats > self._step - STRONG and c not in subset:
                    close[c] = nats
        return sorted(close, key=close.get, reverse=True)[:RANDOM_TRIED]

    def _promises(self, group: str, members: Sequence[Candidate], theta: ndarray) -> list[float]:
        """Return the predicted gains of the random shares of one group [nats], at the sizes
        ``theta`` [floors].
        """
        flights = self.statistics.sum_by(self.statistics.days) if group == DAY else self.statistics
        precision = np.maximum(np.diagonal(flights.information, axis1=1, axis2=2), 1e-12)
        misfit = (flights.extrapolate(theta).score) ** 2 / precision
        counts = [len(c.columns) for c in members]
        columns = [j for c in members for j in c.columns]
        deviations = [sd for c in members for sd in c.deviations]
        sizes = REACH[::COARSE]
        place = slice(None), columns
        if group == EVENT:  # a share in one flight only
            sizes = np.ones(1)
            rows = np.searchsorted(flights.flights, [c.flight for c in members])
            place = rows[None], columns
        part = precision[place] * np.multiply.outer(sizes, deviations)[:, None] ** 2
        gain = 0.5 * (misfit[place] * part / (1.0 + part) - np.log1p(part))
        begins = np.cumsum(counts) - counts
        nats = np.add.reduceat(gain.sum(1), begins, axis=1).max(0)
        return (nats - [c.penalty for c in members]).tolist()

    def neighbours(self, chosen: Names, centre: Names) -> dict[Names, float]:
        """Return the neighbours of a set with their values, limited to ``MOST_NEW`` candidates more
        than ``centre`` has.
        """
        listed = {}
        for subset in (chosen, *(chosen - {c} for c in chosen)):
            if len(subset - centre) < MOST_NEW:
                listed |= self.add(subset)
            else:
                listed[subset] = self.value(subset)
        return listed

    def pairs(self, chosen: Names) -> dict[Names, float]:
        """Return sets with two candidates more, which may replace one or two others, with their
        values. Two effects that cancel each other show no gain alone.
        """
        listed = {}
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
            alone = np.maximum(alone, -1e9)  # instead of -inf, so that differences are finite
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
        begin: sets with which the search begins.
        centre: set at which the derivatives were taken; sets have at most ``MOST_NEW`` candidates
            more than it.
        pairs: whether pairs of candidates are tried.
    """
    values = {chosen: linear.value(chosen) for chosen in begin}
    opened = set()
    paired = set()
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

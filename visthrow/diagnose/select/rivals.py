"""Sets of causes that may explain the flights as well as those named, by the linear statistics."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from visthrow.diagnose.likelihood.evidence import additions, log_evidence, pair_additions, set_additions
from visthrow.diagnose.select.point import Point
from visthrow.diagnose.select.state import SearchState

CLOSE = 3.0
"""Sets of causes within this many nats of the best are reported as equally possible."""

DOUBT = 15.0
"""Linear statistics this close [nats] are settled by running the simulation."""

MOST, MOST_CLOSE = 6, 16
"""Sets that are settled so, and how many where they are ``CLOSE``: of what hover shows, a dozen causes may be the reason."""

JOINT_BEST, JOINT_SIZE = 8, 3
"""All sets of up to so many of the best effects are compared."""

EXCHANGED, PAIRS = 2, 4
"""Names that two others are tried in place of, and how many sets with two others are settled by running the simulation."""

FAR = 25.0
"""The same as :data:`DOUBT` where two others stand in place of two: sizes move far together, and derivatives tell less."""


def rivals(search: SearchState) -> list[tuple[list[int], float]]:
    """Sets to be settled by running the simulation, with their nats against those named; every name costs the threshold.

    Args:
        search: that has named what it could, one name after the other.
    """
    priors, active = search.priors, search.active
    own = _linear(search, active)
    gain = additions(search.nominal.information, search.nominal.score, priors, ())
    gain[list(search.refused)] = -np.inf
    best = {int(j) for j in np.argsort(-gain)[:JOINT_BEST] if np.isfinite(gain[j])} | set(active)
    sizes = range(1, JOINT_SIZE + 1) if active else ()  # where nothing is named, each was tried alone
    sets = {tuple(sorted(c)) for size in sizes for c in combinations(sorted(best), size)}
    usable = [int(k) for k in np.flatnonzero(np.isfinite(gain)) if k not in active]
    exchanges = {tuple(sorted([k if i == j else i for i in active])): k for j in active for k in usable}
    sets = (sets | set(exchanges)) - {tuple(sorted(active))}
    sets = [s for s in sets if not set(s) > set(active)]  # additions were tried already
    values = {s: v - own for s, v in _all_linear(search, sets, search.point).items()}
    if len(active) == 1:  # where it is far from nothing, derivatives there may tell too little of what has no share of it
        there = _linear(search, active, search.nominal)
        values = {s: max(values[s], v - there) for s, v in _all_linear(search, sets, search.nominal).items()}
    alike = {k for s, k in exchanges.items() if values[s] > -CLOSE}
    ranked = sorted(((list(s), v) for s, v in values.items() if v > -DOUBT), key=lambda v: -v[1])
    ranked = [v for i, v in enumerate(ranked) if i < MOST or (i < MOST_CLOSE and abs(v[1]) < CLOSE)]
    pairs = _with_pairs(search, [k for k in usable if k not in alike and not search.problem.switches[k]], own)
    known = {tuple(s) for s, _ in ranked}
    return ranked + [v for v in sorted(pairs, key=lambda v: -v[1]) if tuple(v[0]) not in known][:PAIRS]


def _linear(search: SearchState, active: Sequence[int], point: Point | None = None) -> float:
    """Evidence of a set, less what its names cost; by the statistics of a point, by default where the search stands."""
    at = search.point if point is None else point
    return log_evidence(at.information, at.score, search.priors, active) - search.least * len(active)


def _all_linear(search: SearchState, sets: Sequence[tuple[int, ...]], point: Point) -> dict[tuple[int, ...], float]:
    """The same of many sets at once."""
    given, found = (point.information, point.score, search.priors, ()), {}
    nothing = log_evidence(*given)
    for size in sorted({len(s) for s in sets}):
        own = [s for s in sets if len(s) == size]
        found |= zip(own, (nothing + set_additions(*given, own) - search.least * size).tolist())
    return found


def _with_pairs(search: SearchState, usable: Sequence[int], own: float) -> list[tuple[list[int], float]]:
    """Sets with two more effects beside all names but up to two, which come close to those named or go beyond them.

    Of two effects that hide each other neither is worth a name alone, nor is one in place of one where two say the same as two.

    Args:
        search: with what is named.
        usable: what the two are chosen among.
        own: evidence of those named.
    """
    found, most = [], len(search.active)
    for rest in (c for size in range(max(most - EXCHANGED, 0), most + 1) for c in combinations(search.active, size)):
        given = search.point.information, search.point.score, search.priors, rest
        gain, alone = pair_additions(*given)[np.ix_(usable, usable)], additions(*given)[usable]
        each = gain - np.maximum.outer(alone, alone) > search.least - CLOSE  # is worth a name beside the other
        gain += _linear(search, rest) - 2.0 * search.least - own
        near = each & (gain > (-FAR if len(rest) + 2 == most else -CLOSE))
        found += [(sorted([*rest, usable[i], usable[j]]), float(gain[i, j])) for i, j in np.argwhere(np.triu(near))]
    return found

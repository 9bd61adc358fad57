"""The selector: one loop that adds, drops, exchanges and pairs candidates until set and sizes
repeat.

A candidate is a column of the linearised model with a prior and a price: an effect, another kind of
block, a term of a law (see :mod:`visthrow.diagnose.select.terms`). The value of a set is its
marginal likelihood less what its names cost. Moves are listed by batched evidence; the simulation
is run again where they lead, and the set that is worth most there is kept.

Source: stepwise selection with exchanges (Fedorov 1972; Miller 2002) by marginal likelihood.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from visthrow.diagnose.likelihood.evidence import (
    INEXACT,
    STRONG,
    additions,
    estimate,
    log_evidence,
    pair_additions,
)
from visthrow.diagnose.select import lost_commands as dropped
from visthrow.diagnose.select import terms
from visthrow.diagnose.select.excess import compares_phases, levels
from visthrow.diagnose.select.point import (
    Point,
    Problem,
    bend,
    candidate,
    candidates,
    fitted,
    linearise,
    lost,
    only,
    with_all_effects_noise,
    with_floors_noise,
    with_varying,
)
from visthrow.diagnose.select.result import SelectionStep
from visthrow.diagnose.select.scatter import CHAIN, Varies, deviations
from visthrow.diagnose.select.search_state import SearchState, SetMove

MOST_NAMES = 3 * CHAIN  # a longer list of causes is a wrong form, not a finding
# sets of a kind whose simulation is run again in each round, of exchanges twice as many
SHORTLIST = 3

DOUBT = 15.0
"""Nats behind up to which a set is simulated, where statistics of other sizes may be wrong; up to
``STRONG`` it counts as possible.
"""

# nats by which an exchange must be ahead: less is not worth more than a bare mention (Kass and
# Raftery 1995)
EXCHANGE_MARGIN = 1.0
SETS_REPORTED = 10  # sets that a step keeps for the report

HOPELESS = 0.5
"""Of what the best or what stands there brings, by the linear statistics, that another must bring
to be simulated. Of three laws that the catalogue does not hold the true term brought 1.9, 7 and 107
times as much as the names that stood for it.
"""


class Selector(SearchState):
    """The moves of a search."""

    def run(self, follow: bool = True) -> None:
        """Move until nothing is worth more.

        ``follow``: go on also where the simulation loses windows with the names that were found;
        else it ends there, and they may be left out."""
        if self.point is None:
            self.point = self.origin = self.nominal
        while True:
            self.visited.add(frozenset(self.active))
            if self._drop():
                continue
            # names that were there before may not be needed any more, and what its form leaves over
            # is no cause
            if self.terms:
                if self._exchange() or self._propose():
                    continue
                return
            if len(self.active) < MOST_NAMES and (self._vary() or self._add()):
                if len(self.active) > CHAIN and (follow or not self._loses()) and self._propose():
                    self._exchange()
                continue
            if not follow and self._loses():
                return
            if len(self.active) < MOST_NAMES and self._vary(last=True):
                continue
            if self._exchange() or self._propose() or self._lose_commands(0.0):
                continue
            return

    def _loses(self) -> bool:
        """Whether the simulation follows some windows no more, and no flight was left
        out for it.
        """
        return not self.events and bool(lost(self.point))

    def _usable(self) -> np.ndarray:
        usable = self.priors.visible.copy()
        usable[[*self.active, *self.refused]] = False
        if self.terms:
            usable &= self.term_columns & (len(self.terms) < 2)
        return np.flatnonzero(usable)

    def _add(self) -> bool:
        """Add the best candidate; False where none is good enough."""
        free = with_all_effects_noise(self.problem, self.point)
        usable = self._usable()
        screened, under_free = (self._additions(point, usable) for point in (self.point, free))
        worth = (
            self.least - STRONG * ~self.problem.switches
        )  # columns of other kinds of blocks are differences of simulations already
        hope = np.maximum(worth, HOPELESS * under_free.max())
        best = [
            (gain, least, usable[np.argsort(-gain[usable])][:SHORTLIST])
            for gain, least in ((under_free, hope), (screened, worth))
        ]
        short = list(
            dict.fromkeys(int(j) for gain, least, own in best for j in own if gain[j] > least[j])
        )
        if not short:
            return False
        alike = self._alike(short[int(np.argmax(under_free[short]))])
        short += [j for j in alike if np.isfinite(screened[j]) and j not in short]
        short = [j for j in short if frozenset([*self.active, j]) not in self.visited]
        listed = {
            (*self.active, j): float(max(screened[j], under_free[j]))
            for j in np.argsort(-under_free)[:SETS_REPORTED].tolist()
        }
        several = self._several(free, usable)
        for move in several:
            listed[move.active] = self.linear(move.active, free) - self.linear(self.active, free)
        if self._best(several, listed, self._contradicted()):
            return True
        tried = self._tried(free, [(*self.active, j) for j in short])
        if self._best(tried, listed, self._contradicted()):
            return True
        return bool(tried) and self._closer(max(tried, key=lambda move: move.nats), listed)

    def _additions(
        self, point: Point, usable: np.ndarray, active: Sequence[int] | None = None
    ) -> np.ndarray:
        gain = np.full(len(self.priors.floor), -np.inf)
        gain[usable] = additions(
            point.information, point.score, self.priors, self.active if active is None else active
        )[usable]
        return gain - (self.prices - self.least)

    def _several(self, free: Point, usable: np.ndarray) -> list[SetMove]:
        """The additions that forward selection comes to, where there are several, simulated at
        once.

        Those are left out that the distance from the linearisation would be taken for. Where a law
        may be missing there are none: names take a part of it each. ``free``: the point by whose
        statistics alone they are selected."""
        if self.problem.terms:
            return []
        active = tuple(self.active)
        plain = usable[~self.problem.switches[usable]]
        while (
            len(active) < MOST_NAMES
            and (gain := self._additions(free, plain, active)).max() > self.least
        ):
            active = (*active, int(np.argmax(gain)))
        while len(active) > len(self.active) + 1 and frozenset(active) not in self.visited:
            (move,) = self._tried(free, [active])
            sizes = np.abs(move.point.theta)
            faked = np.abs(bend(self.problem, self.origin, move.point, active))
            straight = tuple(
                j for j in active if j in self.active or faked[j] <= INEXACT * sizes[j]
            )
            if straight == active:
                return [move]
            active = straight
        return []

    def _alike(self, j: int) -> list[int]:
        """Return what the catalogue says looks like an effect: where a rope whips, derivatives may
        promise far too little.
        """
        names = self.problem.effects[j].confused_with
        return [k for k in np.flatnonzero(~self.problem.switches).tolist() if self.name(k) in names]

    def _contradicted(self) -> float:
        """Nats beyond its price that a name needs while flights contradict another."""
        return max(0.0, 0.5 * max(self.refused.values(), default=0.0) - self.least)

    def _closer(self, move: SetMove, listed: Mapping[tuple[int, ...], float]) -> bool:
        """An addition with derivatives and initial states of its own, where it leads: those of the
        model as it is may fall short.

        A rope that whips forgets its initial state within a window; what was fitted for another
        rope explains nothing."""
        j = move.active[-1]
        origin = self.origin
        point = move.point
        if self.problem.switches[j]:  # it was linearised where it leads already
            return False
        if abs(point.theta[j]) < 1.0:
            goal = estimate(point.information, point.score, self.priors, move.active)
            goal[self.problem.switches] = point.theta[self.problem.switches]
            point = fitted(self.problem, linearise(self.problem, goal, point.noise), move.active)
        if self.sure(point, move.active, j):
            point = self.settle(point, move.active, j)
        alike = candidate(
            self.problem, point, self.active
        )  # begins as it does: new states alone are no gain
        nats = min(
            self.ahead((point, move.active), rival)
            for rival in ((self.point, self.active), (alike, self.active))
        )
        if self._best([SetMove(move.active, nats, point)], listed, self._contradicted()):
            return True
        self.origin = origin
        return False

    def _drop(self) -> bool:
        """Drop the name that is worth least, if it is not worth its price or hardly has
        any size.
        """
        if len(self.active) < 2:
            return False
        worth = self.worth()
        unsure = [j for j in self.active if not self.sure(self.point, self.active, j)]
        saved = {
            j: self.price(self.active) - self.price([k for k in self.active if k != j])
            for j in self.active
        }
        weakest = min(unsure or worth, key=lambda j: worth[j] - saved[j])
        if worth[weakest] > saved[weakest] and not unsure:
            return False
        remaining = [k for k in self.active if k != weakest]
        without = candidate(self.problem, self.point, remaining)
        if not unsure and self.ahead((without, remaining), (self.point, self.active)) < 0.0:
            return False
        self.progress(f"{self.name(weakest)} dropped again")
        self.active = remaining
        self.point = self.settle(without, remaining)
        return True

    def _exchange(self) -> bool:
        """Simulate all sets that may be worth as much, and go over to the best of them; what is
        left is possible as well.
        """
        if self.rivalled is self.point:
            return False
        visited = self.visited | {frozenset(self.active)}
        ranked = [move for move in self._rivals() if frozenset(move.active) not in visited]
        tried = self._tried(self.point, [move.active for move in ranked])
        listed = {move.active: move.nats for move in ranked}
        if self._best(tried, listed, EXCHANGE_MARGIN):
            return True
        self.sets = [
            SetMove(tuple(self.active), 0.0),
            *(move for move in tried if -STRONG < move.nats <= EXCHANGE_MARGIN),
        ]
        self.rivalled = self.point
        return False

    def _rivals(self) -> list[SetMove]:
        """Sets within reach of one move, by the linear statistics, best first."""
        singles = {}
        pairs = {}
        active = self.active
        usable = self._usable()
        present = self.linear(active, self.point)
        for subset in self._rests():
            state = self.point.information, self.point.score, self.priors, subset
            base = self.linear(subset, self.point) - present
            single = additions(*state)
            singles[subset] = base
            new = (
                usable if len(subset) < len(active) else usable[self.term_columns[usable]]
            )  # other additions were tried already
            singles |= {(*subset, k): base + single[k] - self.prices[k] for k in new.tolist()}
            plain = usable[~self.problem.switches[usable]]
            gain = pair_additions(*state)[np.ix_(plain, plain)]
            single_gain = single[plain]
            reached = np.triu(
                gain - np.maximum.outer(single_gain, single_gain) > self.least - STRONG
            )  # worth a name beside the other
            gain += base - np.add.outer(self.prices[plain], self.prices[plain])
            close = reached & (gain > (-DOUBT if len(subset) + 2 == len(active) else -STRONG))
            pairs |= {
                (*subset, int(plain[a]), int(plain[b])): float(gain[a, b])
                for a, b in np.argwhere(close)
            }
        if (
            active
        ):  # far from nothing, derivatives there may tell too little of what has no share of it
            single = (
                additions(self.nominal.information, self.nominal.score, self.priors, ())
                - self.prices
            )
            single += self.linear((), self.nominal) - self.linear(active, self.nominal)
            singles |= {(k,): max(singles.get((k,), -np.inf), single[k]) for k in usable.tolist()}
        ranked = _ranked(singles, DOUBT)
        ranked = [m for i, m in enumerate(ranked) if i < 2 * SHORTLIST or abs(m.nats) < STRONG]
        single = (
            [] if self.terms else [SetMove((k,), 0.0) for k in usable.tolist() if self.is_term(k)]
        )  # not to be told from here
        return [
            *ranked,
            *_ranked(pairs, DOUBT)[:SHORTLIST],
            *(m for m in single if m.active not in [r.active for r in ranked]),
        ]

    def _rests(self) -> Iterator[tuple[int, ...]]:
        """The set, it without one or two of its names, and without those that act in a
        law's block.
        """
        lawful = np.flatnonzero(self.term_columns).tolist()
        blocks = {self.problem.effects[j].block: j for j in lawful}
        yield from {
            (*(j for j in self.names if not self._acts_beside(j, [k])), *self.terms)
            for k in blocks.values()
        }
        for removed in range(min(2, len(self.active)) + 1):
            yield from combinations(self.active, len(self.active) - removed)

    def _tried(self, point: Point, sets: Sequence[Sequence[int]]) -> list[SetMove]:
        """Simulate sets from a point."""
        present = self.point, self.active
        moves = [
            SetMove(tuple(s), self.ahead((simulated, s), present), simulated)
            for s, simulated in zip(sets, candidates(self.problem, point, sets))
        ]
        bare = [
            i for i, s in enumerate(sets) if all(map(self.is_term, s))
        ]  # where the names are, or where the model stands alone
        for i, simulated in zip(
            bare, candidates(self.problem, self.nominal, [sets[i] for i in bare])
        ):
            nats = self.ahead((simulated, sets[i]), present)
            moves[i] = max(
                moves[i], SetMove(tuple(sets[i]), nats, simulated), key=lambda move: move.nats
            )
        return moves

    def _best(
        self, tried: Sequence[SetMove], listed: Mapping[tuple[int, ...], float], margin: float
    ) -> bool:
        """Go over to the best of some sets that may be named; False where none is worth enough
        more.
        """
        for move in sorted(tried, key=lambda move: -move.nats):
            new = [j for j in move.active if j not in self.active]
            joins = any(map(self.is_term, new)) and set(self.active) < set(move.active)
            if move.nats <= (terms.LAW if joins else margin) or not self._believed(move):
                continue
            if any(map(self.is_term, new)) and self.nearer():
                return True
            if (
                len(new) == 1
                and len(move.active) > len(self.active)
                and (done := self._differing(move, new[0]))
            ):
                return done
            together = self._together(new)
            grown = len(move.active) > len(self.active)
            self.progress(
                f"{together} named, {move.nats:.1f} nats above the next simpler model"
                if grown
                else f"exchanged for {self._together(move.active)}"
            )
            tell = (
                (lambda s: self._together([j for j in s if j not in self.active]))
                if len(new) == 1 and grown
                else self._together
            )
            simulated = {tell(m.active): m.nats for m in sorted(tried, key=lambda m: -m.nats)}
            screened = {
                tell(s): float(n)
                for s, n in sorted(
                    listed.items(), key=lambda item: -simulated.get(tell(item[0]), -np.inf)
                )[:SETS_REPORTED]
            }
            self.steps.append(
                SelectionStep(tell(move.active), move.nats, margin, screened, simulated)
            )
            self.origin = (
                self.nominal if all(map(self.is_term, move.active)) and move.active else self.origin
            )
            self.active = list(move.active)
            self.point = self.settle(move.point, self.active)
            # what differed from flight to flight may have been this one's share
            self.refused.clear()
            return True
        return False

    def _together(self, active: Sequence[int]) -> str:
        """Names of a set."""
        return ", ".join(map(self.name, active)) or "nothing"

    def _believed(self, move: SetMove) -> bool:
        """Whether the new names of a set could be named: two at once if they leave nothing to
        explain.

        Where a law is missing that the catalogue lacks, pairs that hide each other take a part of
        it each. Without a calm phase to compare with, a vehicle that is a little off in many ways
        asks for a law beside its names: there one stands in place of all."""
        if 0 < sum(map(self.is_term, move.active)) < len(move.active) and not compares_phases(
            self.nominal
        ):
            return False
        new = [j for j in move.active if j not in self.active]
        if not all(self.stands(move.point, move.active, j) for j in new):
            return False
        if any(self.is_term(j) for j in new):
            return all(self._lawful(move.point, move.active, j) for j in new if self.is_term(j))
        single = (
            len(move.active) > len(self.active) and len(new) == 1
        )  # of which :meth:`_differing` asks
        if not single and any(self.disagreement_on(move.point, move.active, j) for j in new):
            return False
        if len(new) < 2:
            return True
        levels_left = levels(
            self.problem,
            self.nominal,
            with_floors_noise(self.problem, move.point, move.active),
            self.least,
        )
        return not any(level.excessive for level in levels_left)

    def _differing(self, move: SetMove, j: int) -> bool:
        """Whether flights disagree on an addition, which is then refused, or is an event of the one
        flight that is left out.
        """
        verdict = self.disagreement_on(move.point, move.active, j)
        origin = self.origin
        point = move.point
        if verdict is not None:
            point = self.settle(point, move.active)
            if point is not move.point:
                verdict = self.disagreement_on(point, move.active, j)
        if verdict is None:
            return False
        self.origin = origin
        if verdict[0] is None:
            self.progress(f"{self.name(j)} is not the same in all flights; it is no cause")
            self.refused[j] = move.nats + self.least
            return True
        self.progress(
            f"event in flight {verdict[0]}: something happened there that the other flights deny"
        )
        self.events.append(verdict[0])
        remaining = [
            i for i, window in enumerate(self.point.windows) if window.flight != verdict[0]
        ]
        self.problem = self.problem.only(remaining)
        self.nominal, self.origin, self.point = (
            only(p, remaining) for p in (self.nominal, self.origin, self.point)
        )
        return True

    def stands_without(
        self, windows_lost: Sequence[int], problem: Problem, nominal: Point, least: float
    ) -> bool:
        """Leave windows out, and say whether each name is still worth the threshold, so that the
        search may go on from there.
        """
        if self.terms or self.dropped is not None:
            return False
        remaining = [i for i in range(len(self.problem.kept)) if i not in set(windows_lost)]
        origin, point = (
            only(terms.bare(self.problem, p)[1], remaining) for p in (self.origin, self.point)
        )
        self.problem = problem
        self.nominal = nominal
        self.least = least
        self.origin, self.point = origin, candidate(problem, point, self.active)
        self.refused = {}
        self.visited = set()
        self.proposed = set()
        worth = self.worth()
        return bool(worth) and all(
            nats > least and self.stands(self.point, self.active, j) for j, nats in worth.items()
        )

    def _vary(self, last: bool = False) -> bool:
        """Let effects differ from flight to flight, where that says more than any name; False where
        nothing new does.

        ``last``: there is no name any more: any effect may be what varies, if no law is why flights
        differ."""
        scatter = [s for s in self.scatter(self.active, every=last) if s.found]
        varies = deviations(
            scatter, self.priors, [e.name for e in self.problem.effects], self.problem.varies.days
        )
        new = [
            s
            for s in scatter
            if not {self.name(j) for j in self.problem.varies.effects} & set(s.of)
        ]
        strongest = max((s.nats for s in new), default=0.0)
        best = 0.0 if last else max(self._additions(self.point, self._usable()).max(), 0.0)
        rival = max(strongest, best, *self.refused.values())
        if not (last or self.active) and self._lose_commands(rival):
            return True
        if not new or strongest < best:
            return False
        if last and self.nearer():  # differences may be what the derivatives lack
            return self._vary(last)
        if last and self._propose() and (self._add() or self._exchange()):
            return True
        for s in new:
            self.progress(
                f"{', '.join(s.of)} differs from {s.by} to {s.by}: {s.size:.3g} {s.unit},"
                f" {s.nats:.1f} nats"
            )
        self.problem = replace(self.problem, varies=varies)
        self.nominal, self.origin, self.point = (
            with_varying(p, varies) for p in (self.nominal, self.origin, self.point)
        )
        self.refused.clear()
        self.visited = {frozenset(self.active)}
        return True

    def _lose_commands(self, rival: float) -> bool:
        """Let commands have got lost, if that says more than what varies and than any name; False
        where it does not.

        It is asked before anything is named, and where the search would end.
        ``rival``: nats of what says most beside it.
        """
        if self.dropped is not None or self.terms or self.came is self.point:
            return False
        verdict = dropped.verdict(*terms.bare(self.problem, self.point), self.active, self.least)
        self.came = self.point
        if (
            verdict is None
            or not verdict.found
            or verdict.nats <= max(rival, *self.refused.values(), 0.0) + self.varying_brings()
        ):
            return False
        problem, point = terms.bare(self.problem, self.point)
        self.progress(f"commands got lost: {verdict.size:.1%} of them, {verdict.nats:.1f} nats")
        self.problem = replace(problem, lost=verdict.size, varies=Varies(problem.varies.days))
        self.nominal = linearise(self.problem, np.zeros_like(point.theta), point.noise)
        self.origin = (
            linearise(self.problem, point.theta, point.noise) if self.active else self.nominal
        )
        self.point = candidate(self.problem, self.origin, self.active)
        self.dropped = dropped.sized(self.problem, self.nominal, verdict)
        self.refused, self.visited, self.proposed = {}, {frozenset(self.active)}, set()
        return True

    def _propose(self) -> bool:
        """Make the terms that say most candidates, beside the set and instead of its names; False
        where that brings no new one.
        """
        strongest = terms.strongest_forces(self.nominal) if self.laws else {}
        present = frozenset(self.active)
        if not strongest or present in self.proposed or len(self.terms) > 1:
            return False
        self.proposed.add(present)
        short = terms.shortlist(self.problem, self.point, self.active, strongest, self.least)
        instead = [(self.nominal, self.terms)] if self.names else []
        for point, subset in [*instead, *([(self.point, self.names)] if self.terms else [])]:
            stead = [
                log_evidence(point.information, point.score, self.priors, s)
                for s in (self.active, subset)
            ]
            margin = max(self.least, HOPELESS * (stead[0] - stead[1]))
            short += terms.shortlist(
                self.problem,
                point,
                subset,
                strongest,
                margin,
                [j for j in self.names if j not in subset],
            )
        short = list({effect.term: effect for effect in reversed(short)}.values())
        if not short:
            return False
        points = {id(p): p for p in (self.nominal, self.origin, self.point)}
        self.problem, wide = terms.extended(self.problem, list(points.values()), short)
        widened = dict(zip(points, wide))
        self.nominal, self.origin, self.point = (
            widened[id(p)] for p in (self.nominal, self.origin, self.point)
        )
        return True

    def _lawful(self, point: Point, active: Sequence[int], j: int) -> bool:
        """Whether a term of a set may be told: it matters, flights agree on it, and no name has its
        form.
        """
        if self.disagreement_on(point, active, j, 1.0):
            return False
        if any(
            terms.unexplained_nats(point, self.priors, active, j, k) < terms.LAW for k in self.names
        ):
            return False
        return terms.matters(
            self.problem, point, j, float(self.sizes(active, point)[j] * self.priors.floor[j])
        )


def _ranked(sets: Mapping[tuple[int, ...], float], doubt: float) -> list[SetMove]:
    """Best first, of those that are not too far behind."""
    return sorted(
        (SetMove(s, float(v)) for s, v in sets.items() if v > -doubt), key=lambda move: -move.nats
    )

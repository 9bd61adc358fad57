"""The selector: one loop that adds, drops, exchanges and pairs candidates until set and sizes repeat.

A candidate is a column of the linearised model with a prior and a price: an effect, another kind of block, a term of a law (see
:mod:`visthrow.diagnose.select.terms`). The value of a set is its marginal likelihood less what its names cost. Moves are listed by batched
evidence; the simulation is run again where they lead, and the set that is worth most there is kept.

Source: stepwise selection with exchanges (Fedorov 1972; Miller 2002) by marginal likelihood.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np

from visthrow.diagnose.likelihood import grammar
from visthrow.diagnose.likelihood.evidence import (
    Priors,
    additions,
    certainty,
    covariance,
    estimate,
    log_evidence,
    pair_additions,
)
from visthrow.diagnose.likelihood.marginal import Statistics
from visthrow.diagnose.select import terms
from visthrow.diagnose.select.excess import acts_on, levels
from visthrow.diagnose.select.point import (
    Point,
    Problem,
    advantage,
    candidate,
    candidates,
    curvature,
    fitted,
    linearise,
    moved,
    only,
    with_all_effects_noise,
    with_floors_noise,
    with_varying,
)
from visthrow.diagnose.select.result import Law, Step
from visthrow.diagnose.select.scatter import (
    SHARE,
    Scatter,
    by_flight,
    deviations,
    disagreement,
    freed,
    straightened,
    varying,
)

MOST_NAMES = 6
"""A longer list of causes is a wrong form, not a finding."""

CHAIN = 3
"""Names from which on terms are weighed at once: a wrong form brings one name after the other."""

SHORTLIST = 3
"""Additions whose simulation is run again in each round."""

HOPE = 0.6
"""Of the threshold: linear statistics from which an addition's simulation is run again."""

DOUBT, CLOSE = 15.0, 3.0
"""Nats behind up to which a set is simulated, where statistics of other sizes may be wrong; and up to which it counts as possible."""

MOST, MOST_CLOSE = 6, 16
"""Sets that are simulated so, and how many where they are ``CLOSE``: of what hover shows, a dozen causes may be the reason."""

AHEAD = 1.0
"""Nats by which an exchange must be ahead."""

STRAIGHT = 0.5
"""Size in floors that the simulation's distance from its linearisation may fake before the derivatives are taken anew."""

WHOLE = 0.7
"""Of another kind of block that flights must ask for: of one that is not there, whose state has more freedom, a part is taken."""

LINEARISATIONS = 3
"""At most so many times in a row, each where the last led."""

SHOWN = 10
"""Sets that a step keeps for the report."""

NEAR = 0.1
"""Distance from where derivatives were taken, in floors, within which they hold for a law as well."""

HOPELESS = 0.5
"""Of what names bring where the model stands alone, by the linear statistics, that a term instead of them must bring to be weighed.
Of three laws that the catalogue does not hold the true term brought 1.9, 7 and 107 times as much as the names that stood for it."""

ANY_SIZE = 1e3
"""Prior deviation of a name of any size, in its usual one."""


@dataclass(frozen=True)
class Work:
    """What a diagnosis leaves behind for gain, report, plan and blind: the search's problem, its first and its last point."""

    problem: Problem
    before: Point
    after: Point
    active: tuple[int, ...]


@dataclass(frozen=True)
class Move:
    """A set that may take the place of the one that a search stands at."""

    active: tuple[int, ...]
    nats: float  # by which it is ahead
    point: Point | None = None  # where the simulation was run with it


@dataclass
class Selector:
    """A search: the set that it has come to, the point where it stands, and what was said on the way."""

    problem: Problem
    nominal: Point
    least: float  # threshold [nats]
    progress: Callable[[str], None]
    laws: bool = True  # whether terms are candidates
    active: list[int] = field(default_factory=list)
    point: Point | None = None
    origin: Point | None = None  # where the derivatives were taken last
    steps: list[Step] = field(default_factory=list)
    refused: dict[int, float] = field(default_factory=dict)  # effects that are not the same in all flights, with their nats
    events: list[int] = field(default_factory=list)
    sets: list[Move] = field(default_factory=list)  # that are possible as well
    proposed: set[frozenset[int]] = field(default_factory=set)  # sets beside which terms were looked for
    linearised: set[frozenset[int]] = field(default_factory=set)  # sets at whose sizes derivatives were taken for laws' sake
    visited: set[frozenset[int]] = field(default_factory=set)
    acting: dict[int, tuple[str, str]] = field(default_factory=dict)  # blocks that effects act in, without the joint and with it
    work: Point | None = None  # what is left for report and plan: without laws
    varied: Any = None  # of :meth:`scatter`, and what it was asked about

    @property
    def priors(self) -> Priors:
        """Return the priors of the candidates."""
        return self.problem.priors

    @property
    def terms(self) -> list[int]:
        """Return the terms of laws in the set."""
        return [j for j in self.active if self._is_term(j)]

    @property
    def names(self) -> list[int]:
        """Return the effects of the set."""
        return [j for j in self.active if not self._is_term(j)]

    def name(self, j: int) -> str:
        """Return the name of a candidate by its number."""
        return self.problem.model.effects[j].name

    def run(self) -> None:
        """Move until nothing is worth more."""
        if self.point is None:
            self.point = self.origin = self.nominal
        while True:
            self.visited.add(frozenset(self.active))
            if self._drop():
                continue
            if self.terms:  # names that were there before may not be needed any more, and what its form leaves over is no cause
                if self._exchange() or self._propose():
                    continue
                return
            if len(self.active) < MOST_NAMES and (self._vary() or self._add()):
                if len(self.active) >= CHAIN and self._propose():
                    self._exchange()
                continue
            if len(self.active) < MOST_NAMES and self._vary(last=True):
                continue
            if self._exchange() or self._propose():
                continue
            return

    # What sets are worth

    def price(self, active: Sequence[int]) -> float:
        """Return what the names of a set cost [nats]: those that act in a law's block may be a part of its form, and cost as much."""
        prices, lawful = self.prices, [j for j in active if self._is_term(j)]
        beside = [j for j in active if j not in lawful and self._acts_beside(j, lawful)]
        return float(prices[list(active)].sum() + len(beside) * max((prices[j] for j in lawful), default=0.0))

    def _acts_beside(self, j: int, laws: Sequence[int]) -> bool:
        """Whether an effect acts in the block of one of some laws."""
        blocks = {self.problem.model.effects[k].block for k in laws}
        if blocks and j not in self.acting:
            self.acting[j] = acts_on(self.nominal, j), acts_on(self.nominal, j, joint=True)
        return bool(blocks) and self.acting[j][grammar.JOINT in blocks] in blocks

    @property
    def prices(self) -> np.ndarray:
        """Return what the name of each candidate costs [nats], shape (K,)."""
        return self.least + np.array([getattr(e, "price", 0.0) for e in self.problem.model.effects])

    def ahead(self, first: tuple[Point, Sequence[int]], second: tuple[Point, Sequence[int]]) -> float:
        """Return the nats by which a set at its point is worth more than another at its own."""
        evidence = advantage(self.priors, first, second, self.problem.switches)
        return float(evidence - self.price(first[1]) + self.price(second[1]))

    def _is_term(self, j: int) -> bool:
        return isinstance(self.problem.model.effects[j], terms.TermEffect)

    def _linear(self, active: Sequence[int], point: Point) -> float:
        return log_evidence(point.information, point.score, self.priors, list(active)) - self.price(active)

    def _usable(self) -> np.ndarray:
        usable = self.priors.visible.copy()
        usable[[*self.active, *self.refused]] = False
        if self.terms:
            usable &= self.term_columns & (len(self.terms) < 2)
        return np.flatnonzero(usable)

    @property
    def term_columns(self) -> np.ndarray:
        """Return which candidates are terms, shape (K,), bool."""
        return np.array([self._is_term(j) for j in range(len(self.priors.floor))])

    # Moves

    def _add(self) -> bool:
        """Add the best candidate; False where none is good enough."""
        free, usable = with_all_effects_noise(self.problem, self.point), self._usable()
        screened, under_free = (self._additions(point, usable) for point in (self.point, free))
        worth = HOPE * self.least
        short = [int(j) for j in usable[np.argsort(-under_free[usable])][:SHORTLIST] if under_free[j] > max(worth, 0.3 * under_free.max())]
        short += [int(j) for j in usable[np.argsort(-screened[usable])][:2] if screened[j] > worth and j not in short]
        if not short:
            return False
        alike = self._alike(short[int(np.argmax(under_free[short]))])
        short += [j for j in alike if np.isfinite(screened[j]) and j not in short]
        short = [j for j in short if frozenset([*self.active, j]) not in self.visited]
        listed = {(*self.active, j): float(max(screened[j], under_free[j])) for j in np.argsort(-under_free)[:SHOWN].tolist()}
        tried = self._tried(free, [(*self.active, j) for j in short])
        if self._best(tried, listed, self._contradicted()):
            return True
        return bool(tried) and self._closer(max(tried, key=lambda move: move.nats), listed)

    def _additions(self, point: Point, usable: np.ndarray) -> np.ndarray:
        gain = np.full(len(self.priors.floor), -np.inf)
        gain[usable] = additions(point.information, point.score, self.priors, self.active)[usable]
        return gain - (self.prices - self.least)

    def _alike(self, j: int) -> list[int]:
        """What the catalogue says looks like an effect: where a rope whips, derivatives may promise far too little."""
        names = self.problem.model.effects[j].confused_with
        return [k for k in np.flatnonzero(~self.problem.switches).tolist() if self.name(k) in names]

    def _contradicted(self) -> float:
        """Nats beyond its price that a name needs while flights contradict another."""
        return max(0.0, 0.5 * max(self.refused.values(), default=0.0) - self.least)

    def _closer(self, move: Move, listed: Mapping[tuple[int, ...], float]) -> bool:
        """An addition with derivatives and initial states of its own, where it leads: those of the model as it is may fall short.

        A rope that whips forgets its initial state within a window; what was fitted for another rope explains nothing.
        """
        j, origin, point = move.active[-1], self.origin, move.point
        if self.problem.switches[j]:  # it was linearised where it leads already
            return False
        if abs(point.theta[j]) < 1.0:
            goal = estimate(point.information, point.score, self.priors, move.active)
            goal[self.problem.switches] = point.theta[self.problem.switches]
            point = fitted(self.problem, linearise(self.problem, goal, point.noise), move.active)
        if self._sure(point, move.active, j):
            point = self._settle(point, move.active, j)
        alike = candidate(self.problem, point, self.active)  # begins as it does: new states alone are no gain
        nats = min(self.ahead((point, move.active), other) for other in ((self.point, self.active), (alike, self.active)))
        if self._best([Move(move.active, nats, point)], listed, self._contradicted()):
            return True
        self.origin = origin
        return False

    def _drop(self) -> bool:
        """Drop the name that is worth least, if it is not worth its price or hardly has any size."""
        if len(self.active) < 2:
            return False
        worth = self.worth()
        unsure = [j for j in self.active if not self._sure(self.point, self.active, j)]
        saved = {j: self.price(self.active) - self.price([k for k in self.active if k != j]) for j in self.active}
        weakest = min(unsure or worth, key=lambda j: worth[j] - saved[j])
        if worth[weakest] > saved[weakest] and not unsure:
            return False
        rest = [k for k in self.active if k != weakest]
        without = candidate(self.problem, self.point, rest)
        if not unsure and self.ahead((without, rest), (self.point, self.active)) < 0.0:
            return False
        self.progress(f"{self.name(weakest)} dropped again")
        self.active = rest
        self.point = self._settle(without, rest)
        return True

    def worth(self, active: Sequence[int] | None = None) -> dict[int, float]:
        """Return what each name of a set, by default that of the search, adds to the others, in nats."""
        active = self.active if active is None else active
        whole = self.point.evidence(self.priors, active)
        return {j: whole - self.point.evidence(self.priors, [k for k in active if k != j]) for j in active}

    def _exchange(self) -> bool:
        """Simulate all sets that may be worth as much, and go over to the best of them; what is left is possible as well."""
        ranked = [move for move in self._rivals() if frozenset(move.active) not in self.visited]
        tried = self._tried(self.point, [move.active for move in ranked])
        listed = {move.active: move.nats for move in ranked}
        if self._best(tried, listed, AHEAD):
            return True
        self.sets = [Move(tuple(self.active), 0.0), *(move for move in tried if -CLOSE < move.nats <= AHEAD)]
        return False

    def _rivals(self) -> list[Move]:
        """Sets within reach of one move, by the linear statistics, best first."""
        singles, pairs, active = {}, {}, self.active
        usable, own = self._usable(), self._linear(active, self.point)
        for rest in self._rests():
            known = self.point.information, self.point.score, self.priors, rest
            base, alone = self._linear(rest, self.point) - own, additions(*known)
            singles[rest] = base
            new = usable if len(rest) < len(active) else usable[self.term_columns[usable]]  # other additions were tried already
            singles |= {(*rest, k): base + alone[k] - self.prices[k] for k in new.tolist()}
            plain = usable[~self.problem.switches[usable]]
            gain, each = pair_additions(*known)[np.ix_(plain, plain)], alone[plain]
            reached = np.triu(gain - np.maximum.outer(each, each) > self.least - CLOSE)  # worth a name beside the other
            gain += base - np.add.outer(self.prices[plain], self.prices[plain])
            near = reached & (gain > (-DOUBT if len(rest) + 2 == len(active) else -CLOSE))
            pairs |= {(*rest, int(plain[a]), int(plain[b])): float(gain[a, b]) for a, b in np.argwhere(near)}
        if active:  # far from nothing, derivatives there may tell too little of what has no share of it
            alone = additions(self.nominal.information, self.nominal.score, self.priors, ()) - self.prices
            alone += self._linear((), self.nominal) - self._linear(active, self.nominal)
            singles |= {(k,): max(singles.get((k,), -np.inf), alone[k]) for k in usable.tolist()}
        ranked = _ranked(singles, DOUBT)
        ranked = [m for i, m in enumerate(ranked) if i < MOST or (i < MOST_CLOSE and abs(m.nats) < CLOSE)]
        alone = [] if self.terms else [Move((k,), 0.0) for k in usable.tolist() if self._is_term(k)]  # not to be told from here
        return [*ranked, *_ranked(pairs, DOUBT)[:SHORTLIST], *(m for m in alone if m.active not in [r.active for r in ranked])]

    def _rests(self) -> Iterator[tuple[int, ...]]:
        """The set, it without one or two of its names, and without those that act in a law's block."""
        lawful = np.flatnonzero(self.term_columns).tolist()
        blocks = {self.problem.model.effects[j].block: j for j in lawful}
        yield from {(*(j for j in self.names if not self._acts_beside(j, [k])), *self.terms) for k in blocks.values()}
        for gone in range(min(2, len(self.active)) + 1):
            yield from combinations(self.active, len(self.active) - gone)

    def _tried(self, point: Point, sets: Sequence[Sequence[int]]) -> list[Move]:
        """Simulate sets from a point."""
        bare = [i for i, s in enumerate(sets) if all(map(self._is_term, s))]
        found = dict(zip(bare, candidates(self.problem, self.nominal, [sets[i] for i in bare])))
        rest = [i for i in range(len(sets)) if i not in found]
        found |= zip(rest, candidates(self.problem, point, [sets[i] for i in rest]))
        found, here = [found[i] for i in range(len(sets))], (self.point, self.active)
        return [Move(tuple(s), self.ahead((there, s), here), there) for s, there in zip(sets, found)]

    def _best(self, tried: Sequence[Move], listed: Mapping[tuple[int, ...], float], enough: float) -> bool:
        """Go over to the best of some sets that may be named; False where none is worth enough more."""
        for move in sorted(tried, key=lambda move: -move.nats):
            if move.nats <= enough or not self._believed(move):
                continue
            new = [j for j in move.active if j not in self.active]
            if any(map(self._is_term, new)) and self.nearer():
                return True
            if len(new) == 1 and len(move.active) > len(self.active) and (done := self._differing(move, new[0])):
                return done
            together = self._together(new)
            grown = len(move.active) > len(self.active)
            self.progress(f"{together} named, {move.nats:.1f} nats above the next simpler model" if grown
                          else f"exchanged for {self._together(move.active)}")  # fmt: skip
            tell = (lambda s: self._together([j for j in s if j not in self.active])) if len(new) == 1 and grown else self._together
            again = {tell(m.active): m.nats for m in sorted(tried, key=lambda m: -m.nats)}
            shown = {tell(s): float(n) for s, n in sorted(listed.items(), key=lambda item: -again.get(tell(item[0]), -np.inf))[:SHOWN]}
            self.steps.append(Step(tell(move.active), move.nats, enough, shown, again))
            self.origin = self.nominal if all(map(self._is_term, move.active)) and move.active else self.origin
            self.active = list(move.active)
            self.point = self._settle(move.point, self.active)
            self.refused.clear()  # what differed from flight to flight may have been this one's share
            return True
        return False

    def _together(self, active: Sequence[int]) -> str:
        """Names of a set."""
        return ", ".join(map(self.name, active)) or "nothing"

    # Whether a set may be named

    def _believed(self, move: Move) -> bool:
        """Whether the new names of a set could be named: two at once if they leave nothing to explain.

        Where a law is missing that the catalogue lacks, pairs that hide each other take a part of it each.
        """
        new = [j for j in move.active if j not in self.active]
        if not all(self._stands(move.point, move.active, j) for j in new):
            return False
        if any(self._is_term(j) for j in new):
            return all(self._lawful(move.point, move.active, j) for j in new if self._is_term(j))
        alone = len(move.active) > len(self.active) and len(new) == 1  # of which :meth:`_differing` asks
        if not alone and any(self._disagreement(move.point, move.active, j) for j in new):
            return False
        if len(new) < 2:
            return True
        left = levels(self.problem, self.nominal, with_floors_noise(self.problem, move.point, move.active), self.least)
        return not any(level.excessive for level in left)

    def _differing(self, move: Move, j: int) -> bool:
        """Whether flights disagree on an addition, which is then refused, or is an event of the one flight that is left out."""
        verdict, origin, point = self._disagreement(move.point, move.active, j), self.origin, move.point
        if verdict is not None:
            point = self._settle(point, move.active)
            if point is not move.point:
                verdict = self._disagreement(point, move.active, j)
        if verdict is None:
            return False
        self.origin = origin
        if verdict[0] is None:
            self.progress(f"{self.name(j)} is not the same in all flights; it is no cause")
            self.refused[j] = move.nats + self.least
            return True
        self.progress(f"event in flight {verdict[0]}: something happened there that the other flights deny")
        self.events.append(verdict[0])
        left = [i for i, window in enumerate(self.point.windows) if window.flight != verdict[0]]
        self.problem = self.problem.only(left)
        self.nominal, self.origin, self.point = (only(p, left) for p in (self.nominal, self.origin, self.point))
        return True

    def _disagreement(self, point: Point, active: Sequence[int], j: int, share: float = SHARE) -> tuple[int | None] | None:
        return disagreement(point.plain, self.priors, point.varies, active, j, self.least, share)

    def _stands(self, point: Point, active: Sequence[int], j: int) -> bool:
        """Whether a candidate of a set could be named at all, however many nats it brings."""
        if self.problem.switches[j]:
            share = estimate(point.information, point.score, self.priors, list(active))[j] * self.priors.floor[j]
            if share < WHOLE:
                self.progress(f"{self.name(j)} is there or not, and these flights ask for a part of it; it is not named")
                return False
        if not self._sure(point, active, j):
            self.progress(f"{self.name(j)} would be no larger than what it cannot be told from; it is not named")
            return False
        return True

    def _sure(self, point: Point, active: Sequence[int], j: int) -> bool:
        """Whether an effect of a set is surely not 0, whatever half a floor of it is."""
        return bool(certainty(point.information, point.theta, self.priors, active)[list(active).index(j)] > 1.0)

    def stands_without(self, gone: Sequence[int], problem: Problem, nominal: Point, least: float) -> bool:
        """Leave windows out, and say whether each name is still worth the threshold, so that the search may go on from there.

        Args:
            gone: numbers of the windows.
            problem: without them.
            nominal: point without them.
            least: threshold without them.
        """
        if self.terms:
            return False
        left = [i for i in range(len(self.problem.kept)) if i not in set(gone)]
        self.problem, self.nominal, self.least = problem, nominal, least
        self.origin, self.point = only(self.origin, left), candidate(self.problem, only(self.point, left), self.active)
        self.refused, self.visited = {}, set()
        worth = self.worth()
        return bool(worth) and all(nats > least and self._stands(self.point, self.active, j) for j, nats in worth.items())

    # Where derivatives are taken

    def _settle(self, point: Point, active: Sequence[int], doubted: int | None = None) -> Point:
        """Linearise where the search stands, unless the last derivatives still hold, and step on where that moved the optimum.

        Args:
            point: where it stands.
            active: the set.
            doubted: an effect of it without which the point is of no use, so that it ends where this one is not sure.
        """
        kinds = self.problem.switches
        same = np.array_equal(self.origin.theta[kinds] != 0.0, point.theta[kinds] != 0.0)
        silent = self.priors.visible & (np.diag(self.origin.information) <= 0.0)  # such as wind without drag: it may show elsewhere
        anew = getattr(self.problem.model, "cheap", False) and np.any(silent)
        if same and not anew and curvature(self.problem, self.origin, point) < STRAIGHT:
            return point
        for _ in range(LINEARISATIONS):
            self.origin = linearise(self.problem, point.theta, point.noise)
            before, point = point, fitted(self.problem, self.origin, active)
            if doubted is not None and not self._sure(point, active, doubted):
                break
            if np.abs(point.theta - before.theta).max() <= 0.5 or curvature(self.problem, self.origin, point) <= STRAIGHT:
                break
        return point

    def nearer(self) -> bool:
        """Linearise where the search stands; False where that was done. Before a law is believed: it may explain what bends do."""
        here = frozenset(self.active)
        if here in self.linearised or np.abs(self.origin.theta - self.point.theta)[~self.term_columns].max(initial=0.0) <= NEAR:
            return False
        self.linearised.add(here)
        self.progress("derivatives are taken where the causes are, for a law may explain what they lack")
        self.origin = linearise(self.problem, self.point.theta, self.point.noise)
        self.point = fitted(self.problem, self.origin, self.active)
        return True

    # What varies

    def scatter(self, active: Sequence[int], *, every: bool = False) -> tuple[Scatter, ...]:
        """Return the verdicts on what varies from flight to flight about the sizes of a set of effects.

        Args:
            active: the set.
            every: ask about all effects, not only those of the catalogue's random effects and those that are known to vary.
        """
        asked = self.point, tuple(active), every
        if self.varied is None or self.varied[0][0] is not self.point or self.varied[0][1:] != asked[1:]:
            effects, about = self.problem.model.effects, self.sizes(active)
            others = by_flight([e for j, e in enumerate(effects)
                                if j in self.problem.varies or (every and not e.switch and not self._is_term(j))])  # fmt: skip
            self.varied = asked, varying(self.point.plain, about, self.priors, [e.name for e in effects], self.least, self._again,
                                         others, active)  # fmt: skip
        return self.varied[1]

    def sizes(self, active: Sequence[int], point: Point | None = None) -> np.ndarray:
        """Return the most probable sizes of a set of effects at a point, by default the search's, in floors, shape (K,)."""
        point = self.point if point is None else point
        return estimate(point.information, point.score, self.priors, list(active))

    def _again(self, theta: np.ndarray) -> Statistics | None:
        there = moved(self.problem, self.point, theta)
        return None if there is None else there.plain

    def about_means(self, active: Sequence[int], varies: Mapping[int, float]) -> Statistics:
        """Return what the flights say of the means of effects that vary; flights far from the mean are simulated again at their own size.

        Args:
            active: effects named.
            varies: deviation in floors of an effect among flights.
        """
        statistics, theta = self.point.plain, self.sizes(active)
        for j in sorted(set(varies) & set(active)):
            statistics = straightened(statistics, theta, self.priors, j, self._again)
        return freed(statistics, varies)

    def _vary(self, last: bool = False) -> bool:
        """Let effects differ from flight to flight, where that says more than any name; False where nothing new does.

        Args:
            last: there is no name any more: any effect may be what varies, if no law is why flights differ.
        """
        scatter = [s for s in self.scatter(self.active, every=last) if s.found]
        varies = deviations(scatter, self.priors, [e.name for e in self.problem.model.effects])
        new = [s for s in scatter if not {self.name(j) for j in self.problem.varies} & set(s.of)]
        if not new or (not last and max(s.nats for s in new) < self._additions(self.point, self._usable()).max()):
            return False
        if last and self.nearer():  # differences may be what the derivatives lack
            return self._vary(last)
        if last and self._propose() and (self._add() or self._exchange()):
            return True
        for s in new:
            self.progress(f"{', '.join(s.of)} differs from flight to flight: {s.size:.3g} {s.unit}, {s.nats:.1f} nats")
        self.problem = replace(self.problem, varies=varies)
        self.nominal, self.origin, self.point = (with_varying(p, varies) for p in (self.nominal, self.origin, self.point))
        self.refused.clear()
        self.visited = {frozenset(self.active)}
        return True

    # Laws

    def _propose(self) -> bool:
        """Make the terms that say most candidates, beside the set and instead of its names; False where that brings no new one."""
        strongest, here = terms.strongest_forces(self.nominal) if self.laws else {}, frozenset(self.active)
        if not strongest or here in self.proposed or len(self.terms) > 1:
            return False
        self.proposed.add(here)
        short = terms.shortlist(self.problem, self.point, self.active, strongest, self.least)
        instead = [(self.nominal, self.terms)] if self.names else []
        for point, rest in [*instead, *([(self.point, self.names)] if self.terms else [])]:
            stead = [log_evidence(point.information, point.score, self.priors, s) for s in (self.active, rest)]
            short += terms.shortlist(self.problem, point, rest, strongest, max(self.least, HOPELESS * (stead[0] - stead[1])))
        short = list({effect.term: effect for effect in reversed(short)}.values())
        if not short:
            return False
        points = {id(p): p for p in (self.nominal, self.origin, self.point)}
        wide = {key: terms.extended(self.problem, p, short) for key, p in points.items()}
        self.problem = wide[id(self.point)][0]
        self.nominal, self.origin, self.point = (wide[id(p)][1] for p in (self.nominal, self.origin, self.point))
        return True

    def _lawful(self, point: Point, active: Sequence[int], j: int) -> bool:
        """Whether a term of a set may be told: it matters, flights agree on it, and no name has its form."""
        if self._disagreement(point, active, j, 1.0) or any(beyond(point, self.priors, active, j, k) < terms.LAW for k in self.names):
            return False
        return terms.matters(self.problem, point, j, float(self.sizes(active, point)[j] * self.priors.floor[j]))

    def law(self) -> tuple[set[int], str]:
        """Return the names that are not told beside the set's laws, and why there are laws in words.

        Names that act in a law's block may be a part of its form. A name acts there by its column or by what the other names cannot
        stand in for, as two delays that differ by a force. What is worth nothing without those is not told either.
        """
        effects, names = self.problem.model.effects, self.names
        blocks = {effects[j].block for j in self.terms}
        joint = grammar.JOINT in blocks
        near = {j for j in names if acts_on(self.point, j, joint=joint) in blocks}
        near |= {j for j in set(names) - near if len(names) > 1
                 and acts_on(self.point, j, joint=joint, beside=[k for k in names if k != j]) in blocks}  # fmt: skip
        left = [j for j in self.active if j not in near]
        while near and (worth := {j: w for j, w in self.worth(left).items() if j in names}):
            weakest = min(worth, key=worth.get)
            if worth[weakest] > self.least:
                break
            left.remove(weakest)
        told = terms.laws(self.problem, self.point, self.active, 0.0)
        text = " and ".join(f"{law.formula}, c = {law.coefficient:.3g} ± {law.sd:.2g} {law.unit}" for law in told)
        return set(names) - set(left), f"{text} explains what no cause of the catalogue does"

    def explanations(self) -> list[tuple[Law, ...]]:
        """Return the laws of the set, then others one by one in their place, best first."""
        if not self.terms:
            return []
        point, found = self.point, [(*self.names, j) for j in np.flatnonzero(self.term_columns).tolist()]
        value = {s: point.evidence(self.priors, s) - self.price(s) for s in {*found, tuple(self.active)}}
        without = point.evidence(self.priors, self.names) - self.price(self.names)
        best = [tuple(self.active), *sorted((s for s in found if set(s) != set(self.active)), key=value.get, reverse=True)]
        return [terms.laws(self.problem, point, s, value[s] - without) for s in best if value[s] > without]


def _ranked(sets: Mapping[tuple[int, ...], float], doubt: float) -> list[Move]:
    """Best first, of those that are not too far behind."""
    return sorted((Move(s, float(v)) for s, v in sets.items() if v > -doubt), key=lambda move: -move.nats)


def beyond(point: Point, priors: Priors, active: Sequence[int], term: int, name: int) -> float:
    """Nats that a term explains and a name, whatever its size, does not; none where both are the same form.

    A term has neither bounds nor a usual size. It must not take the place of a name that says the same only because the name lies
    at its bound, or is larger than was expected.
    """
    deviation = priors.deviation([k for k in active if k != term])
    deviation[[name, term]] = ANY_SIZE * priors.slab[name], 0.0
    information, score = point.information, point.score
    known = covariance(information, deviation) @ np.column_stack((information[:, term], score))
    own, left = information[term, term] - information[term] @ known[:, 0], score[term] - information[term] @ known[:, 1]
    return float(0.5 * left**2 / max(own, 1e-300))

"""The state of a search: the set that it has come to, where it stands, what that is worth, and what
every move asks of it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from visthrow.diagnose.likelihood import grammar
from visthrow.diagnose.likelihood.evidence import (
    INEXACT,
    OWN_FLOOR,
    SPIKE,
    Priors,
    certainty,
    estimate,
    log_evidence,
)
from visthrow.diagnose.likelihood.marginal import Statistics
from visthrow.diagnose.select import terms
from visthrow.diagnose.select.excess import acts_on
from visthrow.diagnose.select.point import (
    ROUNDS,
    Point,
    Problem,
    advantage,
    curvature,
    fitted,
    linearise,
    moved,
)
from visthrow.diagnose.select.result import Law, SelectionStep
from visthrow.diagnose.select.scatter import (
    Scatter,
    Varies,
    by_flight,
    disagreement,
    freed,
    straightened,
    varying,
)


@dataclass(frozen=True)
class Work:
    """The remains of a diagnosis for gain, report, plan and blind: the search's problem, its first
    and its last point.
    """

    problem: Problem
    before: Point
    after: Point
    active: tuple[int, ...]


@dataclass(frozen=True)
class SetMove:
    """A set that may take the place of the one that a search stands at."""

    active: tuple[int, ...]
    nats: float  # by which it is ahead
    point: Point | None = None  # where the simulation was run with it


@dataclass
class SearchState:
    """A search: the set that it has come to, the point where it stands, and what was said on the
    way.
    """

    problem: Problem
    nominal: Point
    least: float  # threshold [nats]
    progress: Callable[[str], None]
    laws: bool = True  # whether terms are candidates
    active: list[int] = field(default_factory=list)
    point: Point | None = None
    origin: Point | None = None  # where the derivatives were taken last
    steps: list[SelectionStep] = field(default_factory=list)
    refused: dict[int, float] = field(
        default_factory=dict
    )  # effects that are not the same in all flights, with their nats
    events: list[int] = field(default_factory=list)
    sets: list[SetMove] = field(default_factory=list)  # that are possible as well
    rivalled: Point | None = None  # where all sets were simulated that may be worth as much
    proposed: set[frozenset[int]] = field(
        default_factory=set
    )  # sets beside which terms were looked for
    linearised: set[frozenset[int]] = field(
        default_factory=set
    )  # sets at whose sizes derivatives were taken for laws' sake
    visited: set[frozenset[int]] = field(default_factory=set)
    acting: dict[int, tuple[str, str]] = field(
        default_factory=dict
    )  # blocks that effects act in, without the joint and with it
    work: Point | None = None  # what is left for report and plan: without laws
    varied: Any = None  # of :meth:`scatter`, and what it was asked about
    dropped: Scatter | None = None  # the verdict on lost commands, where the model has them
    came: Point | None = None  # where they were asked for last and none was lost

    @property
    def priors(self) -> Priors:
        """Return the priors of the candidates."""
        return self.problem.priors

    @property
    def terms(self) -> list[int]:
        """Return the terms of laws in the set."""
        return [j for j in self.active if self.is_term(j)]

    @property
    def names(self) -> list[int]:
        """Return the effects of the set."""
        return [j for j in self.active if not self.is_term(j)]

    def name(self, j: int) -> str:
        """Return the name of a candidate by its number."""
        return self.problem.effects[j].name

    @property
    def prices(self) -> np.ndarray:
        """Return what the name of each candidate costs [nats], shape (K,)."""
        return self.least + np.array([getattr(e, "price", 0.0) for e in self.problem.effects])

    def price(self, active: Sequence[int], charge: bool = True) -> float:
        """Return what the names of a set cost [nats].

        ``charge``: whether those that act in a law's block, and may be a part of its form, cost
        more."""
        prices = self.prices
        lawful = [j for j in active if self.is_term(j)] if charge else []
        charged = [j for j in active if j not in lawful and self._acts_beside(j, lawful)]
        return float(
            prices[list(active)].sum()
            + len(charged) * max((terms.LAW + prices[j] for j in lawful), default=0.0)
        )

    def _acts_beside(self, j: int, laws: Sequence[int]) -> bool:
        """Whether an effect acts in the block of one of some laws."""
        blocks = {self.problem.effects[k].block for k in laws}
        if blocks and not self.acting:
            numbers = range(len(self.problem.model.effects))
            self.acting = dict(
                enumerate(
                    zip(acts_on(self.nominal, numbers), acts_on(self.nominal, numbers, joint=True))
                )
            )
        return bool(blocks) and self.acting[j][grammar.JOINT in blocks] in blocks

    def ahead(
        self, first: tuple[Point, Sequence[int]], second: tuple[Point, Sequence[int]]
    ) -> float:
        """Return the nats by which a set at its point is worth more than another at its own."""
        evidence = advantage(self.priors, first, second, self.problem.switches)
        comparable = all(
            any(map(self.is_term, active)) for _, active in (first, second)
        )  # law against law
        return float(
            evidence - self.price(first[1], comparable) + self.price(second[1], comparable)
        )

    def is_term(self, j: int) -> bool:
        """Tell whether a candidate is a term of a law."""
        return j >= len(self.problem.model.effects)

    @property
    def term_columns(self) -> np.ndarray:
        """Return which candidates are terms, shape (K,), bool."""
        return np.arange(len(self.priors.floor)) >= len(self.problem.model.effects)

    def linear(self, active: Sequence[int], point: Point) -> float:
        """Return what a set is worth by the statistics of a point alone."""
        return log_evidence(point.information, point.score, self.priors, list(active)) - self.price(
            active, bool(self.terms)
        )

    def worth(self, active: Sequence[int] | None = None) -> dict[int, float]:
        """Return what each name of a set, by default that of the search, adds to the others, in
        nats.
        """
        active = self.active if active is None else active
        whole = self.point.evidence(self.priors, active)
        return {
            j: whole - self.point.evidence(self.priors, [k for k in active if k != j])
            for j in active
        }

    def sizes(self, active: Sequence[int], point: Point | None = None) -> np.ndarray:
        """Return the most probable sizes of a set of effects at a point, by default the search's,
        in floors, shape (K,).
        """
        point = self.point if point is None else point
        return estimate(point.information, point.score, self.priors, list(active))

    def _resimulated(self, theta: np.ndarray) -> Statistics | None:
        simulated = moved(self.problem, self.point, theta)
        return None if simulated is None else simulated.plain

    def about_means(self, active: Sequence[int], varies: Varies) -> Statistics:
        """Return what the flights say of the means of effects that vary; flights far from the mean
        are simulated again at their own size.

        ``varies``: what differs among flights.
        """
        statistics = self.point.plain
        theta = self.sizes(active)
        for j in sorted(set(varies.effects) & set(active)):
            statistics = straightened(statistics, theta, self.priors, j, self._resimulated)
        return freed(statistics, varies)

    def scatter(self, active: Sequence[int], *, every: bool = False) -> tuple[Scatter, ...]:
        """Return the verdicts on what varies from flight to flight about the sizes of a set of
        effects.

        ``every``: ask about all effects, not only those of the catalogue's random effects and those
        that are known to vary."""
        key = self.point, tuple(active), every
        if (
            self.varied is None
            or self.varied[0][0] is not self.point
            or self.varied[0][1:] != key[1:]
        ):
            effects = self.problem.effects
            sizes = self.sizes(active)
            further = by_flight(
                [
                    e
                    for j, e in enumerate(effects)
                    if j in self.problem.varies.effects
                    or (every and not e.switch and not self.is_term(j))
                ]
            )
            self.varied = (
                key,
                varying(
                    self.point.plain,
                    sizes,
                    self.priors,
                    [e.name for e in effects],
                    self.least,
                    self._resimulated,
                    further,
                    active,
                    self.problem.varies.days,
                ),
            )
        return self.varied[1]

    def varying_brings(self) -> float:
        """Return the nats that what varies from flight to flight brings to the set."""
        same = replace(self.point, varies=Varies())
        return max(
            self.point.evidence(self.priors, self.active) - same.evidence(self.priors, self.active),
            0.0,
        )

    def stands(self, point: Point, active: Sequence[int], j: int) -> bool:
        """Tell whether a candidate of a set could be named at all, however many nats it brings."""
        if self.problem.switches[j]:
            share = (
                estimate(point.information, point.score, self.priors, list(active))[j]
                * self.priors.floor[j]
            )
            if (
                share < 1.0 - INEXACT
            ):  # of one that is not there, whose state has more freedom, a part is taken
                self.progress(
                    f"{self.name(j)} is there or not, and these flights ask for a part of it; it is"
                    " not named"
                )
                return False
        if not self.sure(point, active, j):
            self.progress(
                f"{self.name(j)} would be no larger than what it cannot be told from; it is not"
                " named"
            )
            return False
        return True

    def sure(self, point: Point, active: Sequence[int], j: int) -> bool:
        """Tell whether an effect of a set is surely not 0, whatever half a floor of it is."""
        return bool(
            certainty(point.information, point.theta, self.priors, active)[list(active).index(j)]
            > 1.0
        )

    def disagreement_on(
        self, point: Point, active: Sequence[int], j: int, share: float = INEXACT
    ) -> tuple[int | None] | None:
        """Return whether flights disagree on an effect of a set: see
        :func:`visthrow.diagnose.select.scatter.disagreement`.
        """
        return disagreement(point.plain, self.priors, point.varies, active, j, self.least, share)

    def settle(self, point: Point, active: Sequence[int], doubted: int | None = None) -> Point:
        """Linearise where the search stands, unless the last derivatives still hold, and step on
        where that moved the optimum.

        ``doubted``: an effect of it without which the point is of no use, so that it ends where
        this one is not sure."""
        kinds = self.problem.switches
        same = np.array_equal(self.origin.theta[kinds] != 0.0, point.theta[kinds] != 0.0)
        silent = self.priors.visible & (
            np.diag(self.origin.information) <= 0.0
        )  # such as wind without drag: it may show elsewhere
        anew = self.problem.model.cheap and np.any(silent)
        if (
            same and not anew and curvature(self.problem, self.origin, point) < SPIKE
        ):  # what it would fake may go unnamed
            return point
        for _ in range(ROUNDS):
            self.origin = linearise(self.problem, point.theta, point.noise)
            before = point
            point = fitted(self.problem, self.origin, active)
            if doubted is not None and not self.sure(point, active, doubted):
                break
            if (
                np.abs(point.theta - before.theta).max() <= 0.5
                or curvature(self.problem, self.origin, point) <= SPIKE
            ):
                break
        return point

    def nearer(self) -> bool:
        """Linearise where the search stands; False where that was done. Before a law is believed:
        it may explain what bends do.
        """
        present = frozenset(self.active)
        if (
            present in self.linearised
            or np.abs(self.origin.theta - self.point.theta)[~self.term_columns].max(initial=0.0)
            <= OWN_FLOOR
        ):
            return False
        self.linearised.add(present)
        self.progress(
            "derivatives are taken where the causes are, for a law may explain what they lack"
        )
        self.origin = linearise(self.problem, self.point.theta, self.point.noise)
        self.point = fitted(self.problem, self.origin, self.active)
        return True

    def law(self) -> tuple[set[int], str]:
        """Return the names that are not told beside the set's laws, and why there are laws in
        words.

        Names that act in a law's block may be a part of its form. A name acts there by its column
        or by what the other names cannot stand in for, as two delays that differ by a force. What
        is worth nothing without those is not told either."""
        effects = self.problem.effects
        names = self.names
        blocks = {effects[j].block for j in self.terms}
        joint = grammar.JOINT in blocks
        same_block = {
            j for j, block in zip(names, acts_on(self.point, names, joint=joint)) if block in blocks
        }
        same_block |= {
            j
            for j in set(names) - same_block
            if len(names) > 1
            and acts_on(self.point, [j], joint=joint, free_effects=[k for k in names if k != j])[0]
            in blocks
        }
        remaining = [j for j in self.active if j not in same_block]
        while same_block and (
            worth := {j: w for j, w in self.worth(remaining).items() if j in names}
        ):
            weakest = min(worth, key=worth.get)
            if worth[weakest] > self.least:
                break
            remaining.remove(weakest)
        laws = terms.laws(self.problem, self.point, self.active, 0.0)
        text = " and ".join(
            f"{law.formula}, c = {law.coefficient:.3g} ± {law.sd:.2g} {law.unit}" for law in laws
        )
        return set(names) - set(remaining), f"{text} explains what no cause of the catalogue does"

    def explanations(self) -> list[tuple[Law, ...]]:
        """Return the laws of the set, then others one by one in their place, best first."""
        if not self.terms:
            return []
        point = self.point
        listed = [(*self.names, j) for j in np.flatnonzero(self.term_columns).tolist()]
        value = {
            s: point.evidence(self.priors, s) - self.price(s) for s in {*listed, tuple(self.active)}
        }
        without = point.evidence(self.priors, self.names) - self.price(self.names)
        best = [
            tuple(self.active),
            *sorted((s for s in listed if set(s) != set(self.active)), key=value.get, reverse=True),
        ]
        return [
            terms.laws(self.problem, point, s, value[s] - without)
            for s in best
            if s == best[0] or value[s] > without
        ]

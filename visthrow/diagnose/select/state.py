"""The state of a search for causes: what every part of the selection reads, and what the search leaves behind."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from visthrow.diagnose.likelihood.evidence import Priors, estimate
from visthrow.diagnose.likelihood.marginal import Statistics
from visthrow.diagnose.select.point import Point, Problem, fitted, linearise, moved
from visthrow.diagnose.select.result import Step
from visthrow.diagnose.select.scatter import Scatter, by_flight, freed, straightened, varying

NEAR = 0.1
"""Distance from where derivatives were taken, in floors, within which they hold for a law as well."""


@dataclass(frozen=True)
class Work:
    """What a diagnosis leaves behind for gain, report, plan and blind: the search's problem, its first and its last point."""

    problem: Problem
    before: Point
    after: Point
    active: tuple[int, ...]


@dataclass
class SearchState:
    """What a search has come to: the set of names, the point that it stands at, and what was said on the way."""

    problem: Problem
    nominal: Point
    least: float  # threshold [nats]
    progress: Callable[[str], None]
    laws: bool = True  # whether to look for laws outside the catalogue
    active: list[int] = field(default_factory=list)
    point: Point | None = None
    origin: Point | None = None  # where the derivatives were taken last
    steps: list[Step] = field(default_factory=list)
    refused: dict[int, float] = field(default_factory=dict)  # effects that are not the same in all flights, with their nats
    dropped: set[int] = field(default_factory=set)  # effects that a later one made superfluous; they are not tried again
    events: list[int] = field(default_factory=list)
    sets: list[tuple[tuple[int, ...], float]] = field(default_factory=list)
    varied: Any = None  # of :meth:`scatter`, and what it was asked about
    answer: Any = None  # of :func:`visthrow.diagnose.select.unknown.find_laws`, and the state that it was given in

    @property
    def priors(self) -> Priors:
        """Return the priors of the effects."""
        return self.problem.priors

    def name(self, j: int) -> str:
        """Return the name of an effect by its number."""
        return self.problem.model.effects[j].name

    def scatter(self, active: Sequence[int], *, every: bool = False) -> tuple[Scatter, ...]:
        """Return the verdicts on what varies from flight to flight about the sizes of a set of effects.

        Args:
            active: the set.
            every: ask about all effects, not only those of the catalogue's random effects and those that are known to vary.
        """
        asked = self.point, tuple(active), every
        if self.varied is None or self.varied[0][0] is not self.point or self.varied[0][1:] != asked[1:]:
            effects, about = self.problem.model.effects, self.sizes(active)
            others = by_flight([e for j, e in enumerate(effects) if j in self.problem.varies or (every and not e.switch)])
            self.varied = asked, varying(self.point.plain, about, self.priors, [e.name for e in effects], self.least, self.again,
                                         others, active)  # fmt: skip
        return self.varied[1]

    def sizes(self, active: Sequence[int]) -> np.ndarray:
        """Return the most probable sizes of a set of effects, in floors, shape (K,)."""
        return estimate(self.point.information, self.point.score, self.priors, list(active))

    def again(self, theta: np.ndarray) -> Statistics | None:
        """Return statistics of the flights simulated at other sizes, given in floors; None where that fails."""
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
            statistics = straightened(statistics, theta, self.priors, j, self.again)
        return freed(statistics, varies)

    @property
    def away(self) -> bool:
        """Tell whether the derivatives were taken elsewhere than where the search stands."""
        return bool(np.abs(self.origin.theta - self.point.theta).max() > NEAR)

    def nearer(self) -> bool:
        """Linearise where the search stands; False where that was done. Before a law is believed: it may explain what bends do."""
        if not self.away:
            return False
        self.progress("derivatives are taken where the causes are, for a law may explain what they lack")
        self.origin = linearise(self.problem, self.point.theta, self.point.noise)
        self.point = fitted(self.problem, self.origin, self.active)
        return True

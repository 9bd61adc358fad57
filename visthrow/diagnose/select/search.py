"""The search for causes: forward with the simulation run again for each serious candidate, backward after each addition.

Selection is on the evidence of :mod:`visthrow.diagnose.likelihood.evidence`, with the noise levels estimated anew for each set of
causes, so that a cause is not excused as noise. The threshold comes from null worlds of the very flights.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visthrow.common.errors import DiagnoseError
from visthrow.diagnose.likelihood import memory
from visthrow.diagnose.likelihood.evidence import (
    Priors,
    additions,
    certainty,
    estimate,
    threshold,
)
from visthrow.diagnose.likelihood.threads import each
from visthrow.diagnose.models.interface import Model
from visthrow.diagnose.select import held_out
from visthrow.diagnose.select.consistency import Consistency, across_flights, repeated_flights
from visthrow.diagnose.select.excess import levels
from visthrow.diagnose.select.point import (
    Point,
    Problem,
    advantage,
    candidate,
    candidates,
    curvature,
    fitted,
    linearise,
    lost,
    only,
    with_all_effects_noise,
    with_floors_noise,
    with_varying,
)
from visthrow.diagnose.select.result import Diagnosis, Step
from visthrow.diagnose.select.rivals import CLOSE, rivals
from visthrow.diagnose.select.scatter import deviations
from visthrow.diagnose.select.state import SearchState
from visthrow.diagnose.select.unknown import follows_a_law, outside
from visthrow.diagnose.select.verdicts import conclude, out_of_domain

MOST_NAMES = 6
"""A longer list of causes is a wrong form, not a finding."""

CHAIN = 3
"""Names from which on a law outside the catalogue is looked for at once: a wrong form brings one name after the other."""

SHORTLIST = 3
"""Candidates whose simulation is run again in each step."""

SHOWN = 10
"""Candidates that a step keeps for the report."""

HOPE = 0.6
"""Of the threshold: linear statistics from which a candidate's simulation is run again, where derivatives may fall short of it."""

CONTRADICTED = 0.5
"""Share of the evidence of an effect that the flights contradict which any other effect must then exceed."""

STRAIGHT = 0.5
"""Size in floors that the simulation's distance from its linearisation may fake before the derivatives are taken anew."""

WHOLE = 0.7
"""Of another kind of block that flights must ask for: of one that is not there, whose state has more freedom, a part is taken."""

LINEARISATIONS = 3
"""At most so many times in a row, each where the last led."""

LOSSES = 3
"""Rounds in which windows are left out that the simulation does not follow: the worst hide others."""

AHEAD = 1.0
"""Nats by which a set must be ahead of the names for which it is exchanged, each name at the price of the threshold."""

EXCHANGES = 2
"""Times that a set is compared with others, where the last comparison exchanged it and the search went on from there."""


@dataclass
class Search(SearchState):
    """One search; :func:`explain` is the door to it."""

    def run(self) -> None:
        """Search, on from what is named, until nothing exceeds the threshold or names follow one another in place of a law."""
        if self.point is None:
            self.point = self.origin = self.nominal
        compared: set[int] | None = None
        for _ in range(EXCHANGES):
            while len(self.active) < MOST_NAMES and (self._vary() or self._forward() or self._vary(last=True)):
                self._backward()
                if self.laws and len(self.active) == CHAIN and outside(self) and not (self.nearer() and not outside(self)):
                    self.progress("a law that the catalogue does not hold explains this better than one name after the other")
                    return
            named = set(self.active)
            if named == compared:
                return
            self._joint()
            compared = set(self.active)
            if compared == named:
                return

    def _ahead(self, first: tuple[Point, Sequence[int]], second: tuple[Point, Sequence[int]]) -> float:
        """Nats by which a set of effects at its point is ahead of another at its own."""
        return advantage(self.priors, first, second, self.problem.switches)

    def _screen(self, point: Point) -> np.ndarray:
        gain = additions(point.information, point.score, self.priors, self.active)
        gain[[*self.refused, *self.dropped]] = -np.inf
        return gain

    def _alike(self, j: int) -> list[int]:
        """What the catalogue says looks like an effect: where a rope whips, derivatives may promise far too little."""
        names = self.problem.model.effects[j].confused_with
        return [k for k in np.flatnonzero(~self.problem.switches).tolist() if self.name(k) in names]

    def _forward(self) -> bool:
        """Add the best candidate; False where none is good enough."""
        free = with_all_effects_noise(self.problem, self.point)
        screened, under_free = self._screen(self.point), self._screen(free)
        worth = HOPE * self.least
        short = [j for j in np.argsort(-under_free)[:SHORTLIST] if under_free[j] > max(worth, 0.3 * under_free.max())]
        short += [j for j in np.argsort(-screened)[:2] if screened[j] > worth and j not in short]
        if not short:
            return False
        alike = self._alike(max(short, key=lambda j: under_free[j]))
        short += [j for j in alike if np.isfinite(screened[j]) and j not in short]
        base = self.point, self.active
        short = [int(j) for j in short]
        tried = dict(zip(short, candidates(self.problem, free, [[*self.active, j] for j in short])))
        nats = {j: self._ahead((point, [*self.active, j]), base) for j, point in tried.items()}
        enough = max([self.least, *(CONTRADICTED * n for n in self.refused.values())])
        ranked = [j for j in sorted(nats, key=nats.get, reverse=True) if nats[j] > enough]
        best = next((j for j in ranked if self._stands(tried[j], [*self.active, j], j)), None)
        if best is None:
            best, origin = max(nats, key=nats.get), self.origin
            if self.problem.switches[best]:  # it was linearised where it leads already
                return False
            tried[best] = self._closer(tried[best], [*self.active, best])
            alike = candidate(self.problem, tried[best], self.active)  # begins as it does: new states alone are no gain
            others = base, (alike, self.active)
            nats[best] = min(self._ahead((tried[best], [*self.active, best]), other) for other in others)
            if nats[best] <= enough or not self._stands(tried[best], [*self.active, best], best):
                self.origin = origin
                return False
        verdict, found = self._agreed(tried[best], best)
        if verdict is not None:
            return self._set_aside(best, nats[best], verdict)
        ladder = {self.name(j): float(max(screened[j], under_free[j])) for j in np.argsort(-under_free)[:SHOWN]}
        again = {self.name(j): float(n) for j, n in sorted(nats.items(), key=lambda item: -item[1])}
        self.steps.append(Step(self.name(best), float(nats[best]), float(enough), ladder, again))
        self.progress(f"{self.name(best)} named, {nats[best]:.1f} nats above the next simpler model")
        self.active.append(best)
        self.point = self._settle(found, self.active)
        self.refused.clear()  # what differed from flight to flight may have been this one's share
        return True

    def stands_without(self, gone: Sequence[int], problem: Problem, nominal: Point, least: float) -> bool:
        """Leave windows out, and say whether each name is still worth the threshold, so that the search may go on from there.

        Args:
            gone: numbers of the windows.
            problem: without them.
            nominal: point without them.
            least: threshold without them.
        """
        left = [i for i in range(len(self.problem.kept)) if i not in set(gone)]
        self.problem, self.nominal, self.least = problem, nominal, least
        self.origin, self.point = only(self.origin, left), candidate(self.problem, only(self.point, left), self.active)
        self.refused, self.dropped = {}, set()
        worth = self._worth()
        return bool(worth) and all(nats > least and self._stands(self.point, self.active, j) for j, nats in worth.items())

    def _worth(self) -> dict[int, float]:
        """What each name adds to the others, in nats."""
        whole = self.point.evidence(self.priors, self.active)
        return {j: whole - self.point.evidence(self.priors, [k for k in self.active if k != j]) for j in self.active}

    def _vary(self, last: bool = False) -> bool:
        """Let effects differ from flight to flight, where that says more than any name; False where nothing new does.

        Args:
            last: there is no name any more: any effect may be what varies, if no law is why flights differ.
        """
        scatter = [s for s in self.scatter(self.active, every=last) if s.found]
        varies = deviations(scatter, self.priors, [e.name for e in self.problem.model.effects])
        new = [s for s in scatter if not {self.name(j) for j in self.problem.varies} & set(s.of)]
        if not new or (not last and max(s.nats for s in new) < self._screen(self.point).max()):
            return False
        if last and self.nearer():  # differences may be what the derivatives lack
            return self._vary(last)
        if last and self.laws and follows_a_law(self):
            return False
        for s in new:
            self.progress(f"{', '.join(s.of)} differs from flight to flight: {s.size:.3g} {s.unit}, {s.nats:.1f} nats")
        self.problem = replace(self.problem, varies=varies)
        self.nominal, self.origin, self.point = (with_varying(p, varies) for p in (self.nominal, self.origin, self.point))
        self.refused.clear()
        return True

    def _agreed(self, point: Point, j: int) -> tuple[Consistency | None, Point]:
        """Why a candidate is no cause or None, and the candidate, linearised where it lies if the flights differ at first."""
        verdict, origin = across_flights(self.point, point, self.priors, self.active, j, self.least), self.origin
        if verdict is None:
            return None, point
        near = self._settle(point, [*self.active, j])
        if near is not point:
            verdict = across_flights(self.point, near, self.priors, self.active, j, self.least)
        if verdict is not None:
            self.origin = origin
        return verdict, near

    def _closer(self, point: Point, active: Sequence[int]) -> Point:
        """A candidate with derivatives and initial states of its own, where it leads: those of the model as it is may fall short.

        A rope that whips forgets its initial state within a window; what was fitted for another rope explains nothing.
        """
        if abs(point.theta[active[-1]]) < 1.0:
            goal = estimate(point.information, point.score, self.priors, active)
            goal[self.problem.switches] = point.theta[self.problem.switches]
            point = fitted(self.problem, linearise(self.problem, goal, point.noise), active)
            if not self._sure(point, active, active[-1]):
                return point
        return self._settle(point, active, active[-1])

    def _stands(self, point: Point, active: Sequence[int], j: int) -> bool:
        """Whether a candidate of a set could be named at all, however many nats it brings."""
        if self.problem.switches[j] and self._share_of(point, active, j) < WHOLE:
            self.progress(f"{self.name(j)} is there or not, and these flights ask for a part of it; it is not named")
            return False
        if not self._sure(point, active, j):
            self.progress(f"{self.name(j)} would be no larger than what it cannot be told from; it is not named")
            return False
        return True

    def _sure(self, point: Point, active: Sequence[int], j: int) -> bool:
        """Whether an effect of a set is surely not 0, whatever half a floor of it is."""
        return bool(certainty(point.information, point.theta, self.priors, active)[list(active).index(j)] > 1.0)

    def _share_of(self, point: Point, active: Sequence[int], j: int) -> float:
        """How much of another kind of block is asked for by a point that has it: about 1 if it is there."""
        return float(estimate(point.information, point.score, self.priors, list(active))[j] * self.priors.floor[j])

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

    def _set_aside(self, best: int, nats: float, verdict: Consistency) -> bool:
        """An effect of one flight alone: that flight is left out; one that differs from flight to flight is refused."""
        if verdict.flight is None:
            self.progress(f"{self.name(best)} is not the same in all flights; it is no cause")
            self.refused[best] = nats
            return True
        self.progress(f"event in flight {verdict.flight}: something happened there that the other flights deny")
        self.events.append(verdict.flight)
        left = [i for i, window in enumerate(self.point.windows) if window.flight != verdict.flight]
        self.problem = self.problem.only(left)
        self.nominal, self.origin, self.point = (only(p, left) for p in (self.nominal, self.origin, self.point))
        return True

    def _backward(self) -> None:
        """Drop what a later addition made superfluous, or left with hardly any size."""
        while len(self.active) > 1:
            worth = self._worth()
            unsure = [j for j in self.active if not self._sure(self.point, self.active, j)]
            weakest = min(unsure or worth, key=worth.get)
            if worth[weakest] > self.least and not unsure:
                return
            rest = [k for k in self.active if k != weakest]
            without = candidate(self.problem, self.point, rest)
            if self._ahead((self.point, self.active), (without, rest)) > self.least and not unsure:
                return
            self.progress(f"{self.name(weakest)} dropped again")
            self.active = rest
            self.dropped.add(weakest)
            self.point = self._settle(without, rest)

    def _joint(self) -> None:
        """Compare the set found with its rivals by running the simulation, and go over to the best of them."""
        for _ in range(2):
            ranked = rivals(self)
            self.sets = [(tuple(self.active), 0.0)]
            winner: tuple[float, list[int], Point] | None = None
            settled: dict[str, float] = {}
            points = candidates(self.problem, self.point, [rival for rival, _ in ranked])
            for (rival, _), point in zip(ranked, points):
                ahead = self._ahead((point, rival), (self.point, self.active))
                ahead += self.least * (len(self.active) - len(rival))  # every name costs the threshold
                settled[self._together(rival)] = float(ahead)
                if ahead > AHEAD and not self._believed(point, rival):
                    continue
                if ahead > -CLOSE:
                    self.sets.append((tuple(rival), float(-ahead)))
                if ahead > AHEAD and (winner is None or ahead > winner[0]):
                    winner = ahead, list(rival), point
            if winner is None:
                return
            together = self._together(winner[1])
            self.progress(f"exchanged for {together}" if self.active else f"{together} named together: each hides the other")
            screened = {self._together(rival): nats for rival, nats in ranked}
            screened = {name: screened[name] for name in sorted(screened, key=settled.get, reverse=True)[:SHOWN]}
            self.steps.append(Step(together, winner[0], AHEAD, screened, settled))
            self.active = winner[1]
            self.point = self._settle(winner[2], self.active)
            distances = ((members, n + winner[0]) for members, n in self.sets if set(members) != set(self.active))
            self.sets = [(tuple(self.active), 0.0), *((members, n) for members, n in distances if n < CLOSE)]

    def _together(self, active: Sequence[int]) -> str:
        """Names of a set."""
        return ", ".join(map(self.name, active)) or "nothing"

    def _believed(self, point: Point, rival: Sequence[int]) -> bool:
        """Whether a set that says more may be named: two new names at once if they leave nothing to explain.

        Where a law is missing that the catalogue lacks, pairs that hide each other take a part of it each.
        """
        new = [j for j in rival if j not in self.active]
        if not all(self._fits_in(point, rival, j) for j in new):
            return False
        left = levels(self.problem, self.nominal, with_floors_noise(self.problem, point, rival), self.least) if len(new) > 1 else ()
        return not any(level.excessive for level in left)

    def _fits_in(self, point: Point, rival: Sequence[int], j: int) -> bool:
        """Whether an effect of a rival set could be named, and is the same in all flights."""
        others = [k for k in rival if k != j]
        same = across_flights(self.point, point, self.priors, others, j, self.least) is None
        return same and self._stands(point, rival, j)


def explain(
    model: Model, *, seed: int = 0, without: Sequence[int] = (), laws: bool = True, progress: Callable[[str], None] | None = None
) -> Diagnosis:
    """Say what the model gets wrong about its flights.

    Args:
        model: a simulation of measured flights with its catalogue of effects.
        seed: of the null worlds that the threshold is calibrated on.
        without: flights to leave out.
        laws: whether to look for laws outside the catalogue where it does not suffice.
        progress: is told each step in a sentence.

    Returns:
        One verdict for every effect, and one overall.

    Raises:
        DiagnoseError: The model gives no window, or contradicts itself.
    """
    begun, say = time.monotonic(), progress or (lambda _: None)
    memory.keep()
    windows = model.windows({})
    if not windows:
        raise DiagnoseError("the model found no stretch of flight to look at in these logs")
    finite = each(lambda w: all(np.all(np.isfinite(a)) for a in (w.residual, w.effects, w.nuisance, w.latent)), windows)
    duplicates = repeated_flights(windows)
    left_out = {*without, *duplicates}
    kept = tuple(i for i, w in enumerate(windows) if finite[i] and w.flight not in left_out)
    if len(kept) < 0.5 * sum(w.flight not in left_out for w in windows) or not kept:
        return out_of_domain(model, windows, sum(finite), seed)
    problem = Problem.of(model, windows, kept)
    priors = problem.priors
    for c, own in problem.correlated.items():
        say(f"noise of {model.channels[c]} is correlated over {1e3 * own.time:.0f} ms, for {own.share:.1%} of its variance")
    nominal = linearise(problem, np.zeros(len(model.effects)), windows=windows)
    for _ in range(LOSSES):
        if not (gone := lost(nominal)):
            break
        problem, nominal = _left_out(problem, nominal, gone, say)
    least = _least(nominal, priors, seed, say)
    search = Search(problem, nominal, least, say, laws)
    search.run()
    for _ in range(LOSSES - 1):
        gone = lost(search.point)  # where the causes are in the simulation, it may lose windows that it followed without
        if not gone or search.events:
            break
        problem, nominal = _left_out(problem, nominal, gone, say)
        least = _least(nominal, priors, seed, say)
        if not search.stands_without(gone, problem, nominal, least):
            search = Search(problem, nominal, least, say, laws)
        search.run()
    diagnosis = held_out.judged(conclude(search, laws=laws), seed)
    return replace(diagnosis, duplicates=duplicates, seconds=time.monotonic() - begun, seed=seed)


def _least(nominal: Point, priors: Priors, seed: int, say: Callable[[str], None]) -> float:
    """The threshold [nats]."""
    least = threshold(nominal.statistics, priors, np.random.default_rng(seed))
    say(f"{len(nominal.windows)} windows of {len(nominal.statistics.flights)} flights; a cause needs {least:.1f} nats")
    return least


def _left_out(
    problem: Problem, nominal: Point, gone: Sequence[int], say: Callable[[str], None]
) -> tuple[Problem, Point]:
    """The problem without some of its windows, and the model as it stands."""
    say(f"{len(gone)} windows are left out, which the simulation does not follow")
    left = [i for i in range(len(problem.kept)) if i not in set(gone)]
    return problem.only(left), only(nominal, left)

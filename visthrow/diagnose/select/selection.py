"""Select the set of candidates that explains the flights best.

One loop treats candidates of every kind: list the sets near the best by the linear statistics
(:mod:`visthrow.diagnose.select.occam`); simulate the most promising ones until the gain of one
exceeds the predicted gain of the next; move to the best, linearise there, and repeat until the best
set stays the same. The results of simulations are kept, as they show by how much a predicted gain
is too high. Terms of laws are offered once no set of other candidates is better.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from visthrow.common.errors import DiagnoseError
from visthrow.diagnose.likelihood.evidence import INEXACT, SPIKE, STRONG
from visthrow.diagnose.likelihood.grammar import TermEffect
from visthrow.diagnose.likelihood.noise_levels import ENOUGH_NATS
from visthrow.diagnose.select import terms
from visthrow.diagnose.select.candidates import (
    ALL,
    NOTHING,
    Names,
    columns_of,
    estimate_shares,
    laws_of,
    list_shared,
    random_shares,
    without_means,
)
from visthrow.diagnose.select.excess import acts_on, compares_phases
from visthrow.diagnose.select.occam import WINDOW, Linear, window
from visthrow.diagnose.select.point import (
    ROUNDS,
    Point,
    Problem,
    candidate,
    curvature,
    fit,
    linearise,
    predicted_gain,
    with_noise_at,
)
from visthrow.diagnose.select.result import SelectionStep

SHORTLIST = 12  # most promising sets that may be simulated
FIRST = 4  # sets that are simulated even if their prediction is up to WINDOW behind the best
REPORTED_SETS = 10  # sets that a step records for the report


@dataclass(frozen=True)
class Trial:
    """A set of candidates that was simulated."""

    chosen: Names
    point: Point
    occam: float = 0.0  # evidence at the best deviations of random shares over the integrated one
    lead: float = 0.0  # value minus that of the best set [nats]

    @cached_property
    def columns(self) -> list[int]:
        """Return the indices of the effects that have one size in all flights."""
        return columns_of(self.chosen)


@dataclass
class Selector:
    """A selection under way, and its result."""

    nominal: Point
    threshold: float  # [nats]
    progress: Callable[[str], None] = lambda _: None
    laws: bool = True  # whether terms of laws are offered
    steps: list[SelectionStep] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.best = Trial(NOTHING, self.nominal)
        self.origin = self.nominal  # where the derivatives were taken
        self.window: list[tuple[Trial, float]] = []  # possible sets, with nats behind the best
        self._linear: dict[Point, Linear] = {}
        self._turned: dict[bytes, Point] = {}  # with other kinds of blocks
        self._visited = {NOTHING}
        self._settled_sets = {NOTHING}  # sets at which derivatives were taken or checked
        self._simulated = {NOTHING: 0.0}  # lead of each simulated set over the best [nats]
        self._proposed: set[Names] = set()
        self._followed: set[Names] = set()
        self._every = False  # whether any effect may vary between flights
        self._offer()

    @property
    def problem(self) -> Problem:
        """Return the problem, with the terms offered so far."""
        return self.nominal.problem

    def _offer(self) -> None:
        problem = self.problem
        flown = self.nominal.plain
        random = random_shares(problem.model.effects, problem.priors, flown, self._every)
        self.candidates = list_shared(problem.effects) + random
        self._linear.clear()

    @cached_property
    def _acting(self) -> list[str]:
        """Return the block on which each effect of the model acts."""
        return acts_on(self.nominal, range(len(self.problem.model.effects)))

    def penalty(self, chosen: Names) -> float:
        """Return the penalty of a set [nats].

        That an effect varies between flights is a second claim beside its existence. An effect in
        the block of a law may be part of the law's form, so its penalty is higher. Without a calm
        phase to compare with, a law excludes all other candidates."""
        total = sum(c.claims * self.threshold + c.penalty for c in without_means(chosen))
        forms = laws_of(chosen)
        if not forms:
            return total
        together = len(forms) == len(chosen) or compares_phases(self.nominal)
        if not together:
            return np.inf
        blocks = terms.acts_in(c.law for c in forms)
        charged = [c for c in chosen if not c.law and self.block_of(c.columns[0]) in blocks]
        return total + len(charged) * terms.LAW

    def block_of(self, j: int) -> str:
        """Return the block on which an effect of the model acts."""
        return self._acting[j]

    def linear(self, point: Point) -> Linear:
        """Return the values of sets by the statistics of a point."""
        problem = self.problem
        if point not in self._linear:
            self._linear[point] = Linear(point.plain, problem.priors, self.candidates, self.penalty)
        return self._linear[point]

    def run(self, begin: Names = NOTHING) -> "Selector":
        """Run the selection, starting from a set."""
        for start in self._try(self.nominal, [begin] if begin else []):
            self._go(start)
        while self._move() or self._relinearise() or self._propose() or self._widen():
            pass
        return self

    def _widen(self) -> bool:
        """Let any effect vary between flights; return False if that was done before.

        It comes last, because the nonlinearity of an effect with one size looks like a variation
        between flights."""
        if self._every:
            return False
        self._every = True
        self._offer()
        return True

    def _move(self) -> bool:
        """Simulate the most promising sets and move to the best; return False if the present set
        stays.
        """
        listed = self._list_sets()
        leads = {}
        least = -np.inf
        near = []  # others are dropped, as a trial's matrices are large
        better = []
        while chosen := self._choose_next(listed, leads, least):
            leads[chosen] = -np.inf
            tried = self._try(self.best.point, [chosen])
            tried += self._try(self.best.point, self._reduce(tried))
            leads |= {t.chosen: t.lead for t in tried}
            possible = [t for t in tried if t.lead > -self._limit(t.chosen)]
            near += [t for t in possible if self.is_admissible(t)]
            better = [t for t in near if t.lead > ENOUGH_NATS and t.chosen not in self._visited]
            if better:
                best = max(t.lead for t in better)
                least = max(best, max(listed.values()) - WINDOW)
        better = better or self._follow_up(listed)
        if not better:
            self._keep(near)
            return False
        top = max(better, key=lambda t: t.lead)
        self._record(top, leads, listed)
        self._go(top)
        return True

    def _keep(self, near: list[Trial]) -> None:
        """Store the possible sets: trials near the best, and sets that were the best before, which
        are simulated again from the point of the best.
        """
        earlier = self._visited - {self.best.chosen}
        known = [s for s in earlier if self._simulated.get(s, -np.inf) > -self._limit(s)]
        again = self._try(self.best.point, known)
        near = near + [t for t in again if t.lead > -self._limit(t.chosen)]
        near.sort(key=lambda t: -t.lead)
        self.window = [(self.best, 0.0), *((t, max(-t.lead, 0.0)) for t in near)]

    def _list_sets(self) -> dict[Names, float]:
        """List sets near the best, with their predicted lead over the present one [nats].

        Leads are predicted from the statistics at the present point, from the same with the noise
        levels for free effects, and, for small sets, from the statistics at the nominal point."""
        present = self.best.chosen
        ahead_of = {}
        free = self.best.point.with_all_effects_noise
        places = [(self.best.point, present), (free, present)]
        places += [(self.nominal, NOTHING)] if present else []
        for point, centre in places:
            linear = self.linear(point)
            close = window(linear, {centre, NOTHING}, centre)
            base = linear.value(present)
            for chosen, value in close.items():
                ahead_of[chosen] = max(ahead_of.get(chosen, -np.inf), value - base)
        self._linear.pop(free)
        ahead_of.pop(present, None)
        return ahead_of

    def _choose_next(
        self, listed: Mapping[Names, float], tried: Mapping[Names, float], minimum: float
    ) -> Names:
        """Return the most promising set to simulate next, if its expected lead exceeds ``minimum``
        [nats] and it may be possible; otherwise NOTHING.

        The prediction of a move is corrected by the largest shortfall of its parts."""
        done = set(tried) | self._visited
        present = self.best.chosen
        shortfalls = {}
        for simulated, nats in self._simulated.items():
            if nats < -WINDOW:
                done.add(simulated)
            if simulated in listed and simulated:  # removing all at once predicts nothing
                shortfalls[simulated ^ present] = listed[simulated] - nats
        expected = {}
        for chosen, promised in listed.items():
            if chosen not in done:
                move = chosen ^ present
                parts = (nats for part, nats in shortfalls.items() if part < move)
                expected[chosen] = promised - max(parts, default=0.0)
        ranked = sorted(expected, key=expected.get, reverse=True)
        alike = [s for s in ranked[SHORTLIST:] if self._limit(s) > STRONG]
        margin = WINDOW if len(tried) < FIRST else STRONG
        for s in ranked[:SHORTLIST] + alike:
            reach = max(min(margin, self._doubt(s)), self._limit(s))
            if expected[s] > max(minimum, -reach):
                return s
        return NOTHING

    def _limit(self, chosen: Names) -> float:
        """Return by how many nats a set may be behind the best and still be possible.

        It is ``STRONG``, and more where one effect is replaced by another of its group: then also a
        part of that effect's evidence."""
        best = self.best
        replaced = best.chosen - chosen
        new = chosen - best.chosen
        effects = self.problem.effects
        groups = {effects[j].alike for c in replaced | new for j in c.columns}
        if len(replaced) != 1 or len(new) != 1 or len(groups) != 1 or "" in groups:
            return STRONG
        nats = best.point.evidence(best.columns)
        nats -= best.point.evidence(columns_of(best.chosen - replaced))
        return min(WINDOW, STRONG + INEXACT * nats)

    def _doubt(self, chosen: Names) -> float:
        """Return by how many nats the predicted value of a set may be wrong: ``STRONG``, and a part
        of the evidence for the change of its sizes.
        """
        point = self.best.point
        change = point.posterior.estimate(columns_of(chosen)) - point.theta
        nats = 0.5 * change @ point.information @ change
        return min(WINDOW, STRONG + INEXACT * nats)

    def _try(self, point: Point, sets: Iterable[Names]) -> list[Trial]:
        """Simulate sets from a point."""
        linear = self.linear(point)
        trials = []
        for s in sets:
            active = columns_of(s)
            sizes, occam = linear.shares(s)
            try:
                begin = replace(self._take_blocks(point, active), shares=sizes)
                trial = Trial(s, candidate(begin, active), occam)
            except DiagnoseError as error:
                self.progress(f"{names_of(s)}: not simulated, {error}")
                continue
            trial = replace(trial, lead=self._value(trial) - self.value)
            # an inadmissible set gains nothing
            nats = trial.lead if self.is_admissible(trial) else min(trial.lead, 0.0)
            self._simulated[s] = max(nats, self._simulated.get(s, -np.inf))
            trials.append(trial)
        return trials

    def _reduce(self, tried: Iterable[Trial]) -> list[Names]:
        """Reduce inadmissible sets that are ahead to their surely present members.

        If a set contains the true effect and one that stood in for it, nothing remains of the
        latter. The derivatives taken with the substitute predict the reduced set badly, so it is
        simulated."""
        reduced = []
        for trial in tried:
            if trial.lead > ENOUGH_NATS and not self.is_admissible(trial):
                sure = {*trial.point.posterior.certainly_nonzero(trial.columns)}
                members = (c for c in trial.chosen if c.group != ALL or sure.issuperset(c.columns))
                reduced.append(frozenset(members))
        return [s for s in reduced if s not in self._simulated]

    def _take_blocks(self, point: Point, active: list[int]) -> Point:
        """Return a point linearised with the kinds of blocks of a set; the last one is kept."""
        kinds = self.problem.switches
        chosen = np.isin(np.arange(len(kinds)), active)
        theta = np.where(chosen, point.theta, 0.0)
        off = kinds & chosen & (theta == 0.0)
        theta[off] = 1.0 / self.problem.priors.floor[off]
        for known in (point, self.nominal):
            if np.array_equal(known.theta[kinds] != 0.0, theta[kinds] != 0.0):
                return known
        if theta.tobytes() not in self._turned:
            self._turned = {theta.tobytes(): self._linearise(theta, point)}
        return self._turned[theta.tobytes()]

    def _value(self, trial: Trial) -> float:
        """Return the value of a simulated set [nats], without the gain that derivatives predict
        beyond the simulated sizes.
        """
        point = trial.point
        evidence = point.evidence(trial.columns)
        promised = predicted_gain(point, trial.columns, switches=True)
        return evidence - promised - trial.occam - self.penalty(trial.chosen)

    def is_admissible(self, trial: Trial) -> bool:
        """Return whether every member of a set is surely not 0 and not negligible, lies within its
        bounds in each flight and, if a term of a law, moves the landing.
        """
        point = trial.point
        columns = trial.columns
        priors = self.problem.priors
        sure = point.posterior.certainty(point.theta, columns)
        if np.any(sure <= 1.0):
            return False
        shares = estimate_shares(point.plain, point.theta, point.shares)
        sizes = point.theta + shares
        outside = (sizes < priors.low - 1.0) | (sizes > priors.high + 1.0)
        if np.any(outside & (sizes != 0.0)):
            return False  # random shares too have the effect's bounds, plus a floor
        laws = [j for j in columns if isinstance(self.problem.effects[j], TermEffect)]
        return all(terms.moves_landing(point, j) for j in laws)

    def _follow_up(self, listed: Mapping[Names, float]) -> list[Trial]:
        """Take the most promising of the sets whose simulation fell far short, linearise at its
        predicted sizes, and simulate it again from there. Return it if it is then better than the
        present set simulated from the same derivatives.

        The initial states of a whipping rope fit only the rope for which they were fitted. Better
        states for the present set alone are no gain."""
        kinds = self.problem.switches
        point = self.best.point
        promising = []
        for s in listed.keys() - self._followed:
            kept = self._simulated.get(s, np.inf)
            if listed[s] > max(0.0, kept + STRONG) and not kinds[columns_of(s)].any():
                promising.append(s)
        chosen = max(promising, key=listed.get, default=NOTHING)
        if not chosen:
            return []
        self._followed.add(chosen)
        active = columns_of(chosen)
        try:
            origin = self._linearise(point.posterior.estimate(active), point)
        except DiagnoseError as error:
            self.progress(f"{names_of(chosen)}: not followed, {error}")
            return []
        trials = {t.chosen: t for t in self._try(origin, [chosen, self.best.chosen])}
        if len(trials) < 2 or not self.is_admissible(trials[chosen]):
            return []
        lead = trials[chosen].lead - max(trials[self.best.chosen].lead, 0.0)
        if lead <= ENOUGH_NATS:
            return []
        self.origin = origin
        return [replace(trials[chosen], lead=lead)]

    def _relinearise(self) -> bool:
        """Linearise at the best set, once no other is better; return False if the derivatives still
        hold. Sets that were judged by other derivatives may then be tried again.
        """
        origin = self.origin
        chosen = self.best.chosen
        if chosen in self._settled_sets:
            return False
        self._settled_sets.add(chosen)
        self._go(replace(self.best, lead=0.0), last=True)
        if self.origin is origin:
            return False
        self._visited = set(self._settled_sets)
        return True

    def _go(self, trial: Trial, last: bool = False) -> None:
        """Make a set the best; ``last``: whether no other is better by the derivatives."""
        self._simulated = {s: nats - trial.lead for s, nats in self._simulated.items()}
        if trial.point.about is self.nominal.about:
            self.origin = self.nominal
        point = self._settle(trial.point, trial.columns, last)
        if point is not trial.point or point.shares:
            shares, occam = self.linear(point).shares(trial.chosen)
            if shares:
                point = with_noise_at(replace(point, shares=shares), point.theta)
            trial = Trial(trial.chosen, point, occam)
        self.best = trial
        self._visited.add(trial.chosen)
        self._linear = {self.nominal: self.linear(self.nominal)}

    def _settle(self, point: Point, active: list[int], last: bool) -> Point:
        """Linearise at a set and fit its sizes again, unless the last derivatives still hold. A
        model that is not cheap is linearised only when no other set is better (``last``).
        """
        kinds = self.problem.switches
        cheap = self.problem.model.cheap
        before = self.origin.theta[kinds] != 0.0
        unchanged = np.array_equal(before, point.theta[kinds] != 0.0)
        silent = self.problem.priors.visible & (np.diag(self.origin.information) <= 0.0)
        if unchanged and not (cheap and np.any(silent)):
            lead_on = not (cheap or last)
            if lead_on or curvature(self.origin, point) < SPIKE:
                return point
        for _ in range(ROUNDS):
            try:
                self.origin = self._linearise(point.theta, point)
            except DiagnoseError as error:
                self.progress(f"the last derivatives stay: {error}")
                break
            before = point
            point = fit(self.origin, active)
            close = np.abs(point.theta - before.theta).max() <= SPIKE
            if close or curvature(self.origin, point) <= SPIKE:
                break
        return point

    def _linearise(self, theta: np.ndarray, like: Point) -> Point:
        return linearise(self.problem, theta, like.noise, shares=like.shares)

    def _record(
        self, top: Trial, leads: Mapping[Names, float], listed: Mapping[Names, float]
    ) -> None:
        """Report the selected set, and record the sets compared with it."""
        nats = {names_of(s): lead for s, lead in leads.items() if np.isfinite(lead)}
        ranked = sorted(listed.items(), key=lambda item: -item[1])[:REPORTED_SETS]
        screened = {names_of(s): float(gain) for s, gain in ranked}
        name = names_of(top.chosen)
        self.progress(f"{name}: {top.lead:.1f} nats better than before")
        self.steps.append(SelectionStep(name, top.lead, screened, nats))

    def _propose(self) -> bool:
        """Offer the most promising terms of laws, beside the set and in place of its effects;
        return False if there is no new one.
        """
        strongest = terms.strongest_forces(self.nominal) if self.laws else {}
        present = self.best.chosen
        forms = frozenset(laws_of(present))
        if not strongest or present in self._proposed:
            return False
        self._proposed.add(present)
        places = [(self.best.point, self.best.columns)]
        places += [(self.nominal, columns_of(forms))] if present - forms else []
        shortlist = []
        for point, active in places:
            shortlist += terms.shortlist(point, active, strongest, self.threshold)
        shortlist = list({effect.term: effect for effect in reversed(shortlist)}.values())
        if not shortlist:
            return False
        points = list(dict.fromkeys((self.nominal, self.origin, self.best.point)))
        widened = dict(zip(points, terms.extend(points, shortlist)))
        self.best = replace(self.best, point=widened[self.best.point])
        self.nominal = widened[self.nominal]
        self.origin = widened[self.origin]
        self._offer()
        return True

    @property
    def value(self) -> float:
        """Return the value of the best set [nats]."""
        return self._value(self.best)

    @property
    def names(self) -> list[int]:
        """Return the indices of the model's effects in the best set."""
        return columns_of(c for c in self.best.chosen if not c.law)


def names_of(chosen: Names) -> str:
    """Return the names of a set, separated by commas."""
    return ", ".join(sorted(c.name for c in chosen)) or "nothing"

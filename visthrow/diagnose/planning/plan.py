"""Ranking of manoeuvres and ground measurements by the evidence expected from them.

Each manoeuvre is simulated with the diagnosed model. Its expected information, or that of a
measurement on the ground, is added to the information of the flights so far. For two members of a
class, the expected gain is the expected difference of their evidence, with either as the truth; the
smaller one counts."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy import ndarray

from visthrow.common.errors import DiagnoseError, expect_known
from visthrow.diagnose.inputs.measures import MEASUREMENTS, Measurement
from visthrow.diagnose.likelihood.evidence import FEWEST, STRONG, Posterior
from visthrow.diagnose.likelihood.integrals import Integrals
from visthrow.diagnose.likelihood.marginal import Noise, correlate_all, grams_of
from visthrow.diagnose.models.model_interface import LATENT_BLOCKS, Model
from visthrow.diagnose.planning.manoeuvres import Manoeuvre
from visthrow.diagnose.select import result
from visthrow.diagnose.select.held_out import count_telling
from visthrow.diagnose.select.result import Diagnosis

DECISIVE = 11.0
"""Expected nats that separate two members of a class.

The actual nats have twice their mean as variance, so that they exceed the 3 nats of a class in 95 %
of flights."""

# ratio of an effect's standard deviation to its prior's, below which a typical size is selected
NAMEABLE = 0.2

MOST_REPEATS = 10


@dataclass(frozen=True)
class FlightProposal:
    """A manoeuvre or a measurement on the ground, with the evidence expected from it."""

    name: str
    purpose: str
    seconds: float
    # expected nats between the pair hardest to separate, or the mean log ratio by which standard
    # deviations shrink
    nats: float
    separates: tuple[tuple[str, ...], ...]  # pairs beyond DECISIVE after ``repeats`` flights
    # fewest flights that separate the most, see :meth:`PlanningGoal.settled`; 0 if even
    # MOST_REPEATS separate nothing
    repeats: int
    limits: str
    reference: str = ""  # file of its reference


class PlanningGoal:
    """The effects to separate or to estimate, and the gain from a flight's information for them."""

    def __init__(self, diagnosis: Diagnosis, names: Sequence[str] = ()):
        """Plan for classes; without classes, for the named effects, else for effects that are not
        identifiable, else for all visible effects but switches.

        ``names``: effects to plan for; empty for all. Raises DiagnoseError: the diagnosis does not
        know an effect."""
        work = diagnosis.work
        effects = work.problem.model.effects
        self.diagnosis = diagnosis
        self.base = work.after
        self.priors = work.problem.priors
        self.names = [e.name for e in effects]
        expect_known(names, self.names, "no effect '{}' in this diagnosis", DiagnoseError)
        number = self.names.index
        self.pairs = []
        for f in diagnosis.findings:
            for partner in f.partners if f.verdict == result.CLASS else ():
                asked = not names or f.name in names or partner in names
                if asked and f.name in diagnosis.theta:
                    self.pairs.append((number(f.name), number(partner)))
        unclear = [f.name for f in diagnosis.findings if f.verdict == result.NOT_IDENTIFIABLE]
        graded = [
            e.name for e, visible in zip(effects, self.priors.visible) if visible and not e.switch
        ]
        self.vague = [] if self.pairs else [number(name) for name in names or unclear or graded]

    def information(self, model: Model) -> ndarray:
        """Return the expected information of one simulated flight on the diagnosis' effects, in
        floors, shape (K, K); 0 for effects that the flight's model does not have.
        """
        theta = self.diagnosis.theta
        noise = self.base.noise
        flown = [e.name for e in model.effects]
        windows = model.windows({name: size for name, size in theta.items() if name in flown})
        floors = np.array([e.floor for e in model.effects])
        channels = len(model.channels)
        grams = grams_of(windows, floors, channels)
        grams = correlate_all(grams, windows, noise.correlation_time)
        expected = replace(
            noise,
            scale=np.ones(channels),
            latent_sd=_expect_levels(noise, {w.phase for w in windows}),
            share=np.ones((len(windows), len(LATENT_BLOCKS))),
        )
        flown_theta = np.zeros(len(floors))
        information = Integrals(grams, expected).statistics(grams, flown_theta).information.sum(0)
        # effects are matched by name; each catalogue has floors of its own
        same = np.array(self.names)[:, None] == flown
        places = same * self.priors.floor[:, None] / floors
        return places @ information @ places.T

    def nats(self, new: ndarray) -> float:
        """Return the expected nats between the pair hardest to separate, or the mean log ratio by
        which the effects' standard deviations shrink.
        """
        if self.pairs:
            return min(self._gap(pair, new) for pair in self.pairs)
        return np.log(self._deviations(0.0 * new) / self._deviations(new)).mean()

    def settle(self, new: ndarray) -> tuple[list[tuple[int, ...]], int]:
        """Return the pairs separated, or the effects measured well enough, by the fewest flights
        that settle most of them; and the number of these flights.
        """
        most = []
        repeats = 0
        for count in range(1, MOST_REPEATS + 1):
            settled = self._settle_by(new, count)
            if len(settled) > len(most):
                most = settled
                repeats = count
        return most, repeats

    def _settle_by(self, new: ndarray, count: int) -> list[tuple[int, ...]]:
        """Return the pairs that ``count`` flights separate, or the effects that they measure well
        enough to select.
        """
        if self.pairs:
            return [pair for pair in self.pairs if self._gap(pair, count * new) > DECISIVE]
        able = self.priors.slab[self.vague] * NAMEABLE
        unknown = self._deviations(0.0 * new) > able
        known = self._deviations(count * new) < able
        # an effect needs at least FEWEST informative flights to be confirmed
        at_hand = self.base.statistics.information[:, self.vague, self.vague]
        flown = np.tile(new[self.vague, self.vague], (count, 1))
        promised = 0.5 * np.vstack((at_hand, flown)) * self.priors.slab[self.vague] ** 2
        confirmed = count_telling(promised) >= FEWEST
        return [(j,) for j in np.compress(unknown & known & confirmed, self.vague)]

    def _gap(self, pair: tuple[int, int], new: ndarray) -> float:
        """Return the expected nats between two members after the new flight: the smaller one of
        those with either member as the truth.

        A member that is already more than ``STRONG`` nats behind is not considered as the truth.
        """
        base = self.base.posterior
        priors = self.priors
        gaps = []
        remaining = [j for j in self.diagnosis.work.active if j not in pair]
        evidence = {j: base.log_evidence([*remaining, j]) for j in pair}
        for truth, rival in (pair, pair[::-1]):
            if evidence[truth] < evidence[rival] - STRONG:
                continue
            theta = np.zeros(len(priors.floor))
            for j in [*remaining, truth]:
                theta[j] = self.diagnosis.findings[j].estimate / priors.floor[j]
            after = Posterior(base.information + new, base.score + new @ theta, priors)
            right = after.log_evidence([*remaining, truth])
            wrong = after.log_evidence([*remaining, rival])
            gaps.append(right - wrong)
        return min(gaps)

    def _deviations(self, new: ndarray) -> ndarray:
        """Return the posterior standard deviation of each effect to plan for, if it were selected,
        with additional information, in floors.
        """
        base = self.base.posterior
        after = replace(base, information=base.information + new)
        deviations = []
        for j in self.vague:
            variance = after.covariance([*self.diagnosis.work.active, j])[j, j]
            deviations.append(np.sqrt(variance))
        return np.array(deviations)

    def measurements(self) -> list[tuple[Measurement, ndarray]]:
        """Return the ground measurements of effects in classes, with the information of each."""
        promised = []
        for m in MEASUREMENTS:
            if any(m.effect in (self.names[a], self.names[b]) for a, b in self.pairs):
                j = self.names.index(m.effect)
                information = np.zeros_like(self.base.information)
                information[j, j] = (self.priors.floor[j] / m.sd) ** 2
                promised.append((m, information))
        return promised

    def proposal(self, flight: Manoeuvre | Measurement, new: ndarray) -> FlightProposal:
        """Return the proposal of a manoeuvre or a measurement with this information."""
        separated, repeats = self.settle(new)
        separates = [tuple(self.names[j] for j in group) for group in separated]
        return FlightProposal(
            flight.name,
            flight.purpose,
            flight.seconds,
            nats=self.nats(new),
            separates=tuple(separates),
            repeats=repeats,
            limits=flight.limits(),
            reference=flight.file,
        )


def propose(
    aim: PlanningGoal, informed: Sequence[tuple[Manoeuvre, ndarray]]
) -> list[FlightProposal]:
    """Rank manoeuvres and measurements, best first.

    ``informed``: manoeuvres to choose from, with the expected information of each."""
    promised = [*informed, *aim.measurements()]
    return sorted((aim.proposal(*each) for each in promised), key=_worth, reverse=True)


def session(proposals: Sequence[FlightProposal]) -> tuple[FlightProposal, ...]:
    """Return the flights of one session: each ranked proposal that separates a pair or effect which
    none before it does.
    """
    chosen = []
    separated = set()
    for p in proposals:
        if new := set(p.separates) - separated:
            chosen.append(p)
            separated |= new
    return tuple(chosen)


def _worth(p: FlightProposal) -> tuple[float, float]:
    """Return the sort key of a proposal: the number of pairs or effects that it settles, then its
    nats, each over the square root of the time that it takes.
    """
    settles = len(p.separates) / np.sqrt(p.seconds * max(p.repeats, 1))
    return settles, p.nats / np.sqrt(p.seconds)


def _expect_levels(noise: Noise, phases: set[str]) -> dict[tuple[int, str], float]:
    """Return the expected standard deviation of the latent forces by block and phase; for a phase
    that was not flown, that of the block's strongest phase.
    """
    loudest = defaultdict(float)
    for (block, _), level in noise.latent_sd.items():
        loudest[block] = max(level, loudest[block])
    # a payload that has not been flown gets the level of the vehicle [N]
    default = loudest.get(0, 1.0)
    levels = {}
    for block, phase in product(range(len(LATENT_BLOCKS)), phases):
        usual = loudest.get(block, default)
        levels[block, phase] = noise.latent_sd.get((block, phase), usual)
    return levels

"""Which flight to fly next: the manoeuvre that separates what these flights could not, with the
evidence it promises.

Each manoeuvre is simulated with the model as found; its expected information, or that of a
measurement on the ground, is added to that at hand. For two members of a class the promise is the
expected gap of their evidence with either as the truth, the smaller of both."""

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
from visthrow.diagnose.likelihood.marginal import Noise, correlated_of, grams_of
from visthrow.diagnose.models.model_interface import LATENT_BLOCKS, Model
from visthrow.diagnose.planning.manoeuvres import Manoeuvre
from visthrow.diagnose.select import result
from visthrow.diagnose.select.held_out import count_telling
from visthrow.diagnose.select.result import Diagnosis

DECISIVE = 11.0
"""Expected nats that tell two members of a class apart: those that come scatter with twice their
mean as variance, and exceed the 3 nats of a class in 95 % of flights.
"""

# deviation of an effect, in that of its prior, from which on its usual size is named
NAMEABLE = 0.2

MOST_REPEATS = 10


@dataclass(frozen=True)
class FlightProposal:
    """One manoeuvre, or one measurement on the ground, and what it promises."""

    name: str
    purpose: str
    seconds: float
    # of the pair that is hardest to separate, or the logarithm by which a deviation shrinks
    nats: float
    separates: tuple[tuple[str, ...], ...]  # pairs beyond DECISIVE after ``repeats`` flights
    # flights until the hardest pair is beyond DECISIVE; 0 where MOST_REPEATS do not suffice
    repeats: int
    limits: str
    reference: str = ""  # file of its reference


class PlanningGoal:
    """The question that the flights to come are to settle, and the worth of one flight's
    information for it.
    """

    def __init__(self, diagnosis: Diagnosis, names: Sequence[str] = ()):
        """Take the classes to be separated, or else what could not be identified, or else every
        effect that can be seen.

        ``names``: names of the effects to plan for; empty for all. Raises DiagnoseError: an effect
        that the diagnosis does not know."""
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
        """Return the expected information of one simulated flight about the diagnosis' effects, in
        its floors, shape (K, K); 0 for what it hides.
        """
        theta = self.diagnosis.theta
        noise = self.base.noise
        flown = [e.name for e in model.effects]
        windows = model.windows({name: size for name, size in theta.items() if name in flown})
        floors = np.array([e.floor for e in model.effects])
        channels = len(model.channels)
        grams = grams_of(windows, floors, channels)
        grams = correlated_of(grams, windows, noise.correlation_time)
        expected = replace(
            noise,
            scale=np.ones(channels),
            latent_sd=_expect_levels(noise, {w.phase for w in windows}),
            share=np.ones((len(windows), len(LATENT_BLOCKS))),
        )
        flown_theta = np.zeros(len(floors))
        information = Integrals(grams, expected).statistics(grams, flown_theta).information.sum(0)
        # both catalogues name the same effects, each in floors of its own
        same = np.array(self.names)[:, None] == flown
        places = same * self.priors.floor[:, None] / floors
        return places @ information @ places.T

    def nats(self, new: ndarray) -> float:
        """Expected nats between the members of the pair that is hardest, or the mean logarithm by
        which deviations shrink.
        """
        if self.pairs:
            return min(self._gap(pair, new) for pair in self.pairs)
        return np.log(self._deviations(0.0 * new) / self._deviations(new)).mean()

    def settled(self, new: ndarray) -> tuple[list[tuple[int, ...]], int]:
        """Pairs apart, or effects that can be named, after the fewest flights that settle the most;
        and the number of these.
        """
        most = []
        repeats = 0
        for count in range(1, MOST_REPEATS + 1):
            settled = self._settled_by(new, count)
            if len(settled) > len(most):
                most = settled
                repeats = count
        return most, repeats

    def _settled_by(self, new: ndarray, count: int) -> list[tuple[int, ...]]:
        """Return the pairs that so many flights separate, or the effects that they measure well
        enough to name.
        """
        if self.pairs:
            return [pair for pair in self.pairs if self._gap(pair, count * new) > DECISIVE]
        able = self.priors.slab[self.vague] * NAMEABLE
        unknown = self._deviations(0.0 * new) > able
        known = self._deviations(count * new) < able
        # a name counts as confirmed once so many flights bear on it
        at_hand = self.base.statistics.information[:, self.vague, self.vague]
        flown = np.tile(new[self.vague, self.vague], (count, 1))
        promised = 0.5 * np.vstack((at_hand, flown)) * self.priors.slab[self.vague] ** 2
        confirmed = count_telling(promised) >= FEWEST
        return [(j,) for j in np.compress(unknown & known & confirmed, self.vague)]

    def _gap(self, pair: tuple[int, int], new: ndarray) -> float:
        """Expected nats between two members after the new flight, with either as the truth; the
        smaller one.

        A member that is already behind by more than a class allows is no truth to plan for.
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
        """Posterior deviation of each effect that is planned for, if it were named, with more
        information.
        """
        base = self.base.posterior
        after = replace(base, information=base.information + new)
        deviations = []
        for j in self.vague:
            variance = after.covariance([*self.diagnosis.work.active, j])[j, j]
            deviations.append(np.sqrt(variance))
        return np.array(deviations)

    def measurements(self) -> list[tuple[Measurement, ndarray]]:
        """Return the measurements on the ground of members of classes, with the information of
        each.
        """
        promised = []
        for m in MEASUREMENTS:
            if any(m.effect in (self.names[a], self.names[b]) for a, b in self.pairs):
                j = self.names.index(m.effect)
                information = np.zeros_like(self.base.information)
                information[j, j] = (self.priors.floor[j] / m.sd) ** 2
                promised.append((m, information))
        return promised

    def proposal(self, flight: Manoeuvre | Measurement, new: ndarray) -> FlightProposal:
        """Return the promise of a manoeuvre, or of a measurement, of this information."""
        separated, repeats = self.settled(new)
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
    """Rank manoeuvres and measurements, best first; ``informed``: manoeuvres to choose among, and
    the expected information of each.
    """
    promised = [*informed, *aim.measurements()]
    return sorted((aim.proposal(*each) for each in promised), key=_worth, reverse=True)


def session(proposals: Sequence[FlightProposal]) -> tuple[FlightProposal, ...]:
    """Return the flights of one session: of ranked proposals, each that separates what none before
    it does.
    """
    chosen = []
    separated = set()
    for p in proposals:
        if new := set(p.separates) - separated:
            chosen.append(p)
            separated |= new
    return tuple(chosen)


def _worth(p: FlightProposal) -> tuple[float, float]:
    """Return the sort key of a proposal: settling most comes first, soonest; one that settles
    nothing counts by its nats a second.
    """
    settles = len(p.separates) / np.sqrt(p.seconds * max(p.repeats, 1))
    return settles, p.nats / np.sqrt(p.seconds)


def _expect_levels(noise: Noise, phases: set[str]) -> dict[tuple[int, str], float]:
    """Return the latent forces of each block in each phase: where none were flown, those of the
    block's roughest phase.
    """
    loudest = defaultdict(float)
    for (block, _), level in noise.latent_sd.items():
        loudest[block] = max(level, loudest[block])
    # of a payload that has not been flown: as strongly as the vehicle [N]
    default = loudest.get(0, 1.0)
    levels = {}
    for block, phase in product(range(len(LATENT_BLOCKS)), phases):
        usual = loudest.get(block, default)
        levels[block, phase] = noise.latent_sd.get((block, phase), usual)
    return levels

"""Which flight to fly next: the manoeuvre that separates what these flights could not, with the
evidence it promises.

Each manoeuvre is simulated with the model as found; its expected information is added to that at
hand. For two members of a class the promise is the expected gap of their evidence with either as
the truth, the smaller of both."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visthrow.common.errors import DiagnoseError, expect_known
from visthrow.diagnose.inputs.measures import MEASUREMENTS, Measurement, narrowed
from visthrow.diagnose.likelihood.evidence import STRONG, Priors, covariance, log_evidence
from visthrow.diagnose.likelihood.marginal import Noise, correlated, gram_of
from visthrow.diagnose.likelihood.stack import integrals
from visthrow.diagnose.models.interface import LATENT_BLOCKS, Model
from visthrow.diagnose.planning.manoeuvres import Manoeuvre
from visthrow.diagnose.select import result
from visthrow.diagnose.select.result import Diagnosis

DECISIVE = 11.0
"""Expected nats that tell two members of a class apart: those that come scatter with twice their
mean as variance, and exceed the 3 nats of a class in 95 % of flights.
"""

NAMEABLE = (
    0.2  # deviation of an effect, in that of its prior, from which on its usual size is named
)

MOST_REPEATS = 10


@dataclass(frozen=True)
class Proposal:
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


class Aim:
    """The question that the flights to come are to settle, and the worth of one flight's
    information for it.
    """

    def __init__(self, diagnosis: Diagnosis, about: Sequence[str] = ()) -> None:
        """Take the classes to be separated, or else what could not be identified, or else every
        effect that can be seen.

        ``about``: names of the effects to plan for; empty for all. Raises DiagnoseError: an effect
        that the diagnosis does not know."""
        work = diagnosis.work
        self.diagnosis, self.base, self.priors = diagnosis, work.after, work.problem.priors
        self.names = [e.name for e in work.problem.model.effects]
        expect_known(about, self.names, "no effect '{}' in this diagnosis", DiagnoseError)
        number = self.names.index
        classes = [
            f for f in diagnosis.findings if f.verdict == result.CLASS and f.name in diagnosis.theta
        ]
        self.pairs = [
            (number(f.name), number(other))
            for f in classes
            for other in f.partners
            if not about or {f.name, other} & set(about)
        ]
        unclear = [f.name for f in diagnosis.findings if f.verdict == result.NOT_IDENTIFIABLE]
        graded = [
            e.name
            for e, seen in zip(work.problem.model.effects, self.priors.visible)
            if seen and not e.switch
        ]
        self.vague = [] if self.pairs else [number(name) for name in about or unclear or graded]

    def information(self, model: Model) -> np.ndarray:
        """Expected information of one simulated flight."""
        return expected_information(
            model, self.diagnosis.theta, self.base.noise, self.names, self.priors
        )

    def nats(self, new: np.ndarray) -> float:
        """Expected nats between the members of the pair that is hardest, or the mean logarithm by
        which deviations shrink.
        """
        if self.pairs:
            return min(self._gap(pair, new) for pair in self.pairs)
        return float(np.mean(np.log(self._deviations(0.0 * new) / self._deviations(new))))

    def settled(self, new: np.ndarray) -> tuple[list[tuple[int, ...]], int]:
        """Pairs apart, or effects that can be named, after the fewest flights that settle the most;
        and the number of these.
        """
        if self.pairs:
            return _most(
                lambda count: [
                    pair for pair in self.pairs if self._gap(pair, count * new) > DECISIVE
                ],
                len(self.pairs),
            )
        able = np.array([self.priors.slab[j] for j in self.vague]) * NAMEABLE
        unknown = able < self._deviations(0.0 * new)
        return _most(
            lambda count: [
                (j,)
                for j, shows in zip(self.vague, unknown & (self._deviations(count * new) < able))
                if shows
            ],
            len(self.vague),
        )

    def _gap(self, pair: tuple[int, int], new: np.ndarray) -> float:
        """Expected nats between two members after the new flight, with either as the truth; the
        smaller one.

        A member that is already behind by more than a class allows is no truth to plan for.
        """
        information, score, priors, gaps = self.base.information, self.base.score, self.priors, []
        rest = [j for j in self.diagnosis.work.active if j not in pair]
        now = {j: log_evidence(information, score, priors, [*rest, j]) for j in pair}
        for truth, other in (pair, pair[::-1]):
            if now[truth] < now[other] - STRONG:
                continue
            theta = np.zeros(len(priors.floor))
            for j in [*rest, truth]:
                theta[j] = self.diagnosis.findings[j].estimate / priors.floor[j]
            after, total = score + new @ theta, information + new
            gaps.append(
                log_evidence(total, after, priors, [*rest, truth])
                - log_evidence(total, after, priors, [*rest, other])
            )
        return float(min(gaps))

    def _deviations(self, new: np.ndarray) -> np.ndarray:
        """Posterior deviation of each effect that is planned for, if it were named, with more
        information.
        """
        total, active = self.base.information + new, self.diagnosis.work.active
        return np.array(
            [
                np.sqrt(covariance(total, self.priors.deviation([*active, j]))[j, j])
                for j in self.vague
            ]
        )

    def proposal(self, manoeuvre: Manoeuvre, new: np.ndarray) -> Proposal:
        """Return the promise of a manoeuvre of this information."""
        separated, repeats = self.settled(new)
        separates = tuple(tuple(self.names[j] for j in group) for group in separated)
        return Proposal(
            manoeuvre.name,
            manoeuvre.purpose,
            manoeuvre.seconds,
            self.nats(new),
            separates,
            repeats,
            manoeuvre.reference().limits(),
            manoeuvre.file,
        )


def propose(aim: Aim, told: Sequence[tuple[Manoeuvre, np.ndarray]]) -> list[Proposal]:
    """Rank manoeuvres and measurements, best first; ``told``: manoeuvres to choose among, and the
    expected information of each.
    """
    return sorted(
        [*(aim.proposal(*each) for each in told), *_measured(aim)], key=_worth, reverse=True
    )


def session(proposals: Sequence[Proposal]) -> tuple[Proposal, ...]:
    """Return the flights of one session: of ranked proposals, each that separates what none before
    it does.
    """
    chosen, apart = [], set()
    for p in proposals:
        if new := set(p.separates) - apart:
            chosen.append(p)
            apart |= new
    return tuple(chosen)


def _worth(p: Proposal) -> tuple[float, float]:
    """Return the sort key of a proposal: settling most comes first, soonest; one that settles
    nothing counts by its nats a second.
    """
    return len(p.separates) / np.sqrt(p.seconds * max(p.repeats, 1)), p.nats / np.sqrt(p.seconds)


def _measured(aim: Aim) -> list[Proposal]:
    """Measurements on the ground that settle members of classes."""
    diagnosis, names, pairs = aim.diagnosis, aim.names, aim.pairs
    findings = {f.name: f for f in diagnosis.findings}
    out = []
    for m in MEASUREMENTS:
        own = [(a, b) for a, b in pairs if m.effect in (names[a], names[b])]
        if not own:
            continue
        j = names.index(m.effect)
        seen = (
            0.5 * (findings[m.effect].estimate / m.sd) ** 2
        )  # if it is the cause, the measurement shows it
        gaps = [min(seen, _denied(diagnosis, j, a + b - j, m)) for a, b in own]
        apart = tuple((names[a], names[b]) for (a, b), gap in zip(own, gaps) if gap > DECISIVE)
        out.append(
            Proposal(
                m.name, f"settles {m.effect}", m.seconds, min(gaps), apart, int(bool(apart)), ""
            )
        )
    return out


def _denied(diagnosis: Diagnosis, j: int, truth: int, m: Measurement) -> float:
    """Nats by which the other member is ahead once the measurement has found the configured value
    right.
    """
    work = diagnosis.work
    problem = work.problem
    known = Priors.of(
        narrowed(problem.model.effects, {m.effect: m.sd}), tuple(problem.model.channels)
    )
    rest = [k for k in work.active if k not in (j, truth)]
    sets = ([*rest, truth], [*rest, j])
    ahead, behind = (log_evidence(work.after.information, work.after.score, known, s) for s in sets)
    return ahead - behind


def expected_information(
    model: Model, theta: Mapping[str, float], noise: Noise, names: Sequence[str], priors: Priors
) -> np.ndarray:
    """Information of simulated flights about the diagnosis' effects, in its floors, shape (K, K); 0
    for what they hide.
    """
    known = {e.name for e in model.effects}
    windows = model.windows({name: value for name, value in theta.items() if name in known})
    floors = np.array([e.floor for e in model.effects])
    at = np.array([names.index(e.name) for e in model.effects if e.name in names])
    own = np.array([i for i, e in enumerate(model.effects) if e.name in names])
    total = np.zeros((len(names), len(names)))
    loudest = {
        block: max(v for (b, _), v in noise.latent_sd.items() if b == block)
        for block, _ in noise.latent_sd
    }
    pushed = loudest.get(
        0, 1.0
    )  # of a payload that has not been flown: as strongly as the vehicle [N]
    for window in windows:
        gram = correlated(
            gram_of(window, floors, len(model.channels)), window, noise.correlation_time
        )
        levels = {
            (int(b), window.phase): noise.latent_sd.get(
                (int(b), window.phase), loudest.get(int(b), pushed)
            )
            for b in np.unique(gram.latent_block)
        }
        alike = np.ones((1, len(LATENT_BLOCKS)))
        expected = replace(noise, scale=np.ones(len(model.channels)), latent_sd=levels, share=alike)
        part = integrals([gram], expected).shares([gram], expected)[0].information
        total[np.ix_(at, at)] += part[np.ix_(own, own)]
    floor = {
        e.name: e.floor for e in model.effects
    }  # both catalogues name the same effect, the floors may differ
    ratio = np.array(
        [priors.floor[i] / floor[name] if name in floor else 1.0 for i, name in enumerate(names)]
    )
    return total * np.outer(ratio, ratio)


def _most(settled: Callable[[int], list], all_of_them: int) -> tuple[list, int]:
    """Return the most that the fewest flights settle, and their number."""
    best: tuple[list, int] = [], 0
    for count in range(1, MOST_REPEATS + 1):
        now = settled(count)
        if len(now) > len(best[0]):
            best = now, count
        if len(best[0]) == all_of_them:
            break
    return best

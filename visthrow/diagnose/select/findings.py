"""Verdicts on single effects: found, one of a class, bounded, or not observable."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from visthrow.diagnose.likelihood.evidence import MODEL_ERROR_FLOOR, NORMAL_95, POSSIBLE, Sets
from visthrow.diagnose.models.model_interface import Effect, Indices
from visthrow.diagnose.select import result
from visthrow.diagnose.select.candidates import find_tolerance, unit_suffix
from visthrow.diagnose.select.point import Point
from visthrow.diagnose.select.result import Finding

BIT = 0.5
"""If the posterior deviation of an effect exceeds this share of its prior's, the flights carry less
than one bit of information about it.
"""


def blank(effect: Effect) -> Finding:
    """Return the finding on an effect without any flight."""
    return Finding(
        effect.name,
        result.UNOBSERVABLE,
        effect.block,
        effect.cause,
        effect.equation,
        effect.unit,
        0.0,
        effect.prior_sd,
        *effect.bounds,
        effect.floor,
        0.0,
        manoeuvres=tuple(effect.manoeuvres),
    )


def _unobservable(effect: Effect, channels: Sequence[str]) -> Finding:
    """Return the finding on an effect whose channels are missing."""
    missing = tuple(c for c in effect.channels if c not in channels)
    sentence = f"{effect.name}: not observable without {', '.join(missing)}."
    return replace(blank(effect), missing=missing, sentence=sentence)


@dataclass(frozen=True)
class Reading:
    """The flights' information and the possible sets, from which each verdict follows."""

    point: Point  # with random shares integrated out
    active: Indices  # selected effects
    withdrawn: set[int]  # effects that were selected, but do not have the right form
    sets: Sets  # possible sets with the random shares of the best one
    all_sets: Sets  # all possible sets, including their effects that vary between flights
    unlike: float  # variance between flights, relative to the tolerated one

    def finding(self, j: int) -> Finding:
        """Return the verdict on an effect."""
        problem = self.point.problem
        point = self.point
        priors = problem.priors
        effect = problem.effects[j]
        if not priors.visible[j]:
            return _unobservable(effect, problem.model.channels)
        partners, together = self._class_of(j)
        remaining = [k for k in together if k != j]
        homes = [home for home in self.sets if j in home[0]] if self.active else []
        homes = homes or [((*remaining, j), 0.0)]
        mean, sd = point.posterior.average(j, homes)
        deviation = float(np.hypot(sd, MODEL_ERROR_FLOOR)) * effect.floor
        nats = point.evidence([*remaining, j]) - point.evidence(remaining)
        finding = replace(blank(effect), sd=deviation, nats=nats)
        if j in self.active or partners:
            differs = float(np.sqrt(self.unlike)) * find_tolerance(mean) * effect.floor
            named = replace(finding, differs=differs)
            return self._judge_named(named, mean, sorted({j, *partners}))
        size = mean * effect.floor
        reach = NORMAL_95 * deviation
        ends = np.clip([size - reach, size + reach], *effect.bounds)
        low, high = (ends + 0.0).tolist()  # no -0
        finding = replace(finding, low=low, high=high)
        if j in self.withdrawn:
            text = f"{effect.name}: explains a part of the error, but not its form; withdrawn."
            return replace(finding, verdict=result.NOT_IDENTIFIABLE, sentence=text)
        unit = unit_suffix(effect.unit)
        if sd > BIT * priors.slab[j]:
            text = (
                f"{effect.name}: these flights hardly add to the prior ({deviation:.2g} of"
                f" {effect.prior_sd:.2g}{unit})."
            )
            return replace(finding, verdict=result.NOT_IDENTIFIABLE, sentence=text)
        finding = result.bound(finding)
        if low < high:
            return finding
        comparison = "less" if size < low else "more"
        text = (
            f"{effect.name}: on its bound of {low:.3g}{unit}; these flights would need {comparison}"
            " than is possible."
        )
        return replace(finding, sentence=text)

    def _class_of(self, j: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the partners of an effect in its class, and the set that contains it: the best
        one, or another that explains the flights as well.

        A class consists of a selected effect and the additional effects of sets without it.
        """
        active = self.active
        for home in active:
            rivals = self._rivals(home)
            others = {*active, *self.withdrawn} - {home}
            partners = {home}.union(*rivals) - others
            if j in partners and len(partners) > 1:
                together = active if j == home else next(m for m in rivals if j in m)
                return tuple(sorted(partners - {j})), tuple(together)
        return (), tuple(active)

    def _rivals(self, home: int) -> list[tuple[int, ...]]:
        """Return the sets without an effect, except those of which a subset is likelier.

        Source: Madigan and Raftery 1994, the second principle of Occam's window.
        """
        without = [(members, nats) for members, nats in self.sets if home not in members]
        rivals = []
        for members, nats in without:
            parts = [of_part for part, of_part in without if {*part} < {*members}]
            if nats < min(parts, default=np.inf):
                rivals.append(members)
        return rivals

    def _odds_of_none(self, members: Indices) -> float:
        """Return the odds of the possible sets without any of these effects against those with
        one.
        """
        with_one = 0.0
        without = 0.0
        for effects, nats in self.all_sets:
            weight = np.exp(-nats)
            if {*members}.isdisjoint(effects):
                without += weight
            else:
                with_one += weight
        return without / with_one

    def _judge_named(self, finding: Finding, mean: float, members: list[int]) -> Finding:
        """Return the verdict on a selected effect; ``mean``: in floors; ``members``: of its
        class.
        """
        bounds = finding.low, finding.high
        size = float(np.clip(mean * finding.floor, *bounds)) + 0.0  # no -0
        reach = NORMAL_95 * finding.sd
        low = max(bounds[0], size - reach) + 0.0
        high = min(bounds[1], size + reach) + 0.0
        finding = replace(finding, estimate=size, low=low, high=high)
        text = f"{size:.3g} ± {finding.sd:.2g}{unit_suffix(finding.unit)}"
        if low <= 0.0 <= high:
            sentence = f"{finding.cause}: {finding.name} = {text}; the interval contains 0."
            return replace(finding, verdict=result.CANDIDATE, sentence=sentence)
        names = [self.point.problem.effects[k].name for k in members]
        partners = tuple(name for name in names if name != finding.name)
        odds = self._odds_of_none(members)
        if odds > POSSIBLE:
            which = " or ".join((finding.name, *partners))
            sentence = (
                f"{finding.cause}: {finding.name} = {text} if present; sets of causes without"
                f" {which} explain these flights nearly as well (odds {odds:.2g})."
            )
            finding = replace(finding, partners=partners)
            return replace(finding, verdict=result.CANDIDATE, sentence=sentence)
        if len(members) < 2:
            digits = 0 if finding.nats >= 10.0 else 1
            sentence = (
                f"{finding.cause}: {finding.name} = {text} (95 %: {low:.3g} to {high:.3g}),"
                f" {finding.nats:.{digits}f} nats; expected standard deviation between flights"
                f" {finding.differs:.2g}."
            )
            return replace(finding, verdict=result.FOUND, sentence=sentence)
        joint = self._joint(members)
        sentence = (
            f"{finding.cause}: {finding.name} = {text} if it is the cause; these flights cannot"
            f" tell it from {', '.join(partners)}. Only this combination is determined: {joint}."
        )
        finding = replace(finding, partners=partners, joint=joint)
        return replace(finding, verdict=result.CLASS, sentence=sentence)

    def _joint(self, members: list[int]) -> str:
        """Describe the best determined combination of a class: the first eigenvector of its
        members' information, in units of prior deviations.
        """
        posterior = self.point.posterior
        problem = self.point.problem
        effects = [problem.effects[k] for k in members]
        slab = problem.priors.slab[members]
        named = [k for k in self.active if k not in members]
        sigma = posterior.covariance([*members, *named])[members]
        precision = np.linalg.inv(sigma[:, members])
        gained = precision * np.outer(slab, slab) - np.eye(len(slab))
        values, vectors = np.linalg.eigh(gained)
        best = vectors[:, -1]
        value = values[-1]
        score = precision @ (sigma @ posterior.score)
        mean = best @ (slab * score) / value
        coefficients = best / slab / problem.priors.floor[members]
        first = np.abs(best).argmax()
        scale = coefficients[first]
        unit = effects[first].unit
        text = effects[first].name
        for i, effect in enumerate(effects):
            if i != first:
                share = coefficients[i] / scale
                sign = "+" if share > 0 else "-"
                text += f" {sign} {abs(share):.3g} {unit}/({effect.unit}) {effect.name}"
        sd = 1.0 / np.sqrt(max(value, 1e-300)) / abs(scale)
        return f"{text} = {mean / scale:.4g} ± {sd:.2g}{unit_suffix(unit)}"

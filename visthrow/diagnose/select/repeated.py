"""Laws outside the catalogue that flights repeat which had no say in their coefficients."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sim.params import LawParams
from visthrow.diagnose.likelihood.evidence import Priors
from visthrow.diagnose.likelihood.marginal import Statistics
from visthrow.diagnose.models.law_terms import term_of
from visthrow.diagnose.select import terms
from visthrow.diagnose.select.held_out import borne_out, groups_of, regrouped
from visthrow.diagnose.select.point import candidate
from visthrow.diagnose.select.result import Diagnosis

WIDE = 10.0  # prior deviation of a coefficient, in its size: flights alone say it


def with_repeated_laws(diagnosis: Diagnosis) -> Diagnosis:
    """Return a diagnosis without the laws that other flights do not repeat.

    Each flight is left out in turn; what the others say of the coefficients predicts it, beside the
    names as all flights size them.
    """
    laws = {law.formula: law for law in diagnosis.laws}
    if not laws:
        return diagnosis
    work = diagnosis.work
    count = len(work.problem.effects)
    effects = [
        terms.as_effect(
            term_of(LawParams(law.block, law.factors, law.vector, 0.0)),
            WIDE * max(abs(law.coefficient), law.sd),
            0.0,
        )
        for law in laws.values()
    ]
    wide, (point,) = terms.extended(work.problem, [work.before], effects)
    columns = {formula: count + i for i, formula in enumerate(laws)}
    sets = [[columns[law.formula] for law in together] for together in diagnosis.explanations]
    point = candidate(wide, point, [*work.active, *sets[0]])
    groups, left_out = groups_of(point, work.problem.kept)
    statistics = regrouped(point, groups)
    names = np.where(np.arange(len(point.theta)) < count, point.theta, 0.0)
    shares = [_share(statistics, wide.priors, names, chosen) for chosen in sets]
    repeated = [e for e, (_, low, _) in zip(diagnosis.explanations, shares) if low > 0.0]
    repeated = repeated if shares[0][1] > 0.0 else []  # none in place of a better one
    formulas = {law.formula for together in repeated for law in together}
    reasons = list(diagnosis.reasons)
    if not repeated:
        share, low, high = (100.0 * value for value in shares[0])
        best = [law.formula for law in diagnosis.explanations[0]]
        reasons = [r for r in reasons if not any(formula in r for formula in best)]
        reasons.append(
            f"a formula explains these flights, but {left_out} that are left out do not repeat it:"
            f" they bear out {share:.0f} % [{low:.0f}, {high:.0f}] of what it promises"
        )
    return replace(
        diagnosis,
        reasons=tuple(reasons),
        explanations=tuple(repeated),
        laws=tuple(law for law in diagnosis.laws if law.formula in formulas),
    )


def _share(
    statistics: Statistics, priors: Priors, names: np.ndarray, laws: Sequence[int]
) -> tuple[float, float, float]:
    """Return the part of what laws promise that flights without a say in them bear out, with its
    95 % interval; ``names``: sizes of the names in floors, shape (K,).
    """
    information = statistics.information[:, laws][:, :, laws]
    score = statistics.absolute[:, laws] - statistics.information[:, laws] @ names
    prior = np.diag(priors.slab[laws] ** -2.0)
    total = information.sum(0) + prior
    training = total - information, score.sum(0) - score
    trained = np.linalg.solve(training[0], training[1][..., None])[..., 0]
    part = replace(statistics, information=information, score=score, theta=np.zeros(len(laws)))
    return borne_out(part, trained, np.linalg.solve(total, score.sum(0)))

"""From the end of a search to verdicts: exactly one for every effect, one overall, each with its
reason in words.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from visthrow.diagnose.likelihood.evidence import (
    CALIBRATION_QUANTILE,
    INEXACT,
    NORMAL_95,
    OWN_FLOOR,
    Priors,
    certainty,
    covariance,
    estimate,
)
from visthrow.diagnose.likelihood.marginal import TAIL
from visthrow.diagnose.models.model_interface import Effect, Model, Window
from visthrow.diagnose.select import result
from visthrow.diagnose.select.excess import acts_on, levels, too_strong
from visthrow.diagnose.select.held_out import sized
from visthrow.diagnose.select.point import (
    SMALL_STEP,
    Point,
    moved,
    with_fitted_noise,
    with_floors_noise,
    with_varying,
)
from visthrow.diagnose.select.result import Diagnosis, Finding, Law, Level
from visthrow.diagnose.select.scatter import CHAIN, FORM, Varies, allowed, deviations, freed
from visthrow.diagnose.select.search_state import Work
from visthrow.diagnose.select.selector import Selector
from visthrow.diagnose.select.terms import bare

BIT = 0.5
"""An effect whose posterior deviation exceeds this share of its prior's was not seen: flights say
less than a bit about it.
"""


def conclude(search: Selector) -> Diagnosis:
    """Turn a finished search into verdicts."""
    point = search.point
    model = search.problem.model
    scatter = (*search.scatter(search.active), *([search.dropped] if search.dropped else []))
    varies = deviations(
        scatter, search.priors, [e.name for e in model.effects], search.problem.varies.days
    )
    if varies or point.varies:
        point = search.point = with_varying(point, varies)
    latent_levels = levels(
        search.problem,
        search.nominal,
        with_floors_noise(search.problem, point, search.active),
        search.least,
    )
    varied = {name for s in scatter if s.found for name in s.of}
    search.refused = {j: nats for j, nats in search.refused.items() if search.name(j) not in varied}
    overall, block, reasons, withdrawn = _overall(search, latent_levels)
    mistakes = tuple(model.mistakes)
    if overall == result.NO_EFFECT and (any(s.found for s in scatter) or mistakes):
        besides = [m.name for m in mistakes] + [s.name for s in scatter if s.found]
        overall = result.KNOWN
        reasons = [f"besides {' and '.join(besides)}, {reasons[0]}"]
    forms = [s.name for s in scatter if s.found and s.name.endswith(f"{FORM}{s.by}")]
    if len(forms) > 1 and overall == result.KNOWN:
        reasons = [f"flights differ in {', '.join(forms)} at once; the form is another"]
        overall = result.UNKNOWN
        block = next(s.block for s in scatter if s.name == forms[0])
    explanations = (
        search.explanations() if overall == result.UNKNOWN else []
    )  # a term that is weaker than the names says nothing
    search, without_terms = _without_laws(search, point), not search.terms
    active = [j for j in search.active if j not in withdrawn]
    point = search.point
    model = search.problem.model
    if not without_terms:
        active = _sure(point, search.priors, active)
        withdrawn = set(search.active) - set(active)
    without_terms = without_terms and bool(active or not search.active)
    if not active and search.active:
        point = search.nominal
    point = replace(
        point,
        plain=search.about_means(active, varies) if without_terms else freed(point.plain, varies),
        varies=Varies(),
    )
    theta, spread, unlike = sized(search.problem, point, active)
    findings = tuple(
        _finding(search, point, j, active, unlike, withdrawn) for j in range(len(model.effects))
    )
    return Diagnosis(
        overall,
        block,
        tuple(reasons),
        findings,
        theta,
        spread,
        search.least,
        tuple(search.steps),
        tuple((tuple(map(search.name, m.active)), 0.0 - m.nats) for m in search.sets),
        latent_levels,
        _different(explanations),
        _events(search, point),
        sensor_scale={name: float(point.noise.scale[c]) for c, name in enumerate(model.channels)},
        scatter=scatter,
        mistakes=mistakes,
        explanations=tuple(explanations),
        flights=len(search.point.plain.flights),
        windows=len(point.windows),
        samples=int(point.statistics.samples.sum()),
        work=Work(
            search.problem, search.nominal, search.work if active else search.nominal, tuple(active)
        ),
    )


def _sure(point: Point, priors: Priors, active: Sequence[int]) -> list[int]:
    """Names that are surely not 0 at a point, the least certain gone first."""
    remaining = list(active)
    while remaining:
        theta = estimate(point.information, point.score, priors, remaining)
        sure = certainty(point.information, theta, priors, remaining)
        if sure.min() > 1.0:
            break
        remaining.pop(int(np.argmin(sure)))
    return remaining


def _without_laws(search: Selector, point: Point) -> Selector:
    """The search as if the laws of its set were known: what they explain is left out of the
    residuals.
    """
    if not search.problem.terms:
        return replace(search, work=point)
    unlawful = (
        moved(search.problem, point, np.where(search.term_columns, 0.0, point.theta)) or point
    )
    problem = bare(search.problem, point)[0]
    nominal, origin, without, work = (
        bare(search.problem, p)[1] for p in (search.nominal, search.origin, point, unlawful)
    )
    names = search.names
    sets = [m for m in search.sets if max(m.active, default=0) < len(problem.priors.floor)]
    return replace(
        search,
        problem=problem,
        nominal=nominal,
        origin=origin,
        point=without,
        work=with_fitted_noise(work),
        active=names,
        sets=sets,
    )


def _different(explanations: Sequence[Sequence[Law]]) -> tuple[Law, ...]:
    """Laws, each formula once, with the coefficient of the best."""
    laws: dict[str, Law] = {}
    for law in (law for together in explanations for law in together):
        laws.setdefault(law.formula, law)
    return tuple(laws.values())


def _events(search: Selector, point: Point) -> tuple[int, ...]:
    """Flights that were left out for what happened there, and flights with a window far rougher
    than its phase.
    """
    square = TAIL / chi2.ppf(
        (1.0 - CALIBRATION_QUANTILE) / point.noise.share.size, TAIL
    )  # of the roughest, with Student's tails
    rough = {
        window.flight
        for window, share in zip(point.windows, point.noise.share)
        if share.max() ** 2 > square
    }
    return tuple(sorted({*search.events, *rough}))


def out_of_domain(model: Model, windows: Sequence[Window], usable: int, seed: int) -> Diagnosis:
    """The verdict where the simulation fails in most windows."""
    reason = (
        f"the simulation stays finite in {usable} of {len(windows)} windows; check units, axes and"
        " the vehicle's configuration"
    )
    findings = tuple(
        replace(
            _blank(e),
            verdict=result.NOT_IDENTIFIABLE,
            manoeuvres=(),
            sentence=(
                f"{e.name}: nothing can be said, the simulation does not follow these flights."
            ),
        )
        for e in model.effects
    )
    flights = len({w.flight for w in windows})
    return Diagnosis(
        result.OUT_OF_DOMAIN,
        "",
        (reason,),
        findings,
        {},
        (),
        float("nan"),
        flights=flights,
        windows=len(windows),
        seed=seed,
    )


def _overall(
    search: Selector, latent_levels: Sequence[Level]
) -> tuple[str, str, list[str], set[int]]:
    """Overall verdict, block of an unknown effect, reasons, and the names that are withdrawn for
    it.
    """
    point = search.point
    all_names = set(search.active)
    strong = too_strong(
        point, INEXACT
    )  # what no missing cause explains: the channels do not belong together
    if strong:
        reason = (
            f"after everything the catalogue can do, forces above {INEXACT:.0%} of the thrust are"
            f" missing in the phases {', '.join(strong)}: commands and poses, units or axes do not"
            " belong together"
        )
        return result.INCONSISTENT, "", [reason], all_names
    if search.refused and not search.active:
        names = ", ".join(search.name(j) for j in sorted(search.refused))
        return (
            result.INCONSISTENT,
            "",
            [f"what looks like {names} changes its sign from flight to flight"],
            all_names,
        )
    excessive = [level for level in latent_levels if level.excessive]
    reasons = [_excess(level) for level in excessive]
    if search.terms:
        untold, sentence = search.law()
        return (
            result.UNKNOWN,
            search.problem.effects[search.terms[0]].block,
            [sentence, *reasons],
            untold,
        )
    stuck = [j for j in search.active if _on_bound(search, j)]
    if stuck:
        names = ", ".join(map(search.name, stuck))
        reasons.append(
            f"{names} would have to lie outside what is physically possible; the form is another"
        )
        return (
            result.UNKNOWN,
            acts_on(point, stuck[:1])[0] or search.problem.effects[stuck[0]].block,
            reasons,
            all_names,
        )
    if excessive:
        worst = max(excessive, key=lambda level: level.nats)
        return result.UNKNOWN, worst.block, reasons, _withdrawn(search, excessive)
    if search.active:
        return result.KNOWN, "", [f"{len(search.active)} named, nothing excessive is left"], set()
    return (
        result.NO_EFFECT,
        "",
        [f"no effect exceeds {search.least:.1f} nats, and nothing excessive is left"],
        set(),
    )


def _excess(level: Level) -> str:
    unit = "N m" if "torque" in level.block else "N"
    return (
        f"{level.block} in phase {level.phase}: {level.after:.2g} {unit} remain,"
        f" {level.after / level.quiet:.1f} times the quietest phase ({level.nats:.0f} nats)"
    )


def _withdrawn(search: Selector, excessive: Sequence[Level]) -> set[int]:
    """Names that stand for the unknown effect's wrong form: a chain of them in its block, or one
    that left it as it was.
    """
    blocks = dict(zip(search.active, acts_on(search.point, search.active)))
    in_excess = {j for j, block in blocks.items() if block in {level.block for level in excessive}}
    if len(in_excess) > CHAIN:
        return in_excess
    eased = {level.block: level.after < 0.5 * level.before for level in excessive}
    return {j for j in in_excess if not eased.get(blocks[j], True)}


def _on_bound(search: Selector, j: int) -> bool:
    """Whether an estimate lies on its bound and the flights push it on by more than the
    threshold.
    """
    point = search.point
    priors = search.priors
    on_bound = (
        min(abs(point.theta[j] - priors.low[j]), abs(point.theta[j] - priors.high[j])) < SMALL_STEP
    )
    push = point.statistics.score[:, j].sum()
    return bool(
        on_bound
        and push * point.theta[j] > 0.0
        and 0.5 * push**2 / point.information[j, j] > search.least
    )


def _finding(
    search: Selector, point: Point, j: int, active: list[int], unlike: float, withdrawn: set[int]
) -> Finding:
    effect = search.problem.effects[j]
    priors = search.priors
    blank = _blank(effect)
    if not priors.visible[j]:
        missing = tuple(c for c in effect.channels if c not in search.problem.model.channels)
        return replace(
            blank,
            missing=missing,
            sentence=f"{effect.name}: not to be seen without {', '.join(missing)}.",
        )
    partners, together = _class_of(search, j, active)
    remaining = [k for k in together if k != j]
    sigma = covariance(
        point.information, priors.deviation([*remaining, j])
    )  # as if it were named beside the others
    mean = float(sigma[j] @ point.score)
    sd = float(np.sqrt(sigma[j, j]))
    deviation = float(np.hypot(sd, OWN_FLOOR)) * effect.floor
    nats = point.evidence(priors, [*remaining, j]) - point.evidence(priors, remaining)
    differs = float(np.sqrt(unlike) * allowed(mean)) * effect.floor
    blank = replace(
        blank, sd=deviation, nats=nats, differs=differs if j in active or partners else 0.0
    )
    if j in active or partners:
        return _named(search, point, blank, mean, sorted({j, *partners}), active)
    low, high = (
        float(np.clip(mean * effect.floor + side * NORMAL_95 * deviation, *effect.bounds)) + 0.0
        for side in (-1.0, 1.0)
    )  # no -0
    blank = replace(blank, low=low, high=high)
    if j in withdrawn:
        text = (
            f"{effect.name}: explains a part of what is missing, but not its form; the name is"
            " withdrawn."
        )
        return replace(blank, verdict=result.NOT_IDENTIFIABLE, sentence=text)
    if sd > BIT * priors.slab[j]:
        text = (
            f"{effect.name}: these flights say hardly more than was known ({deviation:.2g} of"
            f" {effect.prior_sd:.2g} {effect.unit})."
        )
        return replace(blank, verdict=result.NOT_IDENTIFIABLE, sentence=text)
    text = f"{effect.name}: between {low:.3g} and {high:.3g} {effect.unit}, if there at all."
    if low == high:
        comparison = "less" if mean * effect.floor < low else "more"
        text = (
            f"{effect.name}: on its bound of {low:.3g} {effect.unit}; these flights ask for"
            f" {comparison} than is possible."
        )
    return replace(blank, verdict=result.BOUNDED, sentence=text)


def _blank(effect: Effect) -> Finding:
    """Return the finding on an effect before any flight."""
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


def _class_of(
    search: Selector, j: int, active: Sequence[int]
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Partners of an effect, and the set that it belongs to: that of the search, or another that
    explains the flights as well.

    Partners are a named effect and the new ones of sets of as many that do without it.
    """
    named = set(active)
    alike = [set(m.active) for m in search.sets if len(m.active) == len(active)]
    for home in active:
        rivals = [members for members in alike if home not in members]
        partners = {home}.union(*rivals) - (named - {home})
        if j in partners and len(partners) > 1:
            return tuple(sorted(partners - {j})), tuple(
                active if j == home else next(m for m in rivals if j in m)
            )
    return (), tuple(active)


def _named(
    search: Selector,
    point: Point,
    blank: Finding,
    mean: float,
    members: list[int],
    active: list[int],
) -> Finding:
    """The verdict on a cause that the flights ask for; ``mean`` is in floors, ``members`` are those
    of its class.
    """
    low = blank.low
    high = blank.high
    size = float(np.clip(mean * blank.floor, low, high)) + 0.0  # no -0
    low = max(low, size - NORMAL_95 * blank.sd) + 0.0
    high = min(high, size + NORMAL_95 * blank.sd) + 0.0
    text = f"{size:.3g} ± {blank.sd:.2g} {blank.unit}"
    blank = replace(blank, estimate=size, low=low, high=high)
    if len(members) < 2:
        sentence = (
            f"{blank.cause}: {blank.name} = {text} (95 %: {low:.3g} to {high:.3g}),"
            f" {blank.nats:.0f} nats; another flight may differ by {blank.differs:.2g}."
        )
        return replace(blank, verdict=result.FOUND, sentence=sentence)
    names = tuple(name for name in map(search.name, members) if name != blank.name)
    joint = _joint(search, point, members, [k for k in active if k not in members])
    sentence = (
        f"{blank.cause}: {blank.name} = {text} if it is the cause; these flights cannot tell it"
        f" from {', '.join(names)}. Known is {joint}."
    )
    return replace(blank, verdict=result.CLASS, partners=names, joint=joint, sentence=sentence)


def _joint(search: Selector, point: Point, members: list[int], named: list[int]) -> str:
    """The best known combination of a class: first eigenvector of its members' information in prior
    deviations.
    """
    priors = search.priors
    effects = search.problem.effects
    nuisances = np.setdiff1d(np.arange(len(effects)), members)
    information = point.information
    slab = priors.slab[members]
    nuisance = information[np.ix_(nuisances, nuisances)] + np.diag(
        priors.deviation(named)[nuisances] ** -2.0
    )
    cross = information[np.ix_(members, nuisances)]
    schur = information[np.ix_(members, members)] - cross @ np.linalg.solve(nuisance, cross.T)
    score = point.score[members] - cross @ np.linalg.solve(nuisance, point.score[nuisances])
    values, vectors = np.linalg.eigh(schur * np.outer(slab, slab))
    vector = vectors[:, -1] / slab
    value = values[-1]  # per floor
    first = int(np.argmax(np.abs(vectors[:, -1])))
    scale = vector[first] / priors.floor[members[first]]
    mean = float(
        np.linalg.lstsq(schur * np.outer(slab, slab), score * slab, rcond=1e-8)[0] @ vectors[:, -1]
    )
    unit = effects[members[first]].unit
    parts = [effects[members[first]].name]
    for i in (i for i in range(len(members)) if i != first):
        effect = effects[members[i]]
        coefficient = vector[i] / priors.floor[members[i]] / scale
        parts.append(
            f"{'+' if coefficient > 0 else '-'} {abs(coefficient):.3g} {unit}/({effect.unit})"
            f" {effect.name}"
        )
    sd = 1.0 / np.sqrt(max(value, 1e-300)) / abs(scale)
    return f"{' '.join(parts)} = {mean / scale:.4g} ± {sd:.2g} {unit}"

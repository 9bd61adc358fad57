"""Turn a selection into verdicts: one for every effect and one overall, each with its reason."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import replace

import numpy as np
from scipy.special import gammaincinv

from sim.effects.effect import RandomEffect
from visthrow.config.effects import random_effects
from visthrow.diagnose.likelihood.evidence import ALARM, INEXACT, MODEL_ERROR_FLOOR, Sets
from visthrow.diagnose.likelihood.marginal import TAIL, Statistics
from visthrow.diagnose.models.model_interface import Indices, Model, Window
from visthrow.diagnose.select import result, terms
from visthrow.diagnose.select.candidates import (
    ALL,
    DAY,
    EVENT,
    FLIGHT,
    Candidate,
    Names,
    Scatter,
    Shares,
    as_random,
    between_flights,
    columns_of,
    estimate_shares,
    integrate_shares,
    judge,
    laws_of,
    relinearise_per_flight,
    unit_suffix,
)
from visthrow.diagnose.select.excess import acts_on, compares_phases, floors_of, levels, too_strong
from visthrow.diagnose.select.findings import Reading, blank
from visthrow.diagnose.select.held_out import Work, repeated_share, share_text
from visthrow.diagnose.select.occam import Linear
from visthrow.diagnose.select.point import (
    SMALL_STEP,
    Point,
    move,
    with_floors_noise,
    with_noise_at,
)
from visthrow.diagnose.select.result import Diagnosis, Finding, Law, Level
from visthrow.diagnose.select.selection import Selector

Answer = tuple[str, str, list[str], set[int]]
"""Overall verdict, block of an unknown effect, reasons, and effects that are withdrawn."""


def conclude(selection: Selector, commands: Scatter | None = None) -> Diagnosis:
    """Turn a finished selection into verdicts; ``commands``: the verdict on lost commands."""
    model = selection.nominal.problem.model
    scatter, shares = random_shares_of(selection)
    varying = {j for c in shares if c.group != EVENT for j in c.columns}
    point = _vary(selection, shares)
    if commands:
        scatter = (*scatter, commands)
    calm = with_floors_noise(point, selection.best.columns)
    block_levels = levels(selection.nominal, calm, selection.threshold)
    overall, block, reasons, withdrawn = _overall(selection, block_levels, scatter)
    explanations = []
    if overall == result.UNKNOWN:
        explanations, unrepeated = _explanations(selection)
        reasons = [unrepeated, *reasons[1:]] if unrepeated else reasons
    alone = _sizes_alone(selection.best.chosen, point)
    point = terms.without_laws(point)
    nominal = terms.without_laws(selection.nominal)
    problem = point.problem
    active = [j for j in selection.names if j not in withdrawn]
    if selection.names and not active:
        point = nominal
    means = () if laws_of(selection.best.chosen) else varying & {*active}
    shared_point = _about_means(replace(point, shares=shares), active, means)
    sized = tuple(sorted(varying | {*active}))
    sizes = shared_point.posterior.mean_sizes(sized, [(sized, 0.0)])
    in_units = {problem.effects[j].name: sizes[j] * problem.priors.floor[j] for j in sized}
    unlike, mean_part = between_flights(shared_point.statistics, problem.priors, active, sizes)
    reading = Reading(shared_point, active, withdrawn, *_sets_of(selection), unlike)
    findings = tuple(reading.finding(j) for j in range(len(model.effects)))
    named = [findings[j] for j in active]
    theta = {f.name: f.estimate for f in named}
    spread = _covariance(shared_point, named, active, mean_part)
    listed = []
    for trial, nats in selection.window:
        listed.append((tuple(sorted(c.name for c in trial.chosen)), nats))
    return Diagnosis(
        overall,
        block,
        tuple(reasons),
        findings,
        theta,
        spread,
        selection.threshold,
        steps=tuple(selection.steps),
        sets=tuple(listed),
        levels=block_levels,
        laws=_different(explanations),
        events=_events(selection, point),
        alone=alone,
        sensor_scale=dict(zip(model.channels, point.noise.scale.tolist())),
        scatter=_add_means(scatter, in_units),
        mistakes=tuple(model.mistakes),
        explanations=tuple(explanations),
        flights=len(point.plain.flights),
        windows=len(point.windows),
        samples=int(point.statistics.samples.sum()),
        work=Work(nominal, point if active else nominal, tuple(active)),
    )


def _vary(selection: Selector, shares: Shares) -> Point:
    """Set the random shares of the best point, and return it."""
    point = selection.best.point
    if shares or point.shares:
        point = with_noise_at(replace(point, shares=shares), point.theta)
        selection.best = replace(selection.best, point=point)
    return point


def _add_means(scatter: Sequence[Scatter], means: Mapping[str, float]) -> tuple[Scatter, ...]:
    """Add the means of the varying effects in these flights to the verdicts on them."""
    verdicts = []
    for s in scatter:
        mean = {name: means[name] for name in s.of if name in means}
        verdicts.append(replace(s, mean=mean))
    return tuple(verdicts)


def _covariance(
    point: Point,
    named: Sequence[Finding],
    active: Indices,
    mean_part: np.ndarray,
) -> tuple[tuple[float, ...], ...]:
    """Return the joint covariance of the findings' sizes, including the variance that differences
    between flights leave in the mean of these flights.

    ``mean_part``: share of the variance between flights that remains in the mean, shape (K,)."""
    columns = list(active)
    sigma = point.posterior.covariance(columns)
    spread = sigma[np.ix_(columns, columns)] + MODEL_ERROR_FLOOR**2 * np.eye(len(columns))
    scale = np.array([f.sd for f in named]) / np.sqrt(np.diag(spread))
    differs = np.array([f.differs for f in named])
    variance = spread * np.outer(scale, scale) + np.diag(mean_part[columns] * differs**2)
    return tuple(map(tuple, variance.tolist()))


def random_shares_of(selection: Selector) -> tuple[tuple[Scatter, ...], Shares]:
    """Return verdicts on the catalogue's random effects and on the selected ones, and the selected
    random shares.

    Each verdict leaves the mean of the effect free. Flights far from the mean are simulated again
    at their own size."""
    best = selection.best
    problem = selection.problem
    priors = selection.problem.priors
    catalogue = {v.name: v for v in random_effects()}
    means = [c for c in selection.candidates if c.group == ALL]
    verdicts = []
    shares = dict(best.point.shares)
    for c in _list_asked(selection, catalogue.keys()):
        usual = c not in best.chosen
        statistics = best.point.plain
        beside = best.chosen
        if usual:
            beside |= {m for m in means if {*m.columns} & {*c.columns}}
        elif len(c.columns) == 1:
            statistics = _straight(best.point, best.columns, c.columns[0])
        fixed_shares = {o: size for o, size in best.point.shares.items() if o != c}
        linear = Linear(statistics, priors, (), lambda _: 0.0)
        effect = catalogue.get(c.name) or as_random(problem.effects[c.columns[0]])
        verdict = share_verdict(linear, c, beside, fixed_shares, effect, selection.threshold)
        # shares of single flights may explain all of the variation
        found = not usual and verdict.size > verdict.floor
        verdicts.append(replace(verdict, found=found))
        if not usual:
            shares[c] = max(verdict.size, verdict.floor) / effect.prior_sd
    return tuple(verdicts), shares


def _list_asked(selection: Selector, usual: Set[str]) -> list[Candidate]:
    """Return the selected random shares, and those of the usual random effects not selected."""
    varying = [c for c in selection.candidates if c.group in (FLIGHT, DAY)]
    selected = [c for c in varying if c in selection.best.chosen]
    others = usual - {c.name for c in selected}
    return [c for c in varying if c in selected or (c.group == FLIGHT and c.name in others)]


def share_verdict(
    linear: Linear,
    c: Candidate,
    chosen: Names,
    fixed_shares: Shares,
    effect: RandomEffect,
    threshold: float,
) -> Scatter:
    """Return the verdict on a random share, from the evidence of its deviations.

    Args:
        chosen: the set that contains it, or beside which it is judged.
        fixed_shares: other random shares, with their deviations.
        effect: the random effect of which it is a share.
        threshold: evidence that a finding needs [nats].
    """
    sizes, nats = linear.profile(chosen, fixed_shares, c)
    statistics = linear.statistics
    flights = statistics.sum_by(statistics.days) if c.group == DAY else statistics
    informative = (flights.information[:, c.columns, c.columns] > 0.0).any(axis=1)
    count = int(informative.sum())
    reach = sizes * effect.prior_sd
    needed = threshold + c.penalty
    return judge(replace(effect, name=c.name), reach, nats, needed, count, c.group)


def _straight(point: Point, active: Indices, j: int) -> Statistics:
    named = np.isin(np.arange(len(point.theta)), list(active))
    theta = np.where(named, point.theta, 0.0)

    def simulate(position: np.ndarray) -> Statistics | None:
        moved_point = move(point, position)
        return None if moved_point is None else moved_point.plain

    return relinearise_per_flight(point.plain, theta, point.problem.priors, j, simulate)


def _about_means(point: Point, active: Indices, varying: Iterable[int]) -> Point:
    """Return the point with random shares integrated out, linearised at the means of the selected
    effects that vary.
    """
    statistics = point.plain
    for j in sorted(varying):
        statistics = _straight(replace(point, plain=statistics), active, j)
    shared = integrate_shares(statistics, point.shares)
    return replace(point, plain=shared, shares={})


def _sets_of(selection: Selector) -> tuple[Sets, Sets]:
    """Return the effects of each possible set with the best set's random shares, and those of every
    possible set, including effects that vary between flights; and how many nats each is behind.
    """
    random = {c for c in selection.best.chosen if c.group != ALL}
    alike = []
    every = []
    for trial, nats in selection.window:
        varying = {c for c in trial.chosen if c.group != ALL}
        if varying == random and not laws_of(trial.chosen):
            alike.append((tuple(trial.columns), nats))
        effects = {j for c in trial.chosen if c.group != EVENT for j in c.columns}
        every.append((tuple(effects), nats))
    return alike, every


def _explanations(selection: Selector) -> tuple[list[tuple[Law, ...]], str]:
    """Return the selected laws, then alternatives to them, best first, as far as held-out flights
    repeat them; if they do not repeat the selected ones, return none and the reason.
    """
    best = selection.best
    if not laws_of(best.chosen):
        return [], ""
    names = frozenset(c for c in best.chosen if not c.law)
    linear = selection.linear(best.point)
    plain = linear.value(names)
    sets = [best.chosen, *(names | {c} for c in laws_of(selection.candidates))]
    value = {chosen: linear.value(chosen) - plain for chosen in sets}
    ranked = sorted(value.keys() - {best.chosen}, key=value.get, reverse=True)
    repeated = []
    for chosen in (best.chosen, *(s for s in ranked if value[s] > 0.0)):
        columns = [c.columns[0] for c in laws_of(chosen)]
        share, low, high = repeated_share(best.point, columns)
        if low > 0.0:
            repeated.append(terms.laws(best.point, columns_of(chosen), value[chosen]))
        elif chosen == best.chosen:  # then alternatives are not reported either
            by_flight = best.point.plain.information[:, columns, columns].sum(axis=1)
            flight = best.point.plain.flights[np.argmax(by_flight)]
            return [], (
                "a formula, which is not printed, explains these flights, but held-out ones do not"
                f" repeat it: {share_text(share, low, high)}; flight {flight} shows it most: fly"
                " more like that one"
            )
    return repeated, ""


def _parts_of(selection: Selector, blocks: set[str]) -> set[int]:
    """Return the selected effects that may be part of an unknown law in some blocks.

    An effect acts on a block by its column, or by the part of its column that the other effects do
    not explain, such as two delays that differ by a force. Effects that are not certain without
    those are also part of it."""
    best = selection.best
    names = selection.names
    in_block = set()
    for j in names:
        remaining = [k for k in names if k != j]
        (residual_block,) = acts_on(best.point, [j], free_effects=remaining)
        if {selection.block_of(j), residual_block} & blocks:
            in_block.add(j)
    columns = [j for j in best.columns if j not in in_block]
    return set(names) - set(best.point.posterior.certainly_nonzero(columns))


def _different(explanations: Sequence[Sequence[Law]]) -> tuple[Law, ...]:
    """Return each law once, with the coefficient from the best explanation."""
    laws = {}
    for together in explanations:
        for law in together:
            laws.setdefault(law.formula, law)
    return tuple(laws.values())


def _sizes_alone(chosen: Names, point: Point) -> dict[str, float]:
    """Return the deviation of each effect that differs in a single flight, in its unit."""
    shares = estimate_shares(point.plain, point.theta, point.shares)
    shares *= point.problem.priors.floor
    row = {flight: i for i, flight in enumerate(point.plain.flights.tolist())}
    events = [c for c in chosen if c.group == EVENT]
    return {c.name: shares[row[c.flight], c.columns[0]] for c in events}


def _events(selection: Selector, point: Point) -> tuple[int, ...]:
    """Return the flights in which an effect differs, and those with a window far rougher than its
    phase, if the force is large enough to matter.
    """
    least = ALARM / point.noise.share.size
    quantile = 2.0 * gammaincinv(0.5 * TAIL, least)  # of chi squared with TAIL degrees of freedom
    roughest = np.sqrt(TAIL / quantile)  # largest share expected by chance
    events = {c.flight for c in selection.best.chosen if c.group == EVENT}
    floors = floors_of(point)
    for window, share in zip(point.windows, point.noise.share):
        for (block, phase), level in point.noise.latent_sd.items():
            strong = level * share[block] > floors.get((block, phase), 0.0)
            if phase == window.phase and share[block] > roughest and strong:
                events.add(window.flight)
    return tuple(sorted(events))


def report_out_of_domain(
    model: Model, windows: Sequence[Window], usable: int, seed: int
) -> Diagnosis:
    """Return the diagnosis if the simulation fails in most windows."""
    reason = (
        f"the simulation stays finite in {usable} of {len(windows)} windows; check units, axes and"
        " the vehicle's configuration"
    )
    findings = []
    for e in model.effects:
        text = f"{e.name}: not identifiable, as the simulation does not follow these flights."
        finding = replace(blank(e), manoeuvres=(), sentence=text)
        findings.append(replace(finding, verdict=result.NOT_IDENTIFIABLE))
    flights = len({w.flight for w in windows})
    return Diagnosis(
        result.OUT_OF_DOMAIN,
        "",
        (reason,),
        tuple(findings),
        {},
        (),
        float("nan"),
        flights=flights,
        windows=len(windows),
        seed=seed,
    )


def _overall(
    selection: Selector, block_levels: Sequence[Level], scatter: Sequence[Scatter]
) -> Answer:
    """Return the overall verdict, by the first of these reasons that holds."""
    excessive = [level for level in block_levels if level.excessive]
    reasons = [_excess(level) for level in excessive]
    return (
        _contradiction(selection)
        or _law(selection, reasons)
        or _outside_bounds(selection, reasons)
        or _answer_crowded(selection, reasons)
        or _misshapen(selection, reasons)
        or _answer_left_over(selection, excessive, reasons)
        or _unlike(scatter)
        or _answer_explained(selection, scatter)
    )


def _contradiction(selection: Selector) -> Answer | None:
    """Return DATA INCONSISTENT if the unexplained forces are large compared with the thrust."""
    strong = too_strong(selection.best.point, INEXACT)
    if not strong:
        return None
    reason = (
        f"with the best causes of the catalogue, forces above {INEXACT:.0%} of the thrust are still"
        f" missing in the phases {', '.join(strong)}: commands and poses, units or axes contradict"
        " each other"
    )
    return result.INCONSISTENT, "", [reason], set(selection.best.columns)


def _law(selection: Selector, reasons: Sequence[str]) -> Answer | None:
    """Return UNKNOWN if laws were selected."""
    best = selection.best
    forms = laws_of(best.chosen)
    if not forms:
        return None
    texts = []
    for law in terms.laws(best.point, best.columns, 0.0):
        unit = unit_suffix(law.unit)
        texts.append(f"{law.formula}, c = {law.coefficient:.3g} ± {law.sd:.2g}{unit}")
    verb = "explains" if len(texts) == 1 else "together explain"
    reason = f"{' and '.join(texts)} {verb} what no cause of the catalogue explains"
    blocks = terms.acts_in(c.law for c in forms)
    return result.UNKNOWN, forms[0].law, [reason, *reasons], _parts_of(selection, blocks)


def _outside_bounds(selection: Selector, reasons: Sequence[str]) -> Answer | None:
    """Return UNKNOWN if the flights push an estimate beyond its bound."""
    active = selection.best.columns
    stuck = [j for j in active if _is_on_bound(selection, j)]
    if not stuck:
        return None
    effects = [selection.problem.effects[j] for j in stuck]
    names = ", ".join(effect.name for effect in effects)
    reason = (
        f"{names} would have to lie outside what is physically possible: the true cause has another"
        " equation"
    )
    block = selection.block_of(stuck[0]) or effects[0].block
    return result.UNKNOWN, block, [*reasons, reason], set(active)


def _answer_crowded(selection: Selector, reasons: Sequence[str]) -> Answer | None:
    """Return UNKNOWN if several effects act on one block, cost more together than an unknown law,
    and are hardly distinguished by the flights.
    """
    law = selection.threshold + terms.LAW
    for block, members in _list_by_block(selection).items():
        part = selection.best.point.information[np.ix_(members, members)]
        unlike = 1.0 / (np.diag(part) * np.diag(np.linalg.pinv(part)))
        if len(members) * selection.threshold > law and unlike.min() < 0.5:
            names = ", ".join(selection.problem.effects[j].name for j in members)
            reason = f"{names} act on the {block} and some hardly differ: another law is likelier"
            return result.UNKNOWN, block, [*reasons, reason], set(members)
    return None


def _misshapen(selection: Selector, reasons: Sequence[str]) -> Answer | None:
    """Return UNKNOWN if a function of one quantity explains the residual of the selected effects in
    a block; of several blocks, the one with most evidence is reported.
    """
    best = selection.best
    by_block = _list_by_block(selection)
    strongest = terms.strongest_forces(selection.nominal) if selection.laws else {}
    in_blocks = {block: strongest[block] for block in by_block if block in strongest}
    curves = terms.best_curves(best.point, best.columns, in_blocks)
    block = max(curves, key=curves.get, default="")
    nats, formula = curves.get(block, (0.0, ""))
    if nats <= selection.threshold:
        return None
    names = ", ".join(selection.problem.effects[j].name for j in by_block[block])
    reason = (
        f"{formula}, with some function f, explains {nats:.0f} nats beyond {names}: the true cause"
        " has another equation"
    )
    return result.UNKNOWN, block, [reason, *reasons], _parts_of(selection, {block})


def _answer_left_over(
    selection: Selector, excessive: Sequence[Level], reasons: list[str]
) -> Answer | None:
    """Return UNKNOWN if latent forces are excessive, and withdraw effects on a block whose latent
    forces they do not reduce.
    """
    if not excessive:
        return None
    worst = max(excessive, key=lambda level: level.nats)
    eased = {level.block: level.after < 0.5 * level.before for level in excessive}
    withdrawn = set()
    for j in selection.best.columns:
        if not eased.get(selection.block_of(j), True):
            withdrawn.add(j)
    return result.UNKNOWN, worst.block, reasons, withdrawn


def _unlike(scatter: Sequence[Scatter]) -> Answer | None:
    """Return UNKNOWN if flights differ in several effects that usually do not vary."""
    catalogue = {v.name for v in random_effects()}
    forms = [s for s in scatter if s.found and s.name not in catalogue]
    if len(forms) < 2:
        return None
    names = ", ".join(s.name for s in forms)
    reason = f"flights differ in {names} at once: the true cause has another equation"
    return result.UNKNOWN, forms[0].block, [reason], set()


def _answer_explained(selection: Selector, scatter: Sequence[Scatter]) -> Answer:
    """Return KNOWN or NO EFFECT, if nothing is missing."""
    if selection.best.columns:
        return result.KNOWN, "", [], set()  # the reason comes from held-out flights
    nothing = (
        f"no effect exceeds {selection.threshold:.1f} nats, and no residual above the noise matters"
    )
    besides = [m.name for m in selection.problem.model.mistakes]
    besides += [s.name for s in scatter if s.found]
    unlike = sorted(c.name for c in selection.best.chosen if c.group == EVENT)
    if len(unlike) > 1:  # a single flight that differs is regarded as an accident
        besides += unlike
    if besides:
        return result.KNOWN, "", [f"besides {' and '.join(besides)}, {nothing}"], set()
    return result.NO_EFFECT, "", [nothing], set()


def _list_by_block(selection: Selector) -> dict[str, list[int]]:
    """Return the selected effects that act on each block; empty without a calm phase to compare
    with, as the residuals then show a wrong form.
    """
    blocks = defaultdict(list)
    for j in selection.names if compares_phases(selection.nominal) else ():
        blocks[selection.block_of(j)].append(j)
    blocks.pop("", None)
    return blocks


def _excess(level: Level) -> str:
    unit = "N m" if "torque" in level.block else "N"
    return (
        f"{level.block} in phase {level.phase}: {level.after:.2g} {unit} remain,"
        f" {level.after / level.quiet:.1f} times the quietest phase ({level.nats:.0f} nats)"
    )


def _is_on_bound(selection: Selector, j: int) -> bool:
    """Return whether an estimate lies on its bound and the evidence beyond it exceeds the
    threshold.
    """
    point = selection.best.point
    priors = selection.problem.priors
    size = point.theta[j]
    nearest = min(abs(size - priors.low[j]), abs(size - priors.high[j]))
    push = point.statistics.score[:, j].sum()
    if nearest >= SMALL_STEP or push * size <= 0.0:
        return False
    return bool(0.5 * push**2 / point.information[j, j] > selection.threshold)

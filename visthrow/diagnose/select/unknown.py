"""Laws outside the catalogue: which term of the grammar explains what is left, and whether it beats the catalogue's names.

A term needs no simulation: its column is G phi, with G the derivatives by the latent forces and phi the term at their knots. So
thousands of terms are screened with the statistics at hand; the best are then weighed with noise levels of their own.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import lapack

from visthrow.diagnose.likelihood import grammar
from visthrow.diagnose.likelihood import noise as noise_levels
from visthrow.diagnose.likelihood.designs import Same
from visthrow.diagnose.likelihood.evidence import Priors, covariance, estimate, log_evidence
from visthrow.diagnose.likelihood.marginal import Gram, Integral, Noise
from visthrow.diagnose.likelihood.stack import Integrals
from visthrow.diagnose.likelihood.threads import each
from visthrow.diagnose.models.interface import LATENT_BLOCKS
from visthrow.diagnose.select.consistency import LEAST_FLIGHTS, differ
from visthrow.diagnose.select.excess import acts_on
from visthrow.diagnose.select.point import Point, advantage, regathered, shifted
from visthrow.diagnose.select.result import Law
from visthrow.diagnose.select.screening import calmed, carries, distinct, felt, gains, screen, usual
from visthrow.diagnose.select.state import SearchState

MARGIN = 6.0
"""Nats by which a term must be ahead of the catalogue's best."""

JOINS = 16.0
"""Nats from which a term joins names that all keep their places: what names leave over that are not quite right looks like one."""

WEIGHED = 5
"""Terms that are weighed with noise levels of their own."""

HOPELESS = 0.5
"""Of what names bring where the model stands alone, by the linear statistics, that a term instead of them must bring to be weighed.
Of three laws that the catalogue does not hold the true term brought 1.9, 7 and 107 times as much as the names that stood for it."""

REACH = 3.0
"""Prior deviation of a term's root mean square force, in the block's strongest latent force."""

NARROW = 1e-3
"""Floor of a term in its prior deviation: a term is there or it is not."""

MATERIAL = 0.5
"""Root mean square force of a term, in the block's usual latent force, below which it does not matter: that of a gust moves a
landing by 5 mm within half a second."""

FORM = 1.0
"""Share of a term by which flights may differ: at knots a tenth of a second apart a law of the thrust's slope is a rough one."""

ANY_SIZE = 1e3
"""Prior deviation of a name of any size, in its usual one."""

REMAINDER = 0.05
"""Share of a term's evidence below which a name beside it is what the term's form, weighed without a simulation, leaves over."""


@dataclass(frozen=True)
class Hypothesis:
    """One or two terms beside the names of a set."""

    terms: tuple[grammar.Term, ...]
    scale: tuple[float, ...]  # coefficient of each term at its prior deviation times NARROW
    point: Point  # extended by the terms as last effects
    priors: Priors
    active: tuple[int, ...]  # with the terms
    nats: float  # over the same set without the last term, less the last term's price
    catalogue: Priors  # without the terms
    price: float  # sum over the terms of the log of the number of terms as simple as it

    @property
    def value(self) -> float:
        """Evidence, comparable with that of a set of names; every term pays its price."""
        return self.point.evidence(self.priors, self.active) - self.price

    def net(self, least: float) -> float:
        """Value, each name at the price of the threshold."""
        return self.value - least * len(self.names)

    @property
    def names(self) -> tuple[int, ...]:
        """Effects of the catalogue beside the terms."""
        return self.active[: len(self.active) - len(self.terms)]

    def laws(self) -> tuple[Law, ...]:
        """Coefficients and their deviations."""
        sigma = covariance(self.point.information, self.priors.deviation(self.active))
        mean = sigma @ self.point.score
        last = slice(len(mean) - len(self.terms), None)
        sizes, sds = mean[last] * self.scale, np.sqrt(np.diag(sigma)[last]) * self.scale
        return tuple(
            Law(t.formula, t.block, t.factors, t.vector, float(size), float(sd), t.unit, float(self.nats))
            for t, size, sd in zip(self.terms, sizes, sds)
        )

    def without_terms(self) -> Point:
        """The point with the terms at their best coefficients, their residuals taken out, for the catalogue's effects."""
        count = len(self.point.theta) - len(self.terms)
        best = (covariance(self.point.information, self.priors.deviation(self.active)) @ self.point.score)[count:]
        statistics = self.point.plain
        taken = statistics.information[:, :count, count:] @ best
        inner = replace(statistics, information=statistics.information[:, :count, :count],
                        score=statistics.score[:, :count] - taken, theta=statistics.theta[:count])  # fmt: skip
        theta = estimate(inner.information.sum(0), inner.absolute.sum(0), self.catalogue, self.names)
        return replace(self.point, theta=theta, plain=inner)


def _extended(
    point: Point, priors: Priors, term: grammar.Term, prior: float, known: Sequence[grammar.Known]
) -> tuple[Point, Priors]:
    """The same point with the term as its last effect, measured in NARROW of its prior deviation."""
    scale, layout = NARROW * prior, grammar.Layout.of([term])

    def longer(w: int) -> tuple[Gram, Integral]:
        gram, column = point.grams[w], np.zeros(point.grams[w].latents)
        if carries(gram.latent_block, term.block):
            values = scale * layout.table(known[w]).ravel()
            knots = grammar.through_latents(point.windows[w], known[w], term.block) @ values
            column = np.ravel(lapack.dtrtrs(gram.factor, knots[:, None], lower=1)[0])
        gram = _with_column(gram, column)
        return gram, _with_last(point.integrals[w], gram, point.noise)

    grams, integrals = zip(*each(longer, range(len(point.grams))))
    wide = Priors(
        np.append(priors.floor, scale), np.append(priors.slab, 1.0 / NARROW), np.append(priors.low, -np.inf),
        np.append(priors.high, np.inf), np.append(priors.visible, True),
    )  # fmt: skip
    return regathered(point, Integrals(integrals), raw=(), theta=np.append(point.theta, 0.0), grams=grams), wide


def _with_column(gram: Gram, column: np.ndarray) -> Gram:
    """Append G column as an effect; ``column`` is in the gram's own latents."""
    part = slice(gram.nuisances, gram.nuisances + gram.latents)
    along = gram.inner[:, :, part] @ column
    size = along.shape[1]
    inner = np.empty((len(along), size + 1, size + 1))  # at once: two concatenations would take the time of a product of windows
    inner[:, :size, :size], inner[:, :size, size], inner[:, size, :size] = gram.inner, along, along
    inner[:, size, size] = along[:, part] @ column
    cross = np.concatenate((gram.cross, (gram.cross[:, part] @ column)[:, None]), axis=1)
    return replace(gram, inner=inner, cross=cross)


def _with_last(known: Integral, gram: Gram, noise: Noise) -> Integral:
    """The integral of a gram to which one effect was appended."""
    size, count = len(known.level), len(known.information)
    last = noise.scale**-2.0 @ gram.inner[:, :, -1]
    half = lapack.dtrtrs(known.factor, (known.level * last[:size])[:, None], lower=1)[0]
    own = last[size:] - np.append(known.half, half, axis=1).T @ half[:, 0]
    information = np.zeros((count + 1, count + 1))
    information[:count, :count], information[count], information[:, count] = known.information, own, own
    return replace(known, information=information, half=np.append(known.half, half, axis=1))


def _weigh(point: Point, priors: Priors, active: Sequence[int], term: grammar.Term, prior: float, price: float,
           known: Sequence[grammar.Known], beside: Hypothesis | None = None) -> Hypothesis:  # fmt: skip
    """Give a term noise levels of its own and compare with the set without it."""
    base, wide = _extended(point, priors, term, prior, known)
    named = [*active, len(point.theta)]
    catalogue = beside.catalogue if beside else priors
    change = estimate(base.information, base.score, wide, named) - base.theta
    own = regathered(base, noise=noise_levels.refit([shifted(g, change) for g in base.grams], base.noise, base.device))
    nats = advantage(wide, (own, named), (base, list(active))) - price
    terms_, scales, paid = (beside.terms, beside.scale, beside.price) if beside else ((), (), 0.0)
    return Hypothesis((*terms_, term), (*scales, NARROW * prior), own, wide, tuple(named), float(nats), catalogue, paid + price)


def _known(point: Point) -> list[grammar.Known]:
    """Quantities at the knots of each window."""
    return [grammar.Known(window.knots) for window in point.windows]


def hypotheses(point: Point, priors: Priors, active: Sequence[int], strongest: dict[str, float], least: float,
               beside: Hypothesis | None = None, instead: Sequence[int] = (),
               enough: Callable[[Hypothesis], bool] | None = None) -> list[Hypothesis]:  # fmt: skip
    """The best terms beside a set of names, best first.

    Args:
        point: of the set.
        priors: of the effects.
        active: the set.
        strongest: latent force of each block where the model stood alone [N or N m].
        least: nats below which no term is weighed.
        beside: a first term that ``point`` already holds.
        instead: names that terms are to take the place of, where these are not hopeless.
        enough: whether no other need be weighed after one.
    """
    calm, parts = calmed(point)
    information, score = calm.information, calm.score
    named, bare = (log_evidence(information, score, priors, names) for names in ([*active, *instead], list(active)))
    known = _known(point)
    screens = {block: of for block in strongest if (of := screen(calm, parts, block, known)) is not None}
    depths = [term.depth for of in screens.values() for term in of.terms]
    price = {depth: float(np.log(sum(d <= depth for d in depths))) for depth in set(depths)}
    found: list[tuple[float, grammar.Term, float]] = []
    for block, of in screens.items():
        gain, prior = gains(calm, priors, active, of, REACH * strongest[block])
        gain -= [price[term.depth] for term in of.terms]
        found += [(float(gain[i]), of.terms[i], float(prior[i])) for i in distinct(gain, of, WEIGHED)]
    found = sorted((f for f in found if f[0] > max(least, HOPELESS * (named - bare))), key=lambda f: -f[0])[:WEIGHED]
    stand: list[Hypothesis] = []
    for _, term, prior in found:
        h = _weigh(point, priors, active, term, prior, price[term.depth], known, beside)
        if h.nats > least and _matters(h, known) and not _differs(h):
            stand.append(h)
            if enough is not None and enough(h):
                break
    return sorted(stand, key=lambda h: -h.nats)


def _differs(hypothesis: Hypothesis) -> bool:
    """Whether the flights tell different things of the last term."""
    statistics = hypothesis.point.statistics
    own = statistics.information[:, -1, -1]
    return len(own) >= LEAST_FLIGHTS and differ(own, statistics.score[:, -1] + own * statistics.theta[-1], FORM)


def _matters(hypothesis: Hypothesis, known: Sequence[grammar.Known]) -> bool:
    """Whether the last term's force, in the phase where it is strongest, exceeds what does not matter in a block it acts in."""
    term, law, point = hypothesis.terms[-1], hypothesis.laws()[-1], hypothesis.point
    layout = grammar.Layout.of([term])
    square: dict[tuple[int, str], list[float]] = {}
    for window, gram, own in zip(point.windows, point.grams, known):
        if carries(gram.latent_block, term.block):
            for block, values in grammar.loads(term.block, own, layout.table(own)).items():
                square.setdefault((LATENT_BLOCKS.index(block), window.phase), []).append(float((values**2).sum((1, 2)).mean()))
    common = {block: usual(point.noise.latent_sd, block) for block, _ in square}
    return any(abs(law.coefficient) * np.sqrt(np.mean(values)) > MATERIAL * common[block] for (block, _), values in square.items())


@dataclass(frozen=True)
class Answer:
    """What the grammar has to say: sets of names and terms, the best first, each net of its prices."""

    strongest: tuple[Hypothesis, ...] = ()  # the first possibly of two terms
    hasty: bool = False  # whether the look ended with one that was enough


def outside(search: SearchState) -> bool:
    """Whether a search that has come to several names follows a law that the catalogue does not hold.

    It does where a term makes at least two names superfluous.
    """
    answer = find_laws(search, lambda h: len(beats_the_catalogue(search, Answer((h,)))[1]) > 1)
    return len(beats_the_catalogue(search, answer)[1]) > 1


def follows_a_law(search: SearchState) -> bool:
    """Whether a term that the catalogue does not hold explains the flights better than what a search has named."""
    answer = find_laws(search, lambda h: beats_the_catalogue(search, Answer((h,)))[0] is not None)
    return beats_the_catalogue(search, answer)[0] is not None


def find_laws(search: SearchState, enough: Callable[[Hypothesis], bool] | None = None) -> Answer:
    """Look for terms that explain the flights instead of the names found, instead of some of them, and beside them.

    Args:
        search: that has named what it could; where nothing has changed, it is not asked again.
        enough: which one is all that is asked for where derivatives are from elsewhere: they will be taken anew before it is told.
    """
    state = Same((search.nominal, search.point)), tuple(search.active)
    if search.answer is None or search.answer[0] != state:
        answer = _look(search, enough if search.away else None)
        if answer.hasty:
            return answer
        search.answer = state, answer
    return search.answer[1]


def _look(search: SearchState, enough: Callable[[Hypothesis], bool] | None) -> Answer:
    strongest: dict[str, float] = {}
    for (block, _), level in search.nominal.noise.latent_sd.items():
        name = LATENT_BLOCKS[block]
        strongest[name] = max(strongest.get(name, 0.0), level)
    if set(strongest) == set(LATENT_BLOCKS):
        strongest[grammar.JOINT] = strongest[felt(grammar.JOINT)]
    if not all(w.knots for w in search.nominal.windows) or not strongest:
        return Answer()
    priors, least = search.priors, search.least
    alone = hypotheses(search.nominal, priors, (), strongest, least, instead=search.active, enough=enough)
    if enough is not None and any(map(enough, alone)):
        return Answer(tuple(alone), hasty=True)
    found = [(h, search.nominal) for h in alone]
    if search.active:
        beside = hypotheses(search.point, priors, search.active, strongest, least)
        found += [(h, search.point) for h in _as_told(search, [_pruned(h, least) for h in beside])]
    found = _ordered(found, least)
    best = [h for h, _ in found]
    if best and best[0].nats > least + MARGIN:
        best[:1] = _paired(search, *found[0], strongest)
    return Answer(tuple(best))


def _ordered(found: Sequence[tuple[Hypothesis, Point]], least: float) -> list[tuple[Hypothesis, Point]]:
    """Best first; of those within ``MARGIN`` of the best the one with the fewest names: others are not needed beside a law."""
    top = max((h.net(least) for h, _ in found), default=0.0)

    def rank(item: tuple[Hypothesis, Point]) -> tuple[bool, int, float]:
        net = item[0].net(least)
        close = net > top - MARGIN
        return not close, len(item[0].names) if close else 0, -net

    return sorted(found, key=rank)


def _paired(search: SearchState, first: Hypothesis, origin: Point, strongest: dict[str, float]) -> list[Hypothesis]:
    """The best hypothesis, after it joined by a second term or replaced by one that makes it superfluous where there is such."""
    least = search.least
    pairs = hypotheses(first.point, first.priors, first.active, strongest, least + MARGIN, first)
    if not pairs or pairs[0].nats <= least + MARGIN:
        return [first]
    pair = pairs[0]
    second = [j for j in pair.active if j != len(pair.priors.floor) - 2]
    if pair.point.evidence(pair.priors, pair.active) - pair.point.evidence(pair.priors, second) > least:
        return [pair, first]
    own = _weigh(origin, search.priors, first.names, pair.terms[-1], pair.scale[-1] / NARROW, pair.price - first.price,
                 _known(origin))  # fmt: skip
    return sorted((own, first), key=lambda h: -h.net(least))


def _pruned(hypothesis: Hypothesis, least: float, remainder: float = REMAINDER) -> Hypothesis:
    """Without the names that are not worth their threshold beside the term, or a share of its evidence, the weakest first."""
    point, priors, active = hypothesis.point, hypothesis.priors, list(hypothesis.active)
    count = len(hypothesis.terms)
    while names := active[:-count]:
        whole = point.evidence(priors, active)
        worth = {j: whole - point.evidence(priors, [k for k in active if k != j]) for j in names}
        weakest = min(worth, key=worth.get)
        if worth[weakest] > max(least, remainder * (whole - hypothesis.price - point.evidence(priors, names))):
            break
        active.remove(weakest)
    return replace(hypothesis, active=tuple(active))


def _as_told(search: SearchState, beside: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Hypotheses without the names that will be withdrawn for them, if a law is ahead of the catalogue without these.

    Beside a name in its block a wrong form explains as much as the right one: the name takes up what the form lacks.
    """
    told = [_without(h, withdrawn_for(search, h)) for h in beside]
    ahead = max((h.net(search.least) - _catalogue(search, h) for h in told), default=-np.inf)
    return told if ahead > MARGIN else list(beside)


def _without(hypothesis: Hypothesis, names: set[int]) -> Hypothesis:
    return replace(hypothesis, active=tuple(j for j in hypothesis.active if j not in names))


def withdrawn_for(search: SearchState, hypothesis: Hypothesis) -> set[int]:
    """Names that are not told beside a law: those that act in its block may be a part of its form.

    A name acts there by its column or by what the other names cannot stand in for, as two delays that differ by a force. What is
    worth nothing without those that act there is not told either.
    """
    blocks, names = {term.block for term in hypothesis.terms}, search.active
    joint = grammar.JOINT in blocks
    near = {j for j in names if acts_on(search.point, j, joint=joint) in blocks}
    for j in set(names) - near:
        others = [k for k in names if k != j]
        if others and acts_on(search.point, j, joint=joint, beside=others) in blocks:
            near.add(j)
    left = _without(hypothesis, near)
    return set(names) - set((_pruned(left, search.least, 0.0) if near else left).names)


def beats_the_catalogue(search: SearchState, answer: Answer) -> tuple[Hypothesis | None, set[int], str]:
    """Whether a term must replace or join the catalogue's names.

    Returns:
        The hypothesis, the names that are withdrawn for it, and the reason in words; None, nothing and "" where none must.
    """
    for best in answer.strongest:
        withdrawn = set(search.active) - set(best.names)
        if len(withdrawn) == 1 and beyond(best, *withdrawn) < MARGIN:
            continue
        if withdrawn:
            ahead = best.net(search.least) - _catalogue(search, best)
            if ahead > MARGIN:
                said = f"{_text(best)} explains the flights better than {_names(search)}, by {ahead:.0f} nats"
                return best, withdrawn, said
        elif best.nats > max(search.least + MARGIN, JOINS):
            return best, set(), f"{_text(best)} is missing besides what the catalogue holds ({best.nats:.0f} nats)"
    return None, set(), ""


def _catalogue(search: SearchState, hypothesis: Hypothesis) -> float:
    """Value of the names alone, where the search stands or with the residuals and noise levels of the hypothesis.

    Outliers lose weight anew at each linearisation, so that the evidence at two of them is not quite of the same data.
    """
    own = search.point.evidence(search.priors, search.active)
    there = hypothesis.point.evidence(hypothesis.priors, search.active)
    return max(own, there) - search.least * len(search.active)


def beyond(hypothesis: Hypothesis, j: int) -> float:
    """Nats that the last term explains and a name, whatever its size, does not; none where both are the same form.

    A term has neither bounds nor a usual size. It must not take the place of a name that says the same only because the name lies
    at its bound, or is larger than was expected.
    """
    last = len(hypothesis.priors.floor) - 1
    deviation = hypothesis.priors.deviation([k for k in hypothesis.active if k != last])
    deviation[[j, last]] = ANY_SIZE * hypothesis.priors.slab[j], 0.0
    information, score = hypothesis.point.information, hypothesis.point.score
    known = covariance(information, deviation) @ np.column_stack((information[:, last], score))
    own, left = information[last, last] - information[last] @ known[:, 0], score[last] - information[last] @ known[:, 1]
    return float(0.5 * left**2 / max(own, 1e-300))


def _names(search: SearchState) -> str:
    return ", ".join(search.name(j) for j in search.active)


def _text(hypothesis: Hypothesis) -> str:
    return " and ".join(f"{law.formula}, c = {law.coefficient:.3g} ± {law.sd:.2g} {law.unit}" for law in hypothesis.laws())

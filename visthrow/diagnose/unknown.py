"""Laws outside the catalogue: which term of the grammar explains what is left, and whether it beats the catalogue's names.

A term needs no simulation: its column is G phi, with G the derivatives by the latent forces and phi the term at their knots. So
thousands of terms are screened with the statistics at hand; the best are then weighed with noise levels of their own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from visthrow.diagnose import grammar
from visthrow.diagnose import noise as noise_levels
from visthrow.diagnose.consistency import LEAST_FLIGHTS, differ
from visthrow.diagnose.evidence import Priors, covariance, estimate
from visthrow.diagnose.marginal import Gram, WindowStatistics, gather, window_statistics
from visthrow.diagnose.model import LATENT_BLOCKS
from visthrow.diagnose.point import Point, advantage, shifted
from visthrow.diagnose.result import Law

if TYPE_CHECKING:
    from visthrow.diagnose.search import Search

MARGIN = 6.0
"""Nats by which a term must be ahead of the catalogue's best."""

WEIGHED = 5
"""Terms that are weighed with noise levels of their own."""

REACH = 3.0
"""Prior deviation of a term's root mean square force, in the block's strongest latent force."""

NARROW = 1e-3
"""Floor of a term in its prior deviation: a term is there or it is not."""

MATERIAL = 0.5
"""Root mean square force of a term, in the block's usual latent force, below which it does not matter: that of a gust moves a
landing by 5 mm within half a second."""

ROUGHER = 2.0
"""While terms are screened, no phase is rougher than so many times the usual."""

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
        statistics = self.point.statistics
        taken = statistics.information[:, :count, count:] @ best
        inner = replace(statistics, information=statistics.information[:, :count, :count],
                        score=statistics.score[:, :count] - taken, theta=statistics.theta[:count])  # fmt: skip
        theta = estimate(inner.information.sum(0), inner.absolute.sum(0), self.catalogue, self.names)
        return replace(self.point, theta=theta, statistics=inner)


@lru_cache(maxsize=32)
def _terms(block: str, known: tuple[str, ...]) -> tuple[grammar.Term, ...]:
    return tuple(grammar.terms(block, known))


@dataclass
class _Screen:
    """Information of all terms about one point, summed over windows."""

    terms: list[grammar.Term]
    size: np.ndarray  # root mean square over the knots, shape (T,)
    own: np.ndarray  # shape (T,)
    score: np.ndarray
    cross: np.ndarray  # with the effects, shape (T, K)


def _columns(point: Point, window: int, block: str, terms_: Sequence[grammar.Term]) -> np.ndarray:
    w = point.windows[window]
    if not np.any(w.latent_block == LATENT_BLOCKS.index(block)):
        return np.zeros((len(w.latent_block), len(terms_)))
    values = grammar.table_of(terms_, w.knots)
    return grammar.coefficients(w.latent_block, w.latent_axis, w.latent_time, w.knots["time"], block, values)


def _calm(point: Point) -> tuple[Point, list[WindowStatistics]]:
    """The point as if no phase were much rougher than is usual in its block, and the statistics of its windows.

    A force that the model lacks is taken for gusts in the phases in which it acts; there no term of it would stand out.
    """
    levels = point.noise.latent_sd
    limits = {}
    for block in {block for block, _ in levels}:
        limits[block] = ROUGHER * _usual(levels, block)
    noise = replace(point.noise, latent_sd={key: min(level, limits[key[0]]) for key, level in levels.items()})
    parts = [window_statistics(gram, noise, w) for w, gram in enumerate(point.grams)]
    return replace(point, noise=noise, statistics=gather(point.grams, parts, point.theta)), parts


def _usual(levels: Mapping[tuple[int, str], float], block: int) -> float:
    """The lower median of a block's levels; the least of a phase with few windows may be anything."""
    own = sorted(level for (b, _), level in levels.items() if b == block)
    return own[(len(own) - 1) // 2]


def _screen(point: Point, parts: Sequence[WindowStatistics], block: str) -> _Screen | None:
    """Gather what each term of a block says; None where the windows carry no knots for any."""
    index = LATENT_BLOCKS.index(block)
    knots = [set(w.knots) for w in point.windows if np.any(w.latent_block == index)]
    known = set.intersection(*knots) if knots else set()
    terms_ = _terms(block, tuple(sorted(known))) if "time" in known else ()
    if not terms_:
        return None
    count, effects = len(terms_), len(point.theta)
    own, score, cross, square = np.zeros(count), np.zeros(count), np.zeros((count, effects)), np.zeros(count)
    rows = 0
    for w, (gram, part) in enumerate(zip(point.grams, parts)):
        if not np.any(gram.latent_block == index):
            continue
        columns = _columns(point, w, block, terms_)
        own += np.einsum("lt,lm,mt->t", columns, part.latent_information, columns, optimize=True)
        score += columns.T @ (part.latent_score + part.latent_effects @ point.theta)
        cross += columns.T @ part.latent_effects
        square += (columns**2).sum(0)
        rows += int((gram.latent_block == index).sum()) // 3
    return _Screen(list(terms_), np.sqrt(square / max(rows, 1)), own, score, cross)


def _gains(point: Point, priors: Priors, active: Sequence[int], screen: _Screen, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Nats of each term, and its prior deviation."""
    sigma = covariance(point.information, priors.deviation(list(active)))
    own = np.maximum(screen.own - np.einsum("tk,kl,tl->t", screen.cross, sigma, screen.cross, optimize=True), 0.0)
    score = screen.score - screen.cross @ (sigma @ point.score)
    prior = reach / np.maximum(screen.size, 1e-12 * screen.size.max() + 1e-300)
    gain = -0.5 * np.log1p(prior**2 * own) + 0.5 * score**2 / (own + prior**-2.0)
    gain[screen.size <= 1e-9 * screen.size.max()] = -np.inf
    return gain, prior


def _extended(point: Point, priors: Priors, term: grammar.Term, prior: float) -> tuple[Point, Priors]:
    """The same point with the term as its last effect, measured in NARROW of its prior deviation."""
    scale = NARROW * prior
    raw = [_with_column(g, scale * _columns(point, w, term.block, [term])[:, 0]) for w, g in enumerate(point.raw)]
    wide = Priors(
        np.append(priors.floor, scale), np.append(priors.slab, 1.0 / NARROW), np.append(priors.low, -np.inf),
        np.append(priors.high, np.inf), np.append(priors.visible, True),
    )  # fmt: skip
    return _rebuilt(replace(point, raw=raw, theta=np.append(point.theta, 0.0)), point.noise), wide


def _with_column(gram: Gram, column: np.ndarray) -> Gram:
    """Append G column as an effect; only for a gram whose latents are still at the knots."""
    part = slice(gram.nuisances, gram.nuisances + gram.latents)
    along = gram.inner[:, :, part] @ column
    own = along[:, part] @ column
    inner = np.concatenate((gram.inner, along[:, :, None]), axis=2)
    last = np.concatenate((along, own[:, None]), axis=1)
    cross = np.concatenate((gram.cross, (gram.cross[:, part] @ column)[:, None]), axis=1)
    return replace(gram, inner=np.concatenate((inner, last[:, None, :]), axis=1), cross=cross)


def _rebuilt(point: Point, noise) -> Point:
    from visthrow.diagnose.marginal import correlated

    grams = [correlated(g, w, noise.correlation_time) for g, w in zip(point.raw, point.windows)]
    parts = [window_statistics(gram, noise, w) for w, gram in enumerate(grams)]
    return replace(point, grams=grams, noise=noise, statistics=gather(grams, parts, point.theta))


def _weigh(point: Point, priors: Priors, active: Sequence[int], term: grammar.Term, prior: float, price: float,
           beside: Hypothesis | None = None) -> Hypothesis:  # fmt: skip
    """Give a term noise levels of its own and compare with the set without it."""
    base, wide = _extended(point, priors, term, prior)
    named = [*active, len(point.theta)]
    catalogue = beside.catalogue if beside else priors
    change = estimate(base.information, base.score, wide, named) - base.theta
    noise, _ = noise_levels.fit(base.windows, [shifted(g, change) for g in base.raw], base.noise)
    own = _rebuilt(base, noise)
    nats = advantage(wide, (own, named), (base, list(active))) - price
    terms_, scales, paid = (beside.terms, beside.scale, beside.price) if beside else ((), (), 0.0)
    return Hypothesis((*terms_, term), (*scales, NARROW * prior), own, wide, tuple(named), float(nats), catalogue, paid + price)


def hypotheses(point: Point, priors: Priors, active: Sequence[int], strongest: dict[str, float], least: float,
               beside: Hypothesis | None = None) -> list[Hypothesis]:  # fmt: skip
    """The best terms beside a set of names, best first.

    Args:
        point: of the set.
        priors: of the effects.
        active: the set.
        strongest: latent force of each block where the model stood alone [N or N m].
        least: nats below which no term is weighed.
        beside: a first term that ``point`` already holds.
    """
    calm, parts = _calm(point)
    screens = {block: screen for block in strongest if (screen := _screen(calm, parts, block)) is not None}
    depths = [term.depth for screen in screens.values() for term in screen.terms]
    price = {depth: float(np.log(sum(d <= depth for d in depths))) for depth in set(depths)}
    found: list[tuple[float, grammar.Term, float]] = []
    for block, screen in screens.items():
        gain, prior = _gains(calm, priors, active, screen, REACH * strongest[block])
        gain -= [price[term.depth] for term in screen.terms]
        found += [(float(gain[i]), screen.terms[i], float(prior[i])) for i in _distinct(gain, screen)]
    found = sorted((f for f in found if f[0] > least), key=lambda f: -f[0])[:WEIGHED]
    weighed = [_weigh(point, priors, active, term, prior, price[term.depth], beside) for _, term, prior in found]
    return sorted((h for h in weighed if h.nats > least and _matters(h) and not _differs(h)), key=lambda h: -h.nats)


def _differs(hypothesis: Hypothesis) -> bool:
    """Whether the flights tell different things of the last term."""
    statistics = hypothesis.point.statistics
    own = statistics.information[:, -1, -1]
    return len(own) >= LEAST_FLIGHTS and differ(own, statistics.score[:, -1] + own * statistics.theta[-1], FORM)


def _matters(hypothesis: Hypothesis) -> bool:
    """Whether the last term's force, in the phase where it is strongest, exceeds what does not matter."""
    term, law, point = hypothesis.terms[-1], hypothesis.laws()[-1], hypothesis.point
    index = LATENT_BLOCKS.index(term.block)
    square: dict[str, list[float]] = {}
    for w in point.windows:
        if np.any(w.latent_block == index):
            square.setdefault(w.phase, []).append(float((term.values(w.knots) ** 2).sum(1).mean()))
    force = abs(law.coefficient) * np.sqrt(max(float(np.mean(values)) for values in square.values()))
    return force > MATERIAL * _usual(point.noise.latent_sd, index)


def _distinct(gain: np.ndarray, screen: _Screen) -> list[int]:
    """The best terms, without those that are a simpler one in other words in these flights."""
    kept: list[int] = []
    unit = screen.score / np.maximum(screen.size, 1e-300)
    for i in np.argsort(-gain, kind="stable")[: 8 * WEIGHED]:
        if len(kept) == WEIGHED or not np.isfinite(gain[i]):
            break
        if not any(np.isclose(abs(unit[i]), abs(unit[k]), rtol=1e-3) for k in kept):
            kept.append(int(i))
    return kept


@dataclass(frozen=True)
class Answer:
    """What the grammar has to say: sets of names and terms, the best first, each net of its prices."""

    strongest: tuple[Hypothesis, ...] = ()  # the first possibly of two terms


def outside(search: "Search") -> bool:
    """Whether a search that has come to several names follows a law that the catalogue does not hold.

    It does where a term makes at least two names superfluous.
    """
    return len(beats_the_catalogue(search, find_laws(search))[1]) > 1


def find_laws(search: "Search") -> Answer:
    """Look for terms that explain the flights instead of the names found, instead of some of them, and beside them."""
    strongest: dict[str, float] = {}
    for (block, _), level in search.nominal.noise.latent_sd.items():
        name = LATENT_BLOCKS[block]
        strongest[name] = max(strongest.get(name, 0.0), level)
    if not all(w.knots for w in search.nominal.windows) or not strongest:
        return Answer()
    priors, least = search.priors, search.least
    found = [(h, search.nominal) for h in hypotheses(search.nominal, priors, (), strongest, least)]
    if search.active:
        beside = hypotheses(search.point, priors, search.active, strongest, least)
        found += [(_pruned(h, least), search.point) for h in beside]
    found.sort(key=lambda h: -h[0].net(least))
    best = [h for h, _ in found]
    if best and best[0].nats > least + MARGIN:
        best[:1] = _paired(search, *found[0], strongest)
    return Answer(tuple(best))


def _paired(search: "Search", first: Hypothesis, origin: Point, strongest: dict[str, float]) -> list[Hypothesis]:
    """The best hypothesis, after it joined by a second term or replaced by one that makes it superfluous where there is such."""
    least = search.least
    pairs = hypotheses(first.point, first.priors, first.active, strongest, least + MARGIN, first)
    if not pairs or pairs[0].nats <= least + MARGIN:
        return [first]
    pair = pairs[0]
    second = [j for j in pair.active if j != len(pair.priors.floor) - 2]
    if pair.point.evidence(pair.priors, pair.active) - pair.point.evidence(pair.priors, second) > least:
        return [pair, first]
    own = _weigh(origin, search.priors, first.names, pair.terms[-1], pair.scale[-1] / NARROW, pair.price - first.price)
    return sorted((own, first), key=lambda h: -h.net(least))


def _pruned(hypothesis: Hypothesis, least: float) -> Hypothesis:
    """Without the names that are not worth their threshold beside the term, the weakest first."""
    point, priors, active = hypothesis.point, hypothesis.priors, list(hypothesis.active)
    count = len(hypothesis.terms)
    while names := active[:-count]:
        whole = point.evidence(priors, active)
        worth = {j: whole - point.evidence(priors, [k for k in active if k != j]) for j in names}
        weakest = min(worth, key=worth.get)
        if worth[weakest] > max(least, REMAINDER * (whole - hypothesis.price - point.evidence(priors, names))):
            break
        active.remove(weakest)
    return replace(hypothesis, active=tuple(active))


def beats_the_catalogue(search: "Search", answer: Answer) -> tuple[Hypothesis | None, set[int], str]:
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
        elif best.nats > search.least + MARGIN:
            return best, set(), f"{_text(best)} is missing besides what the catalogue holds ({best.nats:.0f} nats)"
    return None, set(), ""


def _catalogue(search: "Search", hypothesis: Hypothesis) -> float:
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


def _names(search: "Search") -> str:
    return ", ".join(search.name(j) for j in search.active)


def _text(hypothesis: Hypothesis) -> str:
    return " and ".join(f"{law.formula}, c = {law.coefficient:.3g} ± {law.sd:.2g} {law.unit}" for law in hypothesis.laws())

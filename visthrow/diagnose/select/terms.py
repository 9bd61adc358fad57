"""Screen terms of laws that the catalogue does not contain, and offer the best as further effects.

The column of a term is G A v, with the derivatives G by the latent forces, the matrix A from forces
at the knots to latent forces, and the term's values v at the knots. So thousands of terms are
screened without a simulation: each window needs A' G' V^-1 G A only, with V as in
:mod:`visthrow.diagnose.likelihood.marginal`. The best terms become effects of the problem
(:attr:`visthrow.diagnose.select.point.Problem.terms`), and are selected like any other effect."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy import ndarray
from scipy.linalg import solve_triangular

from visthrow.diagnose.likelihood.evidence import STRONG, UNKNOWN_RATIO
from visthrow.diagnose.likelihood.grammar import TermEffect, through_latents
from visthrow.diagnose.likelihood.integrals import Integrals
from visthrow.diagnose.likelihood.marginal import (
    Statistics,
    correlate_all,
    grams_of,
    merge_channels,
    with_latent_effects,
)
from visthrow.diagnose.models.law_terms import (
    JOINT,
    SCALARS,
    SYMBOLS,
    VECTORS,
    KnotValues,
    Term,
    carries,
    table,
    terms_of,
)
from visthrow.diagnose.models.model_interface import LATENT_BLOCKS, Indices
from visthrow.diagnose.select.excess import LANDING, positions_of
from visthrow.diagnose.select.point import Point, regather, with_shares, with_terms
from visthrow.diagnose.select.result import Law

LAW = 2.0 * STRONG
"""Evidence beyond every single effect that a term needs, and additional penalty of an effect in a
block in which a law acts [nats].
"""

NARROW = 1e-3
"""Floor of a term, relative to its prior deviation: a term is practically present or absent."""

SAME = 1e-9  # smallest share of a term's information that is not rounding

PIECES = 7
"""Points between which a curve is linear: enough to distinguish a step from a line. With 5 or 9,
the evidence differs by a few nats.
"""

OUTER = 1.0, 99.0  # percentiles of a scalar between which these points lie
LEAST_REACH = 1e-6  # span of the points of a constant scalar

WEIGHED = 6  # terms that are offered as effects at once


@dataclass
class Screen:
    """Information and scores of all terms, or curves, at one point, summed over windows.

    A term is one column of latent forces; a curve has ``m`` columns, see :func:`best_curves`."""

    terms: tuple[Term, ...]
    size: ndarray  # root mean square over the knots, shape (T,)
    information: ndarray  # shape (T, m, m)
    score: ndarray  # shape (T, m)
    cross: ndarray  # with the effects, shape (T, m, K)


def acts_in(laws: Iterable[str]) -> set[str]:
    """Return the latent blocks on which laws of these blocks act.

    A law of rotors or air exerts both force and torque. A law of the rope's joint acts on all
    blocks."""
    blocks = set(laws)
    if JOINT in blocks:
        return set(LATENT_BLOCKS)
    bodies = {block.partition(" ")[0] for block in blocks}
    return {block for block in LATENT_BLOCKS if block.partition(" ")[0] in bodies}


def level_block(block: str) -> str:
    """Return the latent block whose level is the scale for a term's size."""
    return "vehicle torque" if block == JOINT else block


def with_capped_gusts(point: Point) -> tuple[Point, Statistics]:
    """Limit the latent forces of each phase to a multiple of their block's median, and return the
    point and the statistics of its windows with latents as further effects.

    A missing force raises the level of latent forces in the phases in which it acts. Without the
    limit, no term would stand out there. Each flight's random shares are held at their
    estimates."""
    levels = point.noise.latent_sd
    limits = {}
    for block in {block for block, _ in levels}:  # not the minimum: few windows may make it small
        of_phases = [level for (b, _), level in levels.items() if b == block]
        limits[block] = UNKNOWN_RATIO * np.percentile(of_phases, 50, method="lower")
    capped = {key: min(level, limits[key[0]]) for key, level in levels.items()}
    noise = replace(point.noise, latent_sd=capped)
    grams = with_shares(point, point.theta)
    extended = [with_latent_effects(merge_channels(gram, noise.scale)) for gram in grams]
    unscaled = replace(noise, scale=np.ones(1))
    parts = Integrals(extended, unscaled).statistics(extended, point.theta)
    plain = parts.first(len(point.theta)).sum_by(parts.flights)
    return replace(point, noise=noise, grams=grams, plain=plain, shares={}), parts


class Survey:
    """Information of windows about forces at their knots, given a set of selected effects."""

    def __init__(self, point: Point, parts: Statistics, active: Indices):
        """Store a point and the statistics of its windows; ``active``: the selected effects."""
        posterior = point.posterior
        self.point = point
        self.parts = parts
        self.knots = [KnotValues(window.knots) for window in point.windows]
        self.deviation = posterior.priors.deviation(active)
        self.sigma = posterior.covariance(active)
        self.mean = self.sigma @ posterior.score

    def screen(self, block: str, curves: bool = False) -> Screen | None:
        """Sum up the information about each term of a block, or each curve; None if the windows
        have no knots for it.
        """
        point = self.point
        carriers = [w for w, gram in enumerate(point.grams) if carries(gram.latent_block, block)]
        names = [set(point.windows[w].knots) for w in carriers]
        shared = tuple(sorted(set.intersection(*names))) if names else ()
        terms = terms_of(block, shared) if "time" in shared else ()
        if not terms:
            return None
        values_of = partial(_proportional, terms)
        if curves:
            terms = tuple(term for term in terms if len(term.factors) == 1)
            values_of = partial(_hats, terms, _places(terms, [self.knots[w] for w in carriers]))
        parts = [self._in_window(w, block, values_of) for w in carriers]
        square, knots, information, score, cross = map(sum, zip(*parts))
        return Screen(terms, np.sqrt(square / max(knots, 1)), information, score, cross)

    def _in_window(
        self, w: int, block: str, values_of: Callable[[KnotValues], ndarray]
    ) -> tuple[ndarray, int, ndarray, ndarray, ndarray]:
        """Return sum of squares, number of knots, information, score and cross information of all
        terms in a window.
        """
        gram = self.point.grams[w]
        count = len(self.point.theta)
        latents = slice(count, count + gram.latents)
        of_latents = self.parts.information[w, latents]
        transfer = through_latents(self.point.windows[w], self.knots[w], block)
        values = values_of(self.knots[w])
        terms, columns = values.shape[2:]
        values = values.reshape(transfer.shape[1], -1)
        acting = gram.latent_block == LATENT_BLOCKS.index(level_block(block))
        exerted = transfer[acting] @ values
        square = (exerted**2).sum(0).reshape(terms, columns).sum(1)
        carried = solve_triangular(gram.factor, transfer, lower=True)
        informed = carried.T @ of_latents[:, latents] @ carried @ values
        score = self.parts.absolute.score[w, latents] @ carried @ values
        cross = (values.T @ (carried.T @ of_latents[:, :count])).reshape(terms, columns, -1)
        parts = (part.reshape(-1, terms, columns) for part in (values, informed))
        information = np.einsum("lti,ltj->tij", *parts)
        return square, int(acting.sum()) // 3, information, score.reshape(terms, columns), cross

    def _condition_terms(self, screened: Screen) -> tuple[ndarray, ndarray]:
        """Return information and score of each term, conditional on the selected effects."""
        cross = screened.cross
        known = np.einsum("tik,kl,tjl->tij", cross, self.sigma, cross, optimize=True)
        information = screened.information - known
        diagonal = np.einsum("tii->ti", information)  # a view
        np.maximum(diagonal, 0.0, out=diagonal)
        return information, screened.score - cross @ self.mean

    def gains(self, screened: Screen, reach: float) -> tuple[ndarray, ndarray]:
        """Return the gain of each term beside the selected effects [nats], and its prior deviation,
        which corresponds to ``reach`` at the knots.
        """
        information, score = self._condition_terms(screened)
        size = screened.size
        most = screened.size.max()
        prior = reach / np.maximum(size, 1e-12 * most + 1e-300)
        variance = prior[:, None] ** 2
        precision = np.eye(score.shape[1]) + variance[:, None] * information
        sizes = np.linalg.solve(precision, (variance * score)[..., None])[..., 0]
        gain = 0.5 * ((score * sizes).sum(1) - np.linalg.slogdet(precision)[1])
        gain[size <= 1e-9 * most] = -np.inf
        return gain, prior

    def unsaid(self, screened: Screen, causes: Indices) -> ndarray:
        """Return the gain of each term that no single effect of any size could replace [nats],
        shape (T,).

        Unlike effects, a term has neither bounds nor a typical size. It must not replace an
        equivalent effect only because that effect is at its bound or unusually large."""
        information, score = self._condition_terms(screened)
        information = information[:, 0, 0]
        score = score[:, 0]
        shared = (screened.cross[:, 0] @ self.sigma)[:, causes]
        variance = self.deviation**2
        spread = np.maximum(variance - self.sigma.diagonal(), SAME * variance)[causes]
        curvature = np.maximum(
            information[:, None] - shared**2 / spread, SAME * information[:, None]
        )
        slope = score[:, None] - shared * self.mean[causes] / spread
        return (0.5 * slope**2 / np.maximum(curvature, 1e-300)).min(axis=1, initial=np.inf)


def _proportional(terms: Sequence[Term], values: KnotValues) -> ndarray:
    """Return the values of terms at the knots, one column each, shape (k, 3, T, 1)."""
    return table(terms, values)[..., None]


def _places(terms: Sequence[Term], values: Sequence[KnotValues]) -> dict[str, ndarray]:
    """Return the points at which a curve of each scalar may bend, evenly over its range in the
    flights, shape (m,) each.
    """
    places = {}
    for name in {term.factors[0] for term in terms}:
        flown = np.concatenate([SCALARS[name].read(v) for v in values])
        low, high = np.percentile(flown, OUTER)
        places[name] = np.linspace(low, max(high, low + LEAST_REACH), PIECES)
    return places


def _hats(terms: Sequence[Term], places: Mapping[str, ndarray], values: KnotValues) -> ndarray:
    """Return the values of curves, hat functions of a scalar times a vector, shape (k, 3, T, m).

    ``terms``: every scalar with every vector."""
    number = np.arange(PIECES)
    vectors = VECTORS[terms[0].block]
    names = dict.fromkeys(term.vector for term in terms)
    directions = np.stack([vectors[name].read(values) for name in names], axis=-1)
    hats = []
    for (name,) in dict.fromkeys(term.factors for term in terms):
        place = np.interp(SCALARS[name].read(values), places[name], number)
        hats.append(np.maximum(1.0 - np.abs(place[:, None] - number), 0.0))
    of_scalars = np.stack(hats, axis=1)
    every = of_scalars[:, None, :, None] * directions[:, :, None, :, None]
    return every.reshape(len(directions), 3, len(terms), PIECES)


def best_curves(
    point: Point, active: Indices, strongest: Mapping[str, float]
) -> dict[str, tuple[float, str]]:
    """Return the gain of the best curve of each block beside the selected effects [nats], minus the
    log of the number of curves, and its formula; blocks without knots are missing.

    A curve is a force f(q) v along a vector v, with a function f of one scalar q that is linear
    between ``PIECES`` points. It checks whether the selected effects have the right form: if they
    have, no curve gains anything. ``strongest``: latent force of each block with nothing selected
    [N or N m]; the prior deviation of f v at each point is ``UNKNOWN_RATIO`` times it."""
    if not strongest:
        return {}
    survey = Survey(*with_capped_gusts(point), active)
    curves = {}
    for block, force in strongest.items():
        screened = survey.screen(block, curves=True)
        if screened is None:
            continue
        gain, _ = survey.gains(screened, UNKNOWN_RATIO * force)
        best = np.argmax(gain)
        scalar, vector = screened.terms[best].parts
        formula = f"{SYMBOLS[block]} = f({scalar.symbol}) {vector.symbol}"
        curves[block] = gain[best] - np.log(len(gain)), formula
    return curves


def extend(points: Sequence[Point], terms: Sequence[TermEffect]) -> list[Point]:
    """Add terms of size 0 to points of one problem, without simulation."""
    problem = points[0].problem
    wide = replace(problem, terms=(*problem.terms, *terms))
    channels = len(problem.model.channels)
    none = np.zeros(len(terms))
    widened = []
    for point in points:
        windows = [with_terms(window, terms, none) for window in point.windows]
        grams = grams_of(windows, wide.priors.floor, channels)
        grams = correlate_all(grams, windows, point.noise.correlation_time)
        theta = np.append(point.theta, none)
        widened.append(regather(point, problem=wide, theta=theta, windows=windows, grams=grams))
    return widened


def without_laws(point: Point) -> Point:
    """Return the point without the terms of its problem; residuals stay as they are."""
    problem = point.problem
    if not problem.terms:
        return point
    plain = replace(problem, terms=())
    count = len(problem.model.effects)
    windows = [replace(w, effects=w.effects[:, :count]) for w in point.windows]
    grams = []
    for gram in point.grams:
        kept = slice(gram.hidden + count)
        inner = gram.inner[:, kept, kept]
        cross = gram.cross[:, kept]
        grams.append(replace(gram, inner=inner, cross=cross))
    theta = point.theta[:count]
    return regather(point, problem=plain, theta=theta, windows=windows, grams=grams)


def shortlist(
    point: Point,
    active: Indices,
    strongest: Mapping[str, float],
    threshold: float,
) -> list[TermEffect]:
    """Return the most promising terms beside a set of selected effects, by the linear statistics,
    without those that a single effect could replace.

    ``strongest``: latent force of each block with nothing selected [N or N m]; ``threshold``:
    evidence that a term needs beyond its penalty [nats]."""
    problem = point.problem
    causes = np.flatnonzero(problem.priors.visible[: len(problem.model.effects)])
    survey = Survey(*with_capped_gusts(point), active)
    screens = {}
    for block in strongest:
        screened = survey.screen(block)
        if screened is not None:
            screens[block] = screened
    depths = [term.depth for screened in screens.values() for term in screened.terms]
    price = {}
    for depth in set(depths):
        simpler = sum(d <= depth for d in depths)
        price[depth] = np.log(simpler)
    present = {e.term for e in problem.terms}
    ranked = []
    for block, screened in screens.items():
        gain, prior = survey.gains(screened, UNKNOWN_RATIO * strongest[block])
        gain[survey.unsaid(screened, causes) < LAW] = -np.inf
        # of terms that are equivalent in these flights, keep the first and simplest
        _, first = np.unique(np.round(gain, 3), return_index=True)
        for i in first:
            term = screened.terms[i]
            nats = gain[i] - price[term.depth]
            if nats > threshold and term not in present:
                ranked.append((nats, term, prior[i]))
    best = sorted(ranked, key=lambda f: -f[0])[:WEIGHED]
    return [as_effect(term, prior, price[term.depth]) for _, term, prior in best]


def as_effect(term: Term, prior: float, price: float) -> TermEffect:
    """Make an effect of a term; ``prior``: standard deviation of its coefficient; ``price``:
    penalty beyond the threshold [nats].
    """
    return TermEffect(
        term.formula,
        "a law that the catalogue does not hold",
        term.formula,
        term.unit,
        term.block,
        (-np.inf, np.inf),
        prior,
        NARROW * prior,
        (),
        "grammar",
        term=term,
        price=price,
    )


def strongest_forces(point: Point) -> dict[str, float]:
    """Return the latent force of each block in the phase in which it is strongest [N or N m]; empty
    if a window has no knots.
    """
    strongest = defaultdict(float)
    for (block, _), level in point.noise.latent_sd.items():
        name = LATENT_BLOCKS[block]
        strongest[name] = max(strongest[name], level)
    if set(strongest) == set(LATENT_BLOCKS):
        strongest[JOINT] = strongest[level_block(JOINT)]
    return strongest if all(w.knots for w in point.windows) else {}


def moves_landing(point: Point, j: int) -> bool:
    """Return whether an effect moves a position by ``LANDING`` in the median window of a phase."""
    positions = positions_of(point)
    size = point.theta[j] * point.problem.priors.floor[j]
    moves = defaultdict(list)
    for window in point.windows:
        rows = np.isin(window.channel, positions)
        distance = np.abs(size * window.effects[rows, j]).max(initial=0.0)
        moves[window.phase].append(distance)
    return any(np.median(distances) > LANDING for distances in moves.values())


def laws(point: Point, active: Indices, nats: float) -> tuple[Law, ...]:
    """Return the terms of a set with their coefficients and deviations; ``nats``: their gain."""
    sigma = point.posterior.covariance(active)
    mean = sigma @ point.posterior.score
    effects = point.problem.effects
    columns = [j for j in active if isinstance(effects[j], TermEffect)]
    floor = np.array([effects[j].floor for j in columns])
    spread = sigma[np.ix_(columns, columns)] * np.outer(floor, floor)
    found = []
    for j, size, row, variance in zip(columns, mean[columns] * floor, spread, spread.diagonal()):
        term = effects[j].term
        sd = np.sqrt(variance)
        head = term.block, term.factors, term.vector, size, term.formula
        found.append(Law(*head, sd, term.unit, nats, tuple(row.tolist())))
    return tuple(found)

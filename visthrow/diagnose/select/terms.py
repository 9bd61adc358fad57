"""Terms of laws outside the catalogue, as further effects of a model.

The column of a term is G A v: G are the derivatives by the latent forces, A the latent forces that
anything exerted at the knots stands for, v the term's values there. So thousands of terms are
screened at once without a simulation: a window needs A' G' V^-1 G A alone, with V as in
:mod:`visthrow.diagnose.likelihood.marginal`, and all terms are a product of tables. The best become
effects of the problem (:attr:`visthrow.diagnose.select.point.Problem.terms`) and are weighed like
any other."""

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
    correlated_of,
    grams_of,
    in_one_channel,
    with_latent_effects,
)
from visthrow.diagnose.likelihood.threads import parallel_map
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
from visthrow.diagnose.models.model_interface import LATENT_BLOCKS
from visthrow.diagnose.select.excess import LANDING, positions_of
from visthrow.diagnose.select.point import Point, regathered, with_shares, with_terms
from visthrow.diagnose.select.result import Law

LAW = 2.0 * STRONG
"""Nats by which a term must be ahead where it takes the place of no name, and which a name costs
more where a law acts.
"""

NARROW = 1e-3
"""Floor of a term in its prior deviation: a term is there or it is not; the usual deviation of a
name in that of one of any size.
"""

SAME = 1e-9  # share of a term's information from which what a cause leaves of it is rounding

PIECES = 7
"""Places between which a curve is linear: enough to distinguish a step from a line. With 5 or 9 the
evidence is the same within a few nats.
"""

OUTER = 1.0, 99.0  # percentiles of what was flown, between which the places lie
LEAST_REACH = 1e-6  # span of the places of a scalar that never changes: its curve is a constant

# terms that become effects to be weighed: as many as other sets that are simulated in their place
WEIGHED = 6


@dataclass
class Screen:
    """Information of all terms, or curves, about one point, summed over windows.

    A term is one column of latent forces; a curve is ``m`` of them, see :func:`best_curves`."""

    terms: tuple[Term, ...]
    size: ndarray  # root mean square over the knots, shape (T,)
    information: ndarray  # shape (T, m, m)
    score: ndarray  # shape (T, m)
    cross: ndarray  # with the effects, shape (T, m, K)


def acts_in(laws: Iterable[str]) -> set[str]:
    """Return the latent blocks that laws of these blocks act in.

    A law of the rotors or of the air turns the vehicle as well as it pushes it. In the rope's joint
    a law acts in all blocks."""
    blocks = set(laws)
    if JOINT in blocks:
        return set(LATENT_BLOCKS)
    bodies = {block.partition(" ")[0] for block in blocks}
    return {block for block in LATENT_BLOCKS if block.partition(" ")[0] in bodies}


def level_block(block: str) -> str:
    """Latent block whose levels a term's size is measured in."""
    return "vehicle torque" if block == JOINT else block


def with_capped_gusts(point: Point) -> tuple[Point, Statistics]:
    """The point as if no phase were much rougher than is usual in its block and each flight's
    random shares were known, and the statistics of its windows with unit latents as further
    effects.

    A force that the model lacks is taken for gusts in the phases in which it acts; there no term of
    it would stand out."""
    levels = point.noise.latent_sd
    limits = {}
    for block in {block for block, _ in levels}:  # the least of a phase with few windows may be any
        of_phases = [level for (b, _), level in levels.items() if b == block]
        limits[block] = UNKNOWN_RATIO * np.percentile(of_phases, 50, method="lower")
    capped = {key: min(level, limits[key[0]]) for key, level in levels.items()}
    noise = replace(point.noise, latent_sd=capped)
    grams = with_shares(point, point.theta)
    weighed = parallel_map(partial(in_one_channel, scale=noise.scale), grams)
    extended = parallel_map(with_latent_effects, weighed)
    unscaled = replace(noise, scale=np.ones(1))
    parts = Integrals(extended, unscaled).statistics(extended, point.theta)
    plain = parts.first(len(point.theta)).by(parts.flights)
    return replace(point, noise=noise, grams=grams, plain=plain, shares={}), parts


class Survey:
    """A record of what windows say of forces at their knots beside a set of names."""

    def __init__(self, point: Point, parts: Statistics, active: Sequence[int]):
        """Keep a point and the statistics of its windows; ``active``: the names."""
        posterior = point.posterior
        self.point = point
        self.parts = parts
        self.knots = [KnotValues(window.knots) for window in point.windows]
        self.deviation = posterior.priors.deviation(active)
        self.sigma = posterior.covariance(active)
        self.mean = self.sigma @ posterior.score

    def screen(self, block: str, curves: bool = False) -> Screen | None:
        """Gather what each term of a block says, or each curve; None where the windows carry no
        knots for any.
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
        parts = parallel_map(lambda w: self._in_window(w, block, values_of), carriers)
        square, knots, information, score, cross = map(sum, zip(*parts))
        return Screen(terms, np.sqrt(square / max(knots, 1)), information, score, cross)

    def _in_window(
        self, w: int, block: str, values_of: Callable[[KnotValues], ndarray]
    ) -> tuple[ndarray, int, ndarray, ndarray, ndarray]:
        """Square, number of knots, information, score and cross information of all terms."""
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

    def _left(self, screened: Screen) -> tuple[ndarray, ndarray]:
        """Information and score of each term, of what the names leave."""
        cross = screened.cross
        known = np.einsum("tik,kl,tjl->tij", cross, self.sigma, cross, optimize=True)
        information = screened.information - known
        diagonal = np.einsum("tii->ti", information)  # a view
        np.maximum(diagonal, 0.0, out=diagonal)
        return information, screened.score - cross @ self.mean

    def gains(self, screened: Screen, reach: float) -> tuple[ndarray, ndarray]:
        """Nats of each term beside the names, and its prior deviation, which makes it ``reach``
        strong at the knots.
        """
        information, score = self._left(screened)
        size = screened.size
        most = screened.size.max()
        prior = reach / np.maximum(size, 1e-12 * most + 1e-300)
        variance = prior[:, None] ** 2
        precision = np.eye(score.shape[1]) + variance[:, None] * information
        sizes = np.linalg.solve(precision, (variance * score)[..., None])[..., 0]
        gain = 0.5 * ((score * sizes).sum(1) - np.linalg.slogdet(precision)[1])
        gain[size <= 1e-9 * most] = -np.inf
        return gain, prior

    def unsaid(self, screened: Screen, causes: Sequence[int]) -> ndarray:
        """Nats of each screened term that no single cause explains, whatever its size, beside the
        names; shape (T,).

        A term has neither bounds nor a usual size. It must not take the place of a cause that says
        the same only because the cause lies at its bound, or is larger than was expected."""
        information, score = self._left(screened)
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
    """Return terms as one column each, shape (k, 3, T, 1)."""
    return table(terms, values)[..., None]


def _places(terms: Sequence[Term], values: Sequence[KnotValues]) -> dict[str, ndarray]:
    """Return where a curve of each scalar may bend, evenly over what was flown, shape (m,) each."""
    places = {}
    for name in {term.factors[0] for term in terms}:
        flown = np.concatenate([SCALARS[name].read(v) for v in values])
        low, high = np.percentile(flown, OUTER)
        places[name] = np.linspace(low, max(high, low + LEAST_REACH), PIECES)
    return places


def _hats(terms: Sequence[Term], places: Mapping[str, ndarray], values: KnotValues) -> ndarray:
    """Return curves as hats of their scalars times their vectors, shape (k, 3, T, m).

    ``terms``: of every scalar with every vector."""
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
    point: Point, active: Sequence[int], strongest: Mapping[str, float]
) -> dict[str, tuple[float, str]]:
    """Return the nats that the best curve of each block brings beside a set of names, less the log
    of how many were tried, and its formula; none of a block that the windows carry no knots for.

    A curve is a force f(q) v along a vector v, with any function f of one scalar q: pieces that
    are linear between ``PIECES`` places. It tells whether names have the right form. No name is
    given up for a law that is a little better: a curve that holds no more than the names say
    brings nothing. ``strongest``: latent force of each block where the model stood alone [N or
    N m]; the prior deviation of f v is ``UNKNOWN_RATIO`` of it at each place."""
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


def extended(points: Sequence[Point], terms: Sequence[TermEffect]) -> list[Point]:
    """Points of one problem with more terms as effects, at 0; nothing is simulated again."""
    problem = points[0].problem
    wide = replace(problem, terms=(*problem.terms, *terms))
    channels = len(problem.model.channels)
    none = np.zeros(len(terms))
    widened = []
    for point in points:
        windows = parallel_map(lambda w: with_terms(w, terms, none), point.windows)
        grams = grams_of(windows, wide.priors.floor, channels)
        grams = correlated_of(grams, windows, point.noise.correlation_time)
        theta = np.append(point.theta, none)
        widened.append(regathered(point, problem=wide, theta=theta, windows=windows, grams=grams))
    return widened


def without_laws(point: Point) -> Point:
    """The point of its problem without terms, whose shares are left out of the residuals where they
    are not 0.
    """
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
    return regathered(point, problem=plain, theta=theta, windows=windows, grams=grams)


def shortlist(
    point: Point,
    active: Sequence[int],
    strongest: Mapping[str, float],
    threshold: float,
) -> list[TermEffect]:
    """The terms that say most beside a set of names and what no single cause says, by the linear
    statistics.

    ``strongest``: latent force of each block where the model stood alone [N or N m]; ``threshold``:
    nats that a term must bring beyond its price."""
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
    ranked: list[tuple[float, Term, float]] = []
    for block, screened in screens.items():
        gain, prior = survey.gains(screened, UNKNOWN_RATIO * strongest[block])
        gain[survey.unsaid(screened, causes) < LAW] = -np.inf
        # of terms that say the same in other words in these flights, the simplest comes first
        _, first = np.unique(np.round(gain, 3), return_index=True)
        for i in first:
            term = screened.terms[i]
            nats = gain[i] - price[term.depth]
            if nats > threshold and term not in present:
                ranked.append((nats, term, prior[i]))
    best = sorted(ranked, key=lambda f: -f[0])[:WEIGHED]
    return [as_effect(term, prior, price[term.depth]) for _, term, prior in best]


def as_effect(term: Term, prior: float, price: float) -> TermEffect:
    """A term as an effect, with the prior deviation of its coefficient and what it costs beyond the
    threshold [nats].
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
    """Latent force of each block in the phase where it is strongest [N or N m]; none where a window
    has no knots.
    """
    strongest: dict[str, float] = {}
    for (block, _), level in point.noise.latent_sd.items():
        name = LATENT_BLOCKS[block]
        strongest[name] = max(strongest.get(name, 0.0), level)
    if set(strongest) == set(LATENT_BLOCKS):
        strongest[JOINT] = strongest[level_block(JOINT)]
    return strongest if all(w.knots for w in point.windows) else {}


def moves_landing(point: Point, j: int) -> bool:
    """Whether an effect moves a position by ``LANDING`` within the median window of a phase."""
    positions = positions_of(point)
    size = point.theta[j] * point.problem.priors.floor[j]
    moves: dict[str, list[float]] = {}
    for window in point.windows:
        rows = np.isin(window.channel, positions)
        distance = np.abs(size * window.effects[rows, j]).max(initial=0.0)
        moves.setdefault(window.phase, []).append(distance)
    return any(np.median(distances) > LANDING for distances in moves.values())


def laws(point: Point, active: Sequence[int], nats: float) -> tuple[Law, ...]:
    """The terms of a set with coefficients and deviations; ``nats`` is what they bring."""
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

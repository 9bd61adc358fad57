"""What varies from flight to flight or from day to day: random effects, each weighed by the same
evidence as a name.

A flight, or a day, has its own share of an effect, normal about what all share, with a deviation
theta that is looked for. The shares are integrated out of the statistics (:func:`freed`), the size
that all share may be any that its prior allows, and effects that are not named stay below their
floors. The evidence of theta against that of none says whether the effect varies, and more evidence
for shares of days than for shares of flights that it drifts. A flight far from the others is
simulated again at other sizes: a release 40 ms early tells twice of it by its derivative.

Source: Laird and Ware 1982 (random effects).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.interpolate import CubicSpline

from sim.effects.effect import Effect, RandomEffect
from visthrow.config.effects import random_effects
from visthrow.diagnose.likelihood.evidence import (
    INEXACT,
    Priors,
    additions,
    covariance,
    estimate,
    log_evidence,
)
from visthrow.diagnose.likelihood.marginal import Statistics

FLIGHT = "flight"  # what may differ: from flight to flight, from day to day, among commands
DAY = "day"
COMMAND = "command"
# before these, at the end of the names of effects that differ and are none of the catalogue's
# random effects
FORM = "_by_"
LEAST_FLIGHTS = 4  # or days: with fewer a deviation is anybody's guess
REACH = np.geomspace(0.02, 6.0, 25)  # deviations that are tried, in their prior's
LOOK = 5  # every fifth of them is tried where flights are left out
# floors of a flight's own estimate from which its derivative is not relied upon
UNRELIABLE_FLOORS = 3.0
SIZES = np.array([-1.0, -0.7, -0.45, -0.25, -0.1, 0.0, 0.1, 0.25, 0.45, 0.7, 1.0])
"""At which flights are simulated again, in the largest estimate of any flight."""
FINE = 400  # places between them at which a curve is looked at
CHAIN = 2
"""More effects that differ, or more names, are a wrong form, which brings one after the other:
terms are weighed at once, and in a block whose latent forces stay excessive none is told.
"""


@dataclass(frozen=True)
class Scatter:
    """The verdict on one quantity that may vary."""

    name: str
    cause: str
    equation: str
    block: str
    unit: str
    of: tuple[str, ...]
    found: bool
    size: float  # most probable deviation [unit]
    low: float  # 95 % interval [unit]
    high: float
    floor: float  # [unit]
    nats: float  # of evidence that it varies at all
    flights: int  # or days or commands, that say something about it
    manoeuvres: tuple[str, ...] = ()
    by: str = FLIGHT  # or DAY, or COMMAND

    @property
    def sentence(self) -> str:
        """For people."""
        size = (
            f"{self.name} = {self.size:.3g} {self.unit} (95 %: {self.low:.3g} to {self.high:.3g})"
        )
        drifts = "drifts, a value for each day. " if self.by == DAY else ""
        return f"{drifts}{self.cause}: {size}, {self.nats:.0f} nats from {self.flights} {self.by}s."


@dataclass(frozen=True)
class Varies:
    """Effects that have shares of their own: by the effect's number, the deviation of the shares in
    its floor.
    """

    days: Sequence[int] = ()  # of each flight, by its number; none where nobody told
    flights: Mapping[int, float] = field(default_factory=dict)  # shares of flights
    drifts: Mapping[int, float] = field(default_factory=dict)  # shares of days

    def __bool__(self) -> bool:
        return bool(self.flights or self.drifts)

    @property
    def effects(self) -> dict[int, float]:
        """Deviations of all."""
        return {**self.flights, **self.drifts}

    @property
    def by_flight(self) -> "Varies":
        """Return these random effects as if every flight were a day: of days of which only some
        flights are looked at.
        """
        return Varies((), self.effects)

    def also(
        self, columns: Sequence[int], size: Mapping[int, float], group: str = FLIGHT
    ) -> "Varies":
        """Return these random effects with more of them."""
        new = {j: size[j] for j in columns}
        return (
            replace(self, drifts={**self.drifts, **new})
            if group == DAY
            else replace(self, flights={**self.flights, **new})
        )

    def levels(self, statistics: Statistics) -> tuple[str, ...]:
        """Return what may have shares: days too, where there are enough of them, each of several
        flights.
        """
        days = {self.days[f] for f in statistics.flights.tolist()} if self.days else ()
        return (FLIGHT, DAY) if LEAST_FLIGHTS <= len(days) < len(statistics.flights) else (FLIGHT,)


def varying(
    statistics: Statistics,
    theta: np.ndarray,
    priors: Priors,
    names: Sequence[str],
    threshold: float,
    simulate: Callable[[np.ndarray], Statistics | None] | None = None,
    further: Sequence[RandomEffect] = (),
    active: Sequence[int] = (),
    days: Sequence[int] = (),
) -> tuple[Scatter, ...]:
    """Verdicts on everything that may vary among these flights.

    Args:
        theta: sizes found, in floors, shape (K,).
        threshold: nats that a finding needs.
        simulate: the flights simulated at other sizes, in floors; None where that fails.
        further: what may vary besides the catalogue's random effects; told where it does.
        active: effects that are named.
        days: of each flight, by its number; none where nobody told.
    """
    effect_names = list(names)
    verdicts = {}
    selected = Varies(days)
    may_vary = [*(v for v in random_effects() if v.of), *further]
    columns = {
        v.name: [
            j
            for name in v.of
            if name in effect_names and priors.visible[j := effect_names.index(name)]
        ]
        for v in may_vary
    }
    price = {
        v: threshold + (np.log(len(theta)) if v in further else 0.0) for v in may_vary
    }  # of all effects, one varies more by chance
    for _ in range(CHAIN + 1):
        context = priors, selected, active
        likely = _likely(freed(statistics, selected), priors, active, threshold) if further else ()
        free = [
            v
            for v in may_vary
            if not (v.name in verdicts and verdicts[v.name].found)
            and (v not in further or likely[columns[v.name]].any())
        ]
        new = {
            v: s
            for v in free
            if (s := _verdict(v, statistics, columns[v.name], price[v], *context)) is not None
        }
        positive = [
            v
            for v, s in new.items()
            if s.found and not _one_alone(v, statistics, columns[v.name], *context)
        ]
        verdicts |= {v.name: replace(s, found=False) for v, s in new.items() if v not in further}
        best = max(positive, key=lambda v: new[v].nats, default=None)
        if best is None:
            break
        verdicts[best.name] = new[best]
        if simulate is not None and len(columns[best.name]) == 1:
            statistics = straightened(statistics, theta, priors, columns[best.name][0], simulate)
            verdicts[best.name] = _verdict(
                best, statistics, columns[best.name], price[best], *context
            )
            if not verdicts[best.name].found:
                break
        selected = selected.also(
            columns[best.name], verdicts[best.name].size / priors.floor, verdicts[best.name].by
        )
    forms = {
        v.name for v in further
    }  # whose names say what has the shares: the catalogue's random effects need no such
    return tuple(
        replace(s, name=f"{s.name}{FORM}{s.by}") if s.name in forms else s
        for s in verdicts.values()
    )


def by_flight(effects: Sequence[Effect]) -> tuple[RandomEffect, ...]:
    """Every effect as one that differs from flight to flight, but for those of the catalogue's
    random effects.
    """
    covered = {name for v in random_effects() for name in v.of}
    return tuple(
        RandomEffect(
            e.name,
            f"{e.cause}, now more, now less",
            f"{e.name} ~ N({e.name}, theta^2) in each flight",
            (e.name,),
            e.unit,
            e.block,
            e.prior_sd,
            e.floor,
            e.source,
            manoeuvres=tuple(e.manoeuvres),
        )
        for e in effects
        if e.name not in covered
    )


def straightened(
    statistics: Statistics,
    theta: np.ndarray,
    priors: Priors,
    j: int,
    simulate: Callable[[np.ndarray], Statistics | None],
) -> Statistics:
    """Statistics whose scores are those about the size of one effect at which each flight fits best
    by itself.

    ``theta``: sizes found, in floors; ``simulate``: see :func:`varying`.
    """
    shift = (statistics.information @ (theta - statistics.theta))[:, j]
    diagonal = statistics.information[:, j, j]
    score = statistics.score[:, j] - shift
    reach = np.abs(
        np.divide(score, diagonal, out=np.zeros_like(diagonal), where=diagonal > 0.0)
    ).max(initial=0.0)
    if reach < UNRELIABLE_FLOORS:
        return statistics
    sizes = []
    simulated = []
    for size in np.unique(
        np.clip(theta[j] + reach * SIZES, priors.low[j], priors.high[j]) - theta[j]
    ):
        statistics_moved = simulate(np.where(np.arange(len(theta)) == j, theta + size, theta))
        if statistics_moved is not None:
            sizes = [*sizes, size]
            simulated = [*simulated, statistics_moved]
    if len(sizes) < len(SIZES) // 2:
        return statistics
    squares = np.array([statistics_moved.square for statistics_moved in simulated])
    curve = CubicSpline(sizes, squares)
    best = np.argmin(squares, axis=0)
    scores = statistics.score.copy()
    for f in np.flatnonzero(diagonal > 0.0):
        grid = np.linspace(
            sizes[max(best[f] - 1, 0)], sizes[min(best[f] + 1, len(sizes) - 1)], FINE
        )
        position = np.where(
            np.arange(len(theta)) == j, theta + grid[np.argmin(curve(grid)[:, f])], theta
        )
        information = statistics.information[f]
        misfit = simulated[best[f]].score[f]
        scores[f] = (
            misfit
            - information[:, j] * misfit[j] / diagonal[f]
            + information @ (position - statistics.theta)
        )
    return replace(statistics, score=scores)


def _likely(
    statistics: Statistics, priors: Priors, active: Sequence[int], threshold: float
) -> np.ndarray:
    """Which effects may vary by more than ``threshold`` nats, as if there were no other that could
    in their stead, shape (K,).
    """
    theta = covariance(
        statistics.information.sum(0), priors.deviation(list(active))
    ) @ statistics.absolute.sum(0)
    precision = np.maximum(np.diagonal(statistics.information, axis1=1, axis2=2), 1e-12)
    square = (statistics.absolute - statistics.information @ theta) ** 2 / precision
    part = precision * (REACH[::LOOK, None, None] * priors.slab) ** 2
    return (0.5 * (square * part / (1.0 + part) - np.log1p(part)).sum(1)).max(0) > threshold


def _verdict(
    v: RandomEffect,
    statistics: Statistics,
    columns: Sequence[int],
    threshold: float,
    priors: Priors,
    selected: Varies,
    active: Sequence[int],
) -> Scatter | None:
    """The verdict on one quantity, at the level that says more; None where too few flights say
    something of it.
    """
    reach = REACH * v.prior_sd
    verdicts = []
    for group in selected.levels(statistics):
        groups = by_day(statistics, selected.days) if group == DAY else statistics
        informed = np.count_nonzero((groups.information[:, columns, columns] > 0.0).any(axis=1))
        if informed >= LEAST_FLIGHTS:
            verdicts.append(
                judged(
                    v,
                    reach,
                    _nats_of_sizes(statistics, columns, reach, priors, selected, active, group),
                    threshold,
                    int(informed),
                    group,
                )
            )
    return max(verdicts, key=lambda s: s.nats, default=None)


def judged(
    v: RandomEffect,
    reach: np.ndarray,
    nats: np.ndarray,
    threshold: float,
    flights: int,
    group: str = FLIGHT,
) -> Scatter:
    """The verdict on a quantity by the evidence of its sizes.

    Args:
        reach: sizes that were tried, from small to large, above 0.
        nats: of evidence of each against none.
        threshold: that a finding needs.
        flights: or days or commands, that say something of it.
        group: what has shares.
    """
    size = np.append(0.0, np.geomspace(reach[0], reach[-1], FINE))
    spline = CubicSpline(np.log(reach), nats)
    value = np.append(0.0, spline(np.log(size[1:])))
    weight = (
        np.gradient(size)
        * np.sqrt(2.0 / np.pi)
        / v.prior_sd
        * np.exp(-0.5 * (size / v.prior_sd) ** 2)
    )
    best = value.max()
    density = np.exp(value - best) * weight
    share = np.cumsum(density) / density.sum()
    low, high = (float(size[np.searchsorted(share, q)]) for q in (0.025, 0.975))
    nats = float(np.log(density.sum()) + best)
    mode = float(size[np.argmax(density / np.gradient(size))])
    return Scatter(
        v.name,
        v.cause,
        v.equation,
        v.block,
        v.unit,
        tuple(v.of),
        nats > threshold and mode > v.floor,
        mode,
        low,
        high,
        v.floor,
        nats,
        flights,
        v.manoeuvres,
        group,
    )


def _nats_of_sizes(
    statistics: Statistics,
    columns: Sequence[int],
    sizes: np.ndarray,
    priors: Priors,
    selected: Varies,
    active: Sequence[int],
    group: str = FLIGHT,
) -> np.ndarray:
    """Nats of deviations of some effects against none, beside what varies already; all flights may
    share any size of these effects.
    """
    named = sorted({*active, *columns})
    nothing = _evidence(freed(statistics, selected), priors, named)
    return np.array(
        [
            _evidence(
                freed(statistics, selected.also(columns, size / priors.floor, group)), priors, named
            )
            - nothing
            for size in sizes
        ]
    )


def disagreement(
    statistics: Statistics,
    priors: Priors,
    selected: Varies,
    active: Sequence[int],
    j: int,
    threshold: float,
    share: float = INEXACT,
) -> tuple[int | None] | None:
    """Whether flights disagree on an effect of a set: shares of their own say more than a floor and
    a part of the effect's size would.

    ``threshold``: nats that a finding needs; ``share``: of the effect, by which flights may differ
    for its form alone. Returns the flight that alone disagrees, or None in its place where all do;
    None where they agree, too few can say, or other effects that are still missing may be why they
    differ."""
    if np.count_nonzero(statistics.information[:, j, j] > 0.0) < LEAST_FLIGHTS:
        return None

    def differ(statistics: Statistics, active: Sequence[int]) -> bool:
        freed_flights = freed(statistics, selected)
        size = estimate(
            freed_flights.information.sum(0), freed_flights.absolute.sum(0), priors, active
        )[j]
        least_sd = max(allowed(size, share), selected.effects.get(j, 0.0))
        reach = least_sd * np.geomspace(
            1.0, max(REACH[-1] * priors.slab[j] / least_sd, 2.0), len(REACH[::LOOK])
        )
        nats = _nats_of_sizes(statistics, [j], reach * priors.floor[j], priors, selected, active)
        return bool(nats.max() - nats[0] > threshold)

    if not all(
        differ(statistics, named) for named in (active, np.flatnonzero(priors.visible).tolist())
    ):
        return None
    remaining = [k for k in active if k != j]
    for f in range(len(statistics.flights)):
        other_flights = statistics.only(np.arange(len(statistics.flights)) != f)
        freed_flights = freed(other_flights, selected)
        advantage = additions(
            freed_flights.information.sum(0), freed_flights.absolute.sum(0), priors, remaining
        )[j]
        if advantage < threshold and not differ(other_flights, active):
            return (int(statistics.flights[f]),)
    return (None,)


def allowed(size: np.ndarray | float, share: float = INEXACT) -> np.ndarray | float:
    """Deviation among flights that is no disagreement: a floor, and a part of the effect's size, in
    floors.
    """
    return np.hypot(1.0, share * size)


def between_flights(
    statistics: Statistics, priors: Priors, active: Sequence[int], theta: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return the variance among flights that named effects may have, in that which is
    :func:`allowed`, and the part of it that the mean of these flights keeps, shape (K,).

    In each flight a name may have a share of its own, whose deviation is u times what is allowed.
    What the flights say of u, which is half normal before, is integrated over: one flight alone
    says nothing of it, and many that agree leave little. Where nothing is named, nothing varies.
    ``theta``: their sizes, in floors.

    Source: Laird and Ware 1982; Gelman 2006 (half-normal deviations of few groups).
    """
    information = statistics.information.diagonal(axis1=1, axis2=2)
    mean_part = ((information / np.maximum(information.sum(0), 1e-300)) ** 2).sum(
        0
    )  # 1 / F of F that say as much
    freed_flights = [
        freed(statistics, Varies(flights={j: u * allowed(theta[j]) for j in active})) for u in REACH
    ]
    value = np.array([_evidence(flights, priors, active) for flights in freed_flights])
    weight = REACH * np.exp(value - value.max() - 0.5 * REACH**2)  # steps of u grow with u
    return float(weight @ REACH**2 / weight.sum()) * bool(active), mean_part


def _evidence(statistics: Statistics, priors: Priors, named: Sequence[int]) -> float:
    total = statistics.information.sum(0), statistics.absolute.sum(0)
    return log_evidence(*total, priors, named) - 0.5 * float(statistics.absolute_square.sum())


def _one_alone(v: RandomEffect, statistics: Statistics, columns: Sequence[int], *context) -> bool:
    """Whether it is one flight alone that differs: that is an event there."""
    flights = np.arange(len(statistics.flights))
    return any(
        _nats_of_sizes(
            statistics.only(flights != f), columns, REACH[::LOOK] * v.prior_sd, *context
        ).max()
        <= 0.0
        for f in flights
    )


def freed(statistics: Statistics, varies: Varies) -> Statistics:
    """Statistics of what flights, or days, share: the shares that each has of its own are
    integrated out.

    ``varies``: effects that have such shares. Where days have some, what is returned is of days.
    """
    by_flights = _integrated(statistics, varies.flights)
    return (
        _integrated(by_day(by_flights, varies.days), varies.drifts) if varies.drifts else by_flights
    )


def freed_beside(
    information: np.ndarray,
    score: np.ndarray,
    cross: np.ndarray,
    statistics: Statistics,
    varies: Varies,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Integrate out the flights' shares for candidates that are no effects yet, each alone beside
    the effects, summed over flights.

    ``information``: information of each, shape (F, T); ``score``: about 0, shape (F, T); ``cross``:
    information with the effects, shape (F, T, K)."""
    rows = replace(statistics, score=statistics.absolute, theta=np.zeros_like(statistics.theta))
    for shares in (varies.flights, varies.drifts):
        if shares is varies.drifts and shares:
            member = _members(rows, varies.days)[1]
            information = member @ information
            score = member @ score
            cross = np.tensordot(member, cross, 1)
            rows = by_day(rows, varies.days)
        for j, size in shares.items():
            column = rows.information[:, :, j]
            cross_column = cross[:, :, j]
            part = (size**2 / (1.0 + size**2 * column[:, j]))[:, None] * cross_column
            information = information - part * cross_column
            score = score - part * rows.score[:, j, None]
            cross = cross - part[..., None] * column[:, None]
            rows = _integrated(rows, {j: size})
    return information.sum(0), score.sum(0), cross.sum(0)


def _members(statistics: Statistics, days: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Days of flights, and which flights belong to each, shape (D, F)."""
    names, row = np.unique([days[f] for f in statistics.flights.tolist()], return_inverse=True)
    return names, (row == np.arange(len(names))[:, None]).astype(float)


def by_day(statistics: Statistics, days: Sequence[int]) -> Statistics:
    """Statistics of flights added up by day; ``days`` are theirs, by the flight's number."""
    names, member = _members(statistics, days)
    return replace(
        statistics,
        flights=names,
        information=np.tensordot(member, statistics.information, 1),
        score=member @ statistics.score,
        square=member @ statistics.square,
        samples=member @ statistics.samples,
    )


def _integrated(statistics: Statistics, deviation: Mapping[int, float]) -> Statistics:
    """Statistics without the shares that each row has of some effects; ``deviation`` is theirs, in
    floors.
    """
    for j, size in deviation.items():
        column = statistics.information[:, :, j]
        score = statistics.score
        diagonal = column[:, j]
        part = size**2 / (1.0 + size**2 * diagonal)
        explained = (part[:, None] * column)[:, :, None] * column[:, None, :]
        statistics = replace(
            statistics,
            information=np.subtract(statistics.information, explained, out=explained),
            score=score - (part * score[:, j])[:, None] * column,
            square=statistics.square - part * score[:, j] ** 2 + np.log1p(size**2 * diagonal),
        )
    return statistics


def own_shares(statistics: Statistics, theta: np.ndarray, varies: Varies) -> np.ndarray:
    """Most probable share of each flight of the effects that vary, beside the sizes of all, in
    floors, shape (F, K).

    ``theta``: sizes that all flights share, in floors; ``varies``: effects that have shares. Those
    of days come first, and flights share what is left of them."""
    positions = np.tile(theta, (len(statistics.flights), 1))
    if varies.drifts:
        by_days = by_day(_integrated(statistics, varies.flights), varies.days)
        row = np.searchsorted(
            by_days.flights, [varies.days[f] for f in statistics.flights.tolist()]
        )
        positions = (
            positions
            + _shares(by_days, np.tile(theta, (len(by_days.flights), 1)), varies.drifts)[row]
        )
    return positions + _shares(statistics, positions, varies.flights) - theta


def _shares(
    statistics: Statistics, theta: np.ndarray, deviation: Mapping[int, float]
) -> np.ndarray:
    """Most probable shares of each row, beside its sizes ``theta`` (F, K)."""
    shares = np.zeros(statistics.score.shape)
    columns = list(deviation)
    if columns:
        score = (
            statistics.score
            - np.einsum("fij,fj->fi", statistics.information, theta - statistics.theta)
        )[:, columns]
        block = statistics.information[:, columns][:, :, columns] + np.diag(
            [size**-2.0 for size in deviation.values()]
        )
        shares[:, columns] = np.linalg.solve(block, score[..., None])[..., 0]
    return shares


def deviations(
    scatter: Sequence[Scatter], priors: Priors, names: Sequence[str], days: Sequence[int]
) -> Varies:
    """Return the random effects that were found, of effects of these names; ``days`` are the
    flights'.
    """
    effect_names = list(names)
    selected = Varies(days)
    for s in scatter:
        if s.found:
            selected = selected.also(
                [effect_names.index(name) for name in s.of if name in effect_names],
                s.size / priors.floor,
                s.by,
            )
    return selected


def variances(scatter: Sequence[Mapping]) -> dict[str, float]:
    """Variance of each effect among flights, from the scatter that a diagnosis' JSON tells was
    found.
    """
    return {name: float(s["size"]) ** 2 for s in scatter if s["found"] for name in s["of"]}

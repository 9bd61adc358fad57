"""What varies from flight to flight: the deviation of an effect among flights, from the scatter of the flights' own scores.

About the sizes that were found, the score u of an effect in flight f is normal with variance i + i^2 theta^2: i is the flight's
information, theta the deviation that is looked for. What all flights share of the effect is no scatter: it may have any size that
its prior allows. Effects that are not named stay below their floors and add what they could.
A flight far from the others is simulated again at other sizes: a release 40 ms early tells twice of it by its derivative.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from sim.effects.effect import RandomEffect
from visthrow.config.effects import random_effects
from visthrow.diagnose.likelihood.evidence import SPIKE, Priors
from visthrow.diagnose.likelihood.marginal import Statistics

LEAST_FLIGHTS = 4
"""With fewer a deviation is anybody's guess."""
REACH = np.geomspace(0.02, 6.0, 400)
"""Deviations that are tried, in their prior's."""
FAR = 3.0
"""Floors of a flight's own estimate from which its derivative is not relied upon."""
SIZES = np.array([-1.0, -0.7, -0.45, -0.25, -0.1, 0.0, 0.1, 0.25, 0.45, 0.7, 1.0])
"""At which flights are simulated again, in the largest estimate of any flight."""
FINE = 400
"""Places between two of them at which the best fit is looked for."""
STEEPEST = 10.0
"""By which a flight's information may differ from that of its derivative, either way."""


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
    flights: int  # that say something about it
    manoeuvres: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """For people."""
        size = f"{self.name} = {self.size:.3g} {self.unit} (95 %: {self.low:.3g} to {self.high:.3g})"
        return f"{self.cause}: {size}, {self.nats:.0f} nats from {self.flights} flights."


def varying(
    statistics: Statistics, theta: np.ndarray, priors: Priors, names: Sequence[str], least: float,
    again: Callable[[np.ndarray], Statistics | None] | None = None,
) -> tuple[Scatter, ...]:  # fmt: skip
    """Verdicts on everything that may vary among these flights.

    Args:
        statistics: of the flights.
        theta: sizes found, in floors, shape (K,).
        priors: of the effects.
        names: of the effects.
        least: nats that a finding needs.
        again: the flights simulated at other sizes, in floors; None where that fails.
    """
    known, told = list(names), {}
    drawn = np.zeros(len(theta))  # variances of what is known to vary, in floors
    may_vary = random_effects()
    for _ in may_vary:
        free = [v for v in may_vary if not (v.name in told and told[v.name].found)]
        at = {v.name: [known.index(name) for name in v.of if name in known] for v in free}
        new = [s for v in free if (s := _verdict(v, statistics, theta, priors, at[v.name], least, drawn)) is not None]
        best = max((s for s in new if s.found), key=lambda s: s.nats, default=None)
        if best is not None and again is not None and len(at[best.name]) == 1:
            v = next(v for v in free if v.name == best.name)
            statistics = straightened(statistics, theta, priors, at[v.name][0], again)
            sized = _verdict(v, statistics, theta, priors, at[v.name], least, drawn)
            new = [sized if s is best else s for s in new]
            best = sized if sized.found else None
        told |= {s.name: s for s in new if not s.found or s is best}
        if best is None:
            break
        drawn[at[best.name]] = (best.size / priors.floor[at[best.name]]) ** 2
    return tuple(told.values())


def straightened(
    statistics: Statistics, theta: np.ndarray, priors: Priors, j: int, again: Callable[[np.ndarray], Statistics | None]
) -> Statistics:
    """Statistics whose score and information of one effect are those about the size at which each flight fits best by itself.

    Args:
        statistics: of the flights.
        theta: sizes found, in floors.
        priors: with the effects' bounds.
        j: the effect.
        again: see :func:`varying`.
    """
    shift = (statistics.information @ (theta - statistics.theta))[:, j]
    own, score = statistics.information[:, j, j], statistics.score[:, j] - shift
    reach = np.abs(np.divide(score, own, out=np.zeros_like(own), where=own > 0.0)).max(initial=0.0)
    if reach < FAR:
        return statistics
    sizes, squares = [], []
    for size in np.unique(np.clip(theta[j] + reach * SIZES, priors.low[j], priors.high[j]) - theta[j]):
        there = again(np.where(np.arange(len(theta)) == j, theta + size, theta))
        if there is not None:
            sizes, squares = [*sizes, size], [*squares, there.square]
    if len(sizes) < len(SIZES) // 2:
        return statistics
    curve, fit, information = CubicSpline(sizes, squares), score.copy(), own.copy()
    best = np.argmin(squares, axis=0)
    for f in np.flatnonzero(own > 0.0):
        near = np.linspace(sizes[max(best[f] - 1, 0)], sizes[min(best[f] + 1, len(sizes) - 1)], FINE)
        size = near[np.argmin(curve(near)[:, f])]
        information[f] = np.clip(0.5 * curve(size, 2)[f], own[f] / STEEPEST, own[f] * STEEPEST)
        fit[f] = information[f] * size
    whole, scores = statistics.information.copy(), statistics.score.copy()
    steeper = np.sqrt(np.divide(information, own, out=np.ones_like(own), where=own > 0.0))[:, None]
    whole[:, j, :] *= steeper
    whole[:, :, j] *= steeper
    scores[:, j] = fit + (whole @ (theta - statistics.theta))[:, j]
    return replace(statistics, information=whole, score=scores)


def _verdict(
    v: RandomEffect, statistics: Statistics, theta: np.ndarray, priors: Priors, at: Sequence[int], least: float,
    drawn: np.ndarray,
) -> Scatter | None:
    at = [j for j in at if priors.visible[j]]
    own = statistics.information[:, at, at] if at else np.zeros((0, 0))
    seen = (own > 0.0).any(axis=1) if at else np.zeros(0, dtype=bool)
    if np.count_nonzero(seen) < LEAST_FLIGHTS:
        return None
    score = statistics.score - statistics.information @ (theta - statistics.theta)
    size = np.append(0.0, REACH * v.prior_sd)
    value = np.zeros(len(size))
    for j in at:
        i, u = statistics.information[seen, j, j], score[seen, j]
        shared = np.where(np.arange(len(theta)) == j, 0.0, SPIKE**2 + drawn)
        plain = i + statistics.information[seen][:, j] ** 2 @ shared
        spread = plain[:, None] + (i[:, None] * size / priors.floor[j]) ** 2
        value += _about_a_mean(i, u, spread, priors.slab[j])
    weight = np.gradient(size) * np.sqrt(2.0 / np.pi) / v.prior_sd * np.exp(-0.5 * (size / v.prior_sd) ** 2)
    best = value.max()
    density = np.exp(value - best) * weight
    share = np.cumsum(density) / density.sum()
    low, high = (float(size[np.searchsorted(share, q)]) for q in (0.025, 0.975))
    nats = float(np.log(density.sum()) + best - value[0])
    most = float(size[np.argmax(density / np.gradient(size))])
    return Scatter(v.name, v.cause, v.equation, v.block, v.unit, tuple(v.of), nats > least and most > v.floor, most, low, high,
                   v.floor, nats, int(np.count_nonzero(seen)), v.manoeuvres)  # fmt: skip


def _about_a_mean(information: np.ndarray, score: np.ndarray, spread: np.ndarray, slab: float) -> np.ndarray:
    """Log-likelihood of flights' scores that share a size of their own, which is integrated out.

    Args:
        information: of each flight, shape (F,).
        score: of each flight, shape (F,).
        spread: variances of the scores, shape (F, S).
        slab: deviation of the size that they share, in floors.

    Returns:
        Shape (S,).
    """
    i, u = information[:, None], score[:, None]
    alone = (-0.5 * np.log(spread) - 0.5 * u**2 / spread).sum(axis=0)
    known, towards = (i**2 / spread).sum(axis=0), (i * u / spread).sum(axis=0)
    return alone + 0.5 * towards**2 / (known + slab**-2.0) - 0.5 * np.log1p(slab**2 * known)


def freed(statistics: Statistics, deviation: Mapping[int, float]) -> Statistics:
    """Statistics of flights each of which has its own share of some effects, integrated out: what is left tells of the mean.

    Args:
        statistics: of the flights.
        deviation: of such an effect among flights, in floors.
    """
    for j, size in deviation.items():
        column, score = statistics.information[:, :, j], statistics.score
        own = column[:, j]
        part = size**2 / (1.0 + size**2 * own)
        statistics = replace(
            statistics,
            information=statistics.information - part[:, None, None] * column[:, :, None] * column[:, None, :],
            score=score - (part * score[:, j])[:, None] * column,
            square=statistics.square - part * score[:, j] ** 2 + np.log1p(size**2 * own),
        )
    return statistics


def own_shares(statistics: Statistics, theta: np.ndarray, deviation: Mapping[int, float]) -> np.ndarray:
    """Most probable share of each flight of the effects that vary, beside the sizes of all, in floors, shape (F, K).

    Args:
        statistics: of the flights.
        theta: sizes that all flights share, in floors.
        deviation: of an effect among flights, in floors.
    """
    own = np.zeros(statistics.score.shape)
    at = list(deviation)
    if at:
        left = (statistics.score - statistics.information @ (theta - statistics.theta))[:, at]
        inside = statistics.information[:, at][:, :, at] + np.diag([size**-2.0 for size in deviation.values()])
        own[:, at] = np.linalg.solve(inside, left[..., None])[..., 0]
    return own


def deviations(scatter: Sequence[Scatter], priors: Priors, names: Sequence[str]) -> dict[int, float]:
    """Deviation in floors of each effect that was found to vary, by its number."""
    known = list(names)
    return {j: s.size / float(priors.floor[j]) for s in scatter if s.found for j in map(known.index, set(s.of) & set(known))}


def variances(scatter: Sequence[Mapping]) -> dict[str, float]:
    """Variance of each effect among flights, from the scatter that a diagnosis' JSON tells was found."""
    return {name: float(s["size"]) ** 2 for s in scatter if s["found"] for name in s["of"]}

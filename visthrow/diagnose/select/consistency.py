"""Whether all flights tell the same: an effect of one flight is an event, and a flight that was copied counts once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from visthrow.diagnose.likelihood.evidence import Priors, additions, estimate
from visthrow.diagnose.models.interface import Window
from visthrow.diagnose.select.point import Point
from visthrow.diagnose.select.scatter import SHARE

LEAST_FLIGHTS = 4
"""Fewer cannot outvote one."""

CONTRADICTION = 16.0
"""Squared distance of one flight from the others, in their joint deviation (4 sigma), from which it contradicts them."""

CHANCE = 0.1
"""Probability that random signs of the flights would say as much, from which an effect is no property of the vehicle."""

EFFECTIVE = 5.0
"""Number of equally informative flights from which signs can be tested; the least probability is then 1/16."""

MOST_SIGNS = 4096

HETEROGENEOUS = 1e-4
"""Probability of the flights' estimates lying so far apart (Cochran's Q) from which an effect is no property of the vehicle."""

EDGE = 6
"""Samples of one channel, of three components each, by which windows of a copied flight may differ."""

NOISY, COPIED = 0.3, 0.2
"""Median residual, in its deviation, without which nothing tells a copy; and the median difference of copies' residuals."""


@dataclass(frozen=True)
class Consistency:
    """Why an effect is no cause."""

    flight: int | None  # the flight in which alone something happened; None where the flights differ from one another


def across_flights(
    before: Point, after: Point, priors: Priors, active: Sequence[int], added: int, least: float
) -> Consistency | None:
    """Look whether the flights agree on an effect that was added.

    Args:
        before: without it.
        after: with it.
        priors: of the effects.
        active: effects named before.
        added: the effect.
        least: threshold [nats].

    Returns:
        None where they agree, too few can say, or other effects that are still missing may be why they differ.
    """
    statistics = after.statistics
    own = statistics.information[:, added, added]
    if len(own) < LEAST_FLIGHTS or own.sum() <= 0.0:
        return None
    everything = estimate(after.information, after.score, priors, np.flatnonzero(priors.visible).tolist())
    verdicts = []
    for theta in (statistics.theta, everything):
        score = statistics.absolute[:, added] - statistics.information[:, added] @ theta + own * theta[added]
        estimates = np.divide(score, own, out=np.zeros_like(own), where=own > 0.0)
        single = None if by_chance(own, score) else _single(before, after, priors, active, added, least, estimates)
        if single is None and not differ(own, score):
            return None
        verdicts.append(Consistency(single))
    return verdicts[0]


def differ(information: np.ndarray, score: np.ndarray, share: float = SHARE) -> bool:
    """Whether flights tell so different things of one effect that it is no property of the vehicle.

    Args:
        information: of each flight, shape (F,).
        score: of each flight about 0, shape (F,).
        share: of the effect, by which they may differ for its form alone.
    """
    if by_chance(information, score):
        return True
    estimates = np.divide(score, information, out=np.zeros_like(information), where=information > 0.0)
    size = score.sum() / information.sum()
    variance = 1.0 / np.maximum(information, 1e-12) + (share * size) ** 2 + 1.0
    spread = float((((estimates - size) ** 2) / variance).sum())
    return spread > chi2.isf(HETEROGENEOUS, len(information) - 1)


def _single(before: Point, after: Point, priors: Priors, active: Sequence[int], added: int, least: float,
            estimates: np.ndarray) -> int | None:  # fmt: skip
    """The flight that alone asks for an effect which the others, who would show it, deny."""
    own = after.statistics.information[:, added, added]
    size = (own @ estimates) / own.sum()
    f = int(np.argmax(own * np.abs(estimates) * np.sign(estimates) * np.sign(size)))
    others = np.arange(len(own)) != f
    weight = own[others].sum()
    if weight <= 0.0 or (own[others] * estimates[f] ** 2 > CONTRADICTION).sum() < LEAST_FLIGHTS - 1:
        return None
    rest = (own[others] @ estimates[others]) / weight
    distance = (estimates[f] - rest) ** 2 / (1.0 / own[f] + 1.0 / weight + (SHARE * estimates[f]) ** 2 + 1.0)
    base = before.statistics
    information, score = base.information[others].sum(0), base.absolute[others].sum(0)
    alone = additions(information, score, priors, active)[added]
    expected = additions(information, information[:, added] * estimates[f], priors, active)[added]
    denied = distance > CONTRADICTION and alone < least and expected > 2.0 * least
    return int(after.statistics.flights[f]) if denied else None


def by_chance(information: np.ndarray, score: np.ndarray) -> bool:
    """Sign-flip test: whether the flights' scores would add up to as much if each had a random sign."""
    if information.sum() ** 2 < EFFECTIVE * (information**2).sum():
        return False
    count = min(2 ** len(score), MOST_SIGNS)
    if count == 2 ** len(score):
        signs = 1.0 - 2.0 * ((np.arange(count)[:, None] >> np.arange(len(score))) & 1)
    else:
        signs = np.random.default_rng(0).choice((-1.0, 1.0), (count, len(score)))
    return bool(np.mean(np.abs(signs @ score) >= abs(score.sum()) * (1.0 - 1e-12)) > CHANCE)


def repeated_flights(windows: Sequence[Window]) -> dict[int, int]:
    """Find flights whose windows repeat those of an earlier flight, whatever their clocks say.

    The last window of a flight may be too short by a sample in one of them.

    Returns:
        Flight -> the earlier flight.
    """
    by_flight: dict[int, list[Window]] = {}
    for window in windows:
        by_flight.setdefault(window.flight, []).append(window)
    repeats: dict[int, int] = {}
    for flight, own in by_flight.items():
        for earlier, others in by_flight.items():
            if earlier >= flight:
                break
            if earlier not in repeats and abs(len(own) - len(others)) <= 1 and all(map(_same, own, others)):
                repeats[flight] = earlier
                break
    return repeats


def _same(a: Window, b: Window) -> bool:
    """Whether two windows hold the same measurements: noise of two flights never agrees to a fifth of its deviation.

    A clock set forward may move a sample at either end into or out of a window.
    """
    if abs(len(a.residual) - len(b.residual)) > EDGE * len(np.unique(a.channel)) or not len(a.residual):
        return False
    normal = [w.residual / w.sigma for w in (a, b)]
    return all(_alike(*[_rough(r[w.channel == c]) for r, w in zip(normal, (a, b))]) for c in np.unique(a.channel))


def _rough(residual: np.ndarray) -> np.ndarray:
    """Second differences of each component: the noise, without what the same data may be fitted with otherwise."""
    return (residual[6:] - 2.0 * residual[3:-3] + residual[:-6]) / np.sqrt(6.0)


def _alike(one: np.ndarray, other: np.ndarray) -> bool:
    if min(len(one), len(other)) <= EDGE or np.median(np.abs(one)) < NOISY:  # a simulation's record without noise
        return False
    pairs = [(one, other), *[(x[k:], y) for x, y in ((one, other), (other, one)) for k in range(3, EDGE + 1, 3)]]
    lengths = [min(len(x), len(y)) for x, y in pairs]
    return min(np.median(np.abs(x[:n] - y[:n])) for (x, y), n in zip(pairs, lengths)) < COPIED

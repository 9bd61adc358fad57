"""Candidates of a search: sets of effects at their best sizes, each simulated with noise levels of its own."""

from collections.abc import Sequence

import numpy as np

from visthrow.diagnose.likelihood.threads import beside
from visthrow.diagnose.select.point import Point, Problem, fitted, linearise, to_gain, with_fitted_noise

TURNS, TURNED = 8, 0.5
"""Times that sizes and noise levels are estimated in turn, while the levels leave a step of the sizes worth so many nats."""


def candidate(problem: Problem, point: Point, active: Sequence[int]) -> Point:
    """Sizes of a set and the noise levels that belong to them, in turn: what gusts held at first goes over to the sizes.

    Args:
        problem: of the search.
        point: whose derivatives and noise levels it begins with.
        active: the set.
    """
    point = with_fitted_noise(fitted(problem, _switched(problem, point, active), active))
    for _ in range(TURNS):
        if to_gain(problem, point, active) < TURNED:
            break
        before, point = point, fitted(problem, point, active)
        if np.array_equal(point.theta, before.theta):
            break
        point = with_fitted_noise(point)
    return point


def candidates(problem: Problem, point: Point, sets: Sequence[Sequence[int]]) -> list[Point]:
    """The same of several sets: side by side where they wait for a GPU, but for those that turn on another kind of block."""
    if point.device == "cpu":
        return [candidate(problem, point, active) for active in sets]
    turned = [i for i, active in enumerate(sets) if _off(problem, point, active)]
    plain = [i for i in range(len(sets)) if i not in turned]
    found = {i: candidate(problem, point, sets[i]) for i in turned}
    found |= zip(plain, beside(lambda i: candidate(problem, point, sets[i]), plain))
    return [found[i] for i in range(len(sets))]


def _off(problem: Problem, point: Point, active: Sequence[int]) -> list[int]:
    """Other kinds of blocks in a set that a point does not fly."""
    return [j for j in active if problem.switches[j] and point.theta[j] == 0.0]


def _switched(problem: Problem, point: Point, active: Sequence[int]) -> Point:
    """The point, linearised with another kind of block on where a set asks for one that is off."""
    off = _off(problem, point, active)
    if not off:
        return point
    theta = np.where(np.isin(np.arange(len(point.theta)), list(active)), point.theta, 0.0)
    theta[off] = 1.0 / problem.priors.floor[off]
    return linearise(problem, theta, point.noise)

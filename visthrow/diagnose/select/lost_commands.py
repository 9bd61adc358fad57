"""Commands that got lost: a random effect of every single command.

Whether command k came is m_k, 0 or 1 with probability theta. A window shows the sum of C m, with C
the change of its samples by each command that did not come; m is taken for normal with mean theta
and variance theta (1 - theta), and integrated out. Windows of a
:attr:`visthrow.diagnose.select.point.Problem.lost` share differ by the mean, and have the rest of C
m among what is not known of them.

Source: an innovation variance (Harvey 1989) of the command channel; the likelihood of its size is
that of a random effect."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy import ndarray
from scipy.special import betaincinv

from visthrow.config.effects import random_effects
from visthrow.diagnose.likelihood.correlation import LOOKED_AT
from visthrow.diagnose.likelihood.evidence import Priors
from visthrow.diagnose.likelihood.forms import predicted
from visthrow.diagnose.likelihood.marginal import Statistics
from visthrow.diagnose.select.candidates import (
    COARSE,
    COMMAND,
    REACH,
    Scatter,
    evidence_of,
    integrated,
    judged,
)
from visthrow.diagnose.select.point import Point, statistics_of

NAME = "dropped_commands"  # of the random effect in the catalogue

EITHER = 0.5
"""Mean and deviation of m where either is as likely.

From half of it as a deviation 0 and 1 are told apart: half way is two from both.
"""


def _evidence(
    statistics: Statistics, share: float, priors: Priors, sets: Sequence[Sequence[int]]
) -> ndarray:
    """Return log Z of each set of effects where that share of the commands did not come."""
    effects = len(priors.floor)
    theta = statistics.theta.copy()
    theta[effects:] = share
    deviation = np.sqrt(share * (1.0 - share))
    commands = [(j, deviation) for j in range(effects, len(theta))]
    came = integrated(statistics.about(theta), commands).first(effects)
    return np.array([evidence_of(came, priors, named) for named in sets])


def _least_explained(point: Point) -> list[int]:
    """Return the numbers of the windows with the largest errors for their noise: one lost command
    shows in its window alone.
    """
    errors = []
    for window in point.windows:
        innovation, expected, _ = predicted(window, point.noise, window.residual)
        errors.append(np.mean(innovation**2 / expected))
    return np.sort(np.argsort(errors)[-LOOKED_AT:]).tolist()


def verdict(point: Point, active: Sequence[int], threshold: float) -> Scatter | None:
    """Whether commands got lost, beside a set of effects or any that are still missing; None where
    none was, or a model cannot tell.

    ``threshold``: nats that a finding needs.
    """
    v = next(v for v in random_effects() if v.name == NAME)
    problem = point.problem
    priors = problem.priors
    reach = REACH * v.prior_sd
    graded = priors.visible & ~problem.switches
    sets = active, np.flatnonzero(graded[: len(problem.model.effects)]).tolist()
    numbers = range(len(problem.kept))
    for rows, shares in ((_least_explained(point), reach[::COARSE]), (numbers, reach)):
        chosen = [problem.kept[w] for w in rows]
        columns = problem.model.without_commands(point.about.theta, chosen)
        if not columns:
            return None
        windows = [point.windows[w] for w in rows]
        statistics = statistics_of(point, windows, columns, rows)
        evidence = [_evidence(statistics, p, priors, sets) for p in (0.0, *shares.tolist())]
        nats = (np.array(evidence[1:]) - evidence[0]).min(axis=1)
        if nats.max() <= 0.0:
            return None
    count = sum(changes.shape[1] for changes in columns)
    return judged(v, reach, nats, threshold, count, COMMAND)


def sized(point: Point, scatter: Scatter) -> Scatter:
    """The verdict with the share of those commands of which a window tells by itself whether they
    came, with Jeffreys' interval.

    ``point``: of a model with lost commands, with the noise levels that these leave; ``scatter``:
    the verdict before."""
    windows = [point.about.windows[i] for i in point.problem.kept]
    rows = range(len(windows))
    statistics = statistics_of(point, windows, point.commands, rows)
    commands = slice(len(point.theta), None)
    half_way = np.zeros(len(statistics.theta))
    half_way[commands] = EITHER
    score = statistics.about(half_way).score[:, commands]
    information = statistics.information[:, commands, commands]
    spread = np.linalg.inv(information + np.eye(information.shape[1]) / EITHER**2)
    off = (spread @ score[..., None])[..., 0]
    variance = np.diagonal(spread, axis1=1, axis2=2)
    clear = np.sqrt(variance) < 0.5 * EITHER
    count = np.count_nonzero(clear)
    if not count:
        return scatter
    lost_commands = np.count_nonzero(clear & (off > 0.0))
    counts = lost_commands + 0.5, count - lost_commands + 0.5
    size, low, high = betaincinv(*counts, (0.5, 0.025, 0.975)).tolist()
    return replace(scatter, size=size, low=low, high=high)

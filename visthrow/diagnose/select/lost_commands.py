"""Commands that got lost: each came, or did not with probability theta.

A window shows C m, with C the change of its samples by each command that did not come, and m 0 or 1
for each. What the windows say of theta is the sum over all cases of m. It is bounded from below by
probabilities q that are independent from command to command (mean field):

    log p(r) >= log p(r | m = q) - 1/2 sum I_kk q_k (1 - q_k) - sum KL(q_k | theta)

with information I on the commands. A command that surely came costs -log(1 - theta), however
clearly it did. Windows of a problem with :attr:`visthrow.diagnose.select.point.Problem.lost`
probabilities differ by C q, and have the rest of C m among what is not known of them.

Source: Jordan, Ghahramani, Jaakkola and Saul 1999, section 6 (mean field as a lower bound)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy import ndarray
from scipy.special import betaincinv, entr, expit, logit, xlog1py, xlogy

from visthrow.config.effects import random_effects
from visthrow.diagnose.likelihood import noise_levels as levels
from visthrow.diagnose.likelihood.correlation import LOOKED_AT
from visthrow.diagnose.likelihood.evidence import Posterior, Priors
from visthrow.diagnose.likelihood.forms import predicted
from visthrow.diagnose.likelihood.marginal import Statistics
from visthrow.diagnose.select.candidates import (
    COARSE,
    COMMAND,
    REACH,
    Scatter,
    evidence_of,
    judged,
)
from visthrow.diagnose.select.point import ROUNDS, Point, statistics_of

NAME = "dropped_commands"  # of the random effect in the catalogue

EITHER = 0.5
"""Mean and deviation of m where either is as likely.

From half of it as a deviation 0 and 1 are told apart: half way is two from both.
"""


def _assume_lost(statistics: Statistics, effects: int, lost: ndarray) -> Statistics:
    """Return what windows say of the effects if so much of each command did not come, shape
    (W, T).
    """
    theta = np.tile(statistics.theta, (len(lost), 1))
    theta[:, effects:] = lost
    return statistics.about(theta).first(effects)


def divergence(lost: ndarray, share: float) -> float:
    """Return the nats that probabilities cost which differ from the share of all commands."""
    odds = xlogy(lost, share) + xlog1py(1.0 - lost, -share)
    return -float((entr(lost) + entr(1.0 - lost) + odds).sum())


def _improve(score: ndarray, information: ndarray, share: float, lost: ndarray) -> ndarray:
    """Return the probabilities that commands did not come, from a guess on, by what each window
    gains most from until all that is left is worth little.

    Args:
        score: of the commands where none was lost, shape (W, T).
        information: on them, shape (W, T, T).
    """
    lost = lost.copy()
    diagonal = information.diagonal(axis1=1, axis2=2)
    score = score - (information @ lost[..., None])[..., 0]
    rows = np.arange(len(lost))
    enough = levels.ENOUGH_NATS / lost.shape[1]
    while len(rows):
        before = lost[rows]
        field = logit(share) + score[rows] + diagonal[rows] * (before - 0.5)
        gain = np.logaddexp(0.0, field) - before * field - entr(before) - entr(1.0 - before)
        best = gain.argmax(1)
        places = np.arange(len(rows)), best
        going = gain[places] > enough
        step = (expit(field) - before)[places][going]
        rows = rows[going]
        best = best[going]
        lost[rows, best] += step
        score[rows] -= information[rows, :, best] * step[:, None]
    return lost


def _bound_evidence(
    statistics: Statistics, priors: Priors, named: Sequence[int], share: float, lost: ndarray
) -> tuple[float, ndarray]:
    """Return log Z of a set of effects where that share of the commands did not come, as a bound
    from below, and the probability of each; ``lost``: a guess of these, shape (W, T).
    """
    effects = len(priors.floor)
    information = statistics.information[:, effects:, effects:]
    on_effects = statistics.information[:, effects:, :effects]
    theta = statistics.theta[:effects]
    for _ in range(ROUNDS):
        change = theta - statistics.theta[:effects]
        lost = _improve(
            statistics.score[:, effects:] - on_effects @ change, information, share, lost
        )
        came = _assume_lost(statistics, effects, lost)
        theta = Posterior.of(came, priors).mean(named)
    unsure = lost * (1.0 - lost)
    spread = 0.5 * float((information.diagonal(axis1=1, axis2=2) * unsure).sum())
    return evidence_of(came, priors, named) - spread - divergence(lost, share), lost


def _profile(
    statistics: Statistics, priors: Priors, named: Sequence[int], shares: ndarray
) -> tuple[ndarray, list[ndarray]]:
    """Return the nats by which each share of lost commands explains windows better than none, with
    a set of effects, and the probabilities of each; ``shares``: from small to large.
    """
    effects = len(priors.floor)
    none = np.zeros_like(statistics.score[:, effects:])
    plain = evidence_of(_assume_lost(statistics, effects, none), priors, named)
    nats = []
    probabilities = []
    guess = np.full_like(none, shares[0])
    odds = logit(shares)
    for i, share in enumerate(shares.tolist()):
        if i:  # as if each command were alone
            guess = expit(logit(guess) + odds[i] - odds[i - 1])
        value, guess = _bound_evidence(statistics, priors, named, share, guess)
        nats.append(value - plain)
        probabilities.append(guess)
    return np.array(nats), probabilities


def _with_size(scatter: Scatter, information: ndarray, lost: ndarray) -> Scatter:
    """Return the verdict with the share of those commands of which a window tells by itself whether
    they came, with Jeffreys' interval; ``information``: on all commands, shape (W, T, T).
    """
    spread = np.linalg.inv(information + np.eye(lost.shape[1]) / EITHER**2)
    clear = np.sqrt(np.diagonal(spread, axis1=1, axis2=2)) < 0.5 * EITHER
    count = np.count_nonzero(clear)
    if not count:
        return scatter
    gone = float(lost[clear].sum())
    counts = gone + 0.5, count - gone + 0.5
    size, low, high = betaincinv(*counts, (0.5, 0.025, 0.975)).tolist()
    return replace(scatter, size=size, low=low, high=high)


def _least_explained(point: Point) -> list[int]:
    """Return the numbers of the windows with the largest errors for their noise: one lost command
    shows in its window alone.
    """
    errors = []
    for window in point.windows:
        innovation, expected, _ = predicted(window, point.noise, window.residual)
        errors.append(np.mean(innovation**2 / expected))
    return np.sort(np.argsort(errors)[-LOOKED_AT:]).tolist()


def verdict(
    point: Point, active: Sequence[int], threshold: float
) -> tuple[Scatter, tuple[ndarray, ...]] | None:
    """Whether commands got lost, beside a set of effects or any that are still missing, and the
    probability of each command of each window; None where none was, or a model cannot tell.

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
        nats, probabilities = zip(*(_profile(statistics, priors, s, shares) for s in sets))
        least = np.min(nats, axis=0)
        if least.max() <= 0.0:
            return None
    counts = [changes.shape[1] for changes in columns]
    scatter = judged(v, reach, least, threshold, sum(counts), COMMAND)
    lost = probabilities[1][int(np.argmax(least))]
    count = len(priors.floor)
    scatter = _with_size(scatter, statistics.information[:, count:, count:], lost)
    return scatter, tuple(row[:length] for row, length in zip(lost, counts))

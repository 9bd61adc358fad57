"""Lost commands: each command is lost with probability theta.

A loss changes a window's samples by C m, where C has a column for each command, and m is 1 for a
lost command and 0 for another. The likelihood of theta is a sum over all m. A mean-field
approximation with independent probabilities q is a lower bound:

    log p(r) >= log p(r | m = q) - 1/2 sum I_kk q_k (1 - q_k) - sum KL(q_k | theta)

with information I on the commands. A command that was surely received costs -log(1 - theta). In a
problem with probabilities :attr:`visthrow.diagnose.select.point.Problem.lost`, windows are
corrected by C q, and the uncertainty of C m is one of their nuisances.

Source: Jordan, Ghahramani, Jaakkola and Saul 1999, section 6 (mean field as a lower bound)."""

from dataclasses import replace

import numpy as np
from numpy import ndarray
from scipy.special import betaincinv, entr, expit, logit, xlog1py, xlogy

from visthrow.config.effects import random_effects
from visthrow.diagnose.likelihood import noise_levels as levels
from visthrow.diagnose.likelihood.correlation import LOOKED_AT
from visthrow.diagnose.likelihood.evidence import Posterior, Priors
from visthrow.diagnose.likelihood.forms import predict
from visthrow.diagnose.likelihood.marginal import Statistics
from visthrow.diagnose.models.model_interface import Indices
from visthrow.diagnose.select.candidates import COARSE, COMMAND, REACH, Scatter, evidence_of, judge
from visthrow.diagnose.select.point import ROUNDS, Point, statistics_of

NAME = "dropped_commands"  # of the random effect in the catalogue

EITHER = 0.5
"""Mean and standard deviation of m if both values are equally likely.

With half of it as posterior deviation, 0 and 1 are distinguished: the middle is two deviations from
both.
"""


def _assume_lost(statistics: Statistics, effects: int, lost: ndarray) -> Statistics:
    """Return the statistics of the effects, given how much of each command is lost, shape (W,
    T).
    """
    theta = np.tile(statistics.theta, (len(lost), 1))
    theta[:, effects:] = lost
    return statistics.extrapolate(theta).first(effects)


def divergence(lost: ndarray, share: float) -> float:
    """Return the sum of KL divergences of each command's probability from the common share
    [nats].
    """
    odds = xlogy(lost, share) + xlog1py(1.0 - lost, -share)
    return -float((entr(lost) + entr(1.0 - lost) + odds).sum())


def _improve(score: ndarray, information: ndarray, share: float, lost: ndarray) -> ndarray:
    """Maximise the bound over the probabilities that commands were lost, by coordinate ascent.

    In each step, every window updates the probability with the largest gain, until no gain matters.

    Args:
        score: of the commands if none is lost, shape (W, T).
        information: on the commands, shape (W, T, T).
        share: of lost commands.
        lost: first guess of the probabilities, shape (W, T).
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
    statistics: Statistics, priors: Priors, named: Indices, share: float, lost: ndarray
) -> tuple[float, ndarray]:
    """Return a lower bound of log Z of a set of effects for a share of lost commands, and the
    probability of each command; ``lost``: a guess of these, shape (W, T).
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
    statistics: Statistics, priors: Priors, named: Indices, shares: ndarray
) -> tuple[ndarray, list[ndarray]]:
    """Return the gain of each share of lost commands over none, with a set of effects [nats], and
    the probabilities of the commands at each; ``shares``: ascending.
    """
    effects = len(priors.floor)
    none = np.zeros_like(statistics.score[:, effects:])
    plain = evidence_of(_assume_lost(statistics, effects, none), priors, named)
    nats = []
    probabilities = []
    guess = np.full_like(none, shares[0])
    odds = logit(shares)
    for i, share in enumerate(shares.tolist()):
        if i:  # move the guess by the change of the prior odds
            guess = expit(logit(guess) + odds[i] - odds[i - 1])
        value, guess = _bound_evidence(statistics, priors, named, share, guess)
        nats.append(value - plain)
        probabilities.append(guess)
    return np.array(nats), probabilities


def _with_size(scatter: Scatter, information: ndarray, lost: ndarray) -> Scatter:
    """Return the verdict with the share of lost ones among the commands that can be classified, and
    Jeffreys' interval of it; ``information``: on all commands, shape (W, T, T).
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
    """Return the indices of the windows with the largest errors relative to their noise. A lost
    command shows in its window alone.
    """
    errors = []
    for window in point.windows:
        innovation, expected, _ = predict(window, point.noise, window.residual)
        errors.append((innovation**2 / expected).mean())
    return np.sort(np.argsort(errors)[-LOOKED_AT:]).tolist()


def verdict(
    point: Point, active: Indices, threshold: float
) -> tuple[Scatter, tuple[ndarray, ...]] | None:
    """Judge whether commands were lost, both beside a set of effects and beside all effects.

    ``threshold``: evidence that a finding needs [nats]. Returns the verdict and the probability of
    each command of each window; None if no share gains anything, or the model cannot tell.
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
    scatter = judge(v, reach, least, threshold, sum(counts), COMMAND)
    lost = probabilities[1][least.argmax()]
    count = len(priors.floor)
    scatter = _with_size(scatter, statistics.information[:, count:, count:], lost)
    return scatter, tuple(row[:length] for row, length in zip(lost, counts))

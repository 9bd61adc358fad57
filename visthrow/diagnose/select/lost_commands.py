"""Commands that got lost: a random effect of every single command.

Whether command k came is m_k, 0 or 1 with probability theta. A window shows the sum of C m, with C
the change of its samples by each command that did not come; m is taken for normal with mean theta
and variance theta (1 - theta), and integrated out. Windows of a
:attr:`visthrow.diagnose.select.point.Problem.lost` share differ by the mean, and have the rest of C
m among what is not known of them.

Source: an innovation variance (Harvey 1989) of the command channel; the likelihood of its size is
that of a random effect."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy import ndarray
from scipy.special import betaincinv

from visthrow.config.effects import random_effects
from visthrow.diagnose.likelihood import noise_levels as levels
from visthrow.diagnose.likelihood import stack
from visthrow.diagnose.likelihood.correlation import few_of
from visthrow.diagnose.likelihood.evidence import Posterior, Priors
from visthrow.diagnose.likelihood.marginal import correlated_of, grams_of
from visthrow.diagnose.models.model_interface import Window
from visthrow.diagnose.select.point import Point
from visthrow.diagnose.select.scatter import COARSE, COMMAND, REACH, Scatter, judged

NAME = "dropped_commands"  # of the random effect in the catalogue

EITHER = 0.5
"""Mean and deviation of m where either is as likely.

From half of it as a deviation 0 and 1 are told apart: half way is two from both.
"""


@dataclass(frozen=True)
class CommandStatistics:
    """Statistics of windows of K effects and T commands each, about 0; windows of fewer commands
    have columns of 0.
    """

    information: ndarray  # shape (W, K + T, K + T)
    score: ndarray  # shape (W, K + T)
    commands: int  # T

    @staticmethod
    def of(
        point: Point,
        windows: Sequence[Window],
        columns: Sequence[ndarray],
        rows: Sequence[int],
    ) -> "CommandStatistics":
        """Ask windows under a point's noise levels.

        Args:
            point: where the windows' residuals are.
            windows: whose initial states and latent forces are integrated out.
            columns: of each window's commands, shape (N, T).
            rows: numbers of the windows among the point's.
        """
        longest = max(changes.shape[1] for changes in columns)
        wide = []
        for window, changes in zip(windows, columns):
            padded = np.zeros((len(window.residual), longest))
            padded[: len(changes), : changes.shape[1]] = changes
            wide.append(replace(window, effects=np.hstack((window.effects, padded))))
        problem = point.problem
        floors = np.append(problem.priors.floor, np.ones(longest))
        grams = grams_of(wide, floors, len(problem.model.channels))
        grams = correlated_of(grams, wide, point.noise.correlation_time)
        noise = levels.only(point.noise, grams, rows)
        shares = stack.integrals(grams, noise, point.device).shares(grams)
        information = np.array([share.information for share in shares])
        score = np.array([share.score for share in shares])
        score += information[:, :, : len(point.theta)] @ point.theta
        return CommandStatistics(information, score, longest)

    def gain(self, shares: ndarray, priors: Priors, active: Sequence[int]) -> ndarray:
        """Nats of these shares of dropped commands against none, beside a set of effects."""
        evidence = [self._evidence(p, priors, active) for p in [0.0, *shares.tolist()]]
        return np.array(evidence[1:]) - evidence[0]

    def _evidence(self, share: float, priors: Priors, active: Sequence[int]) -> float:
        effects = slice(0, -self.commands)
        commands = slice(-self.commands, None)
        information = self.information[:, effects, effects].sum(0)
        score = self.score[:, effects].sum(0)
        value = 0.0
        if share > 0.0:
            variance = share * (1.0 - share)
            mean = np.full(self.commands, share)
            inner = self.information[:, commands, commands]
            unit = np.eye(self.commands)
            crossed = self.information[:, commands, effects]
            came = self.score[:, commands]
            remaining = came - inner @ mean
            right = np.concatenate((remaining[..., None], crossed), axis=2)
            solved = np.linalg.solve(inner + unit / variance, right)
            explained = (right.transpose(0, 2, 1) @ solved).sum(0)
            mean_gain = mean @ (came + remaining).sum(0)
            log_det = np.linalg.slogdet(unit + variance * inner)[1].sum()
            value = 0.5 * float(mean_gain + explained[0, 0] - log_det)
            information = information - explained[1:, 1:]
            score = score - mean @ crossed.sum(0) - explained[1:, 0]
        return value + Posterior(information, score, priors).log_evidence(active)


def verdict(point: Point, active: Sequence[int], threshold: float) -> Scatter | None:
    """Whether commands got lost, beside a set of effects or any that are still missing; None where
    none was, or a model cannot tell.

    ``threshold``: nats that a finding needs.
    """
    v = next(v for v in random_effects() if v.name == NAME)
    problem = point.problem
    priors = problem.priors
    sizes = problem.sizes(point.theta)
    reach = REACH * v.prior_sd
    graded = priors.visible & ~problem.switches
    sets = active, np.flatnonzero(graded[: len(problem.model.effects)]).tolist()
    numbers = range(len(problem.kept))
    for rows, shares in ((few_of(numbers), reach[::COARSE]), (numbers, reach)):
        columns = problem.model.without_commands(sizes, [problem.kept[w] for w in rows])
        if not columns:
            return None
        windows = [point.windows[w] for w in rows]
        statistics = CommandStatistics.of(point, windows, columns, rows)
        nats = np.minimum(*(statistics.gain(shares, priors, named) for named in sets))
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
    statistics = CommandStatistics.of(point, windows, point.commands, rows)
    commands = slice(-statistics.commands, None)
    information = statistics.information[:, commands, commands]
    spread = np.linalg.inv(information + np.eye(statistics.commands) / EITHER**2)
    score = statistics.score[:, commands] - EITHER * information.sum(2)  # from half way
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

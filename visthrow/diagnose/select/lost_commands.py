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
from scipy.stats import beta

from visthrow.config.effects import random_effects
from visthrow.diagnose.likelihood import noise_levels as levels
from visthrow.diagnose.likelihood import stack
from visthrow.diagnose.likelihood.correlation import few_of
from visthrow.diagnose.likelihood.evidence import Priors, log_evidence
from visthrow.diagnose.likelihood.marginal import correlated_of, grams_of
from visthrow.diagnose.models.model_interface import Window
from visthrow.diagnose.select.point import Point, Problem
from visthrow.diagnose.select.scatter import COMMAND, REACH, Scatter, judged

NAME = "dropped_commands"  # of the random effect in the catalogue

STRIDE = 5  # every which deviation is tried in a few windows, before all are asked

EITHER = 0.5
"""Mean and deviation of m where either is as likely.

From half of it as a deviation 0 and 1 are told apart: half way is two from both.
"""


@dataclass(frozen=True)
class CommandStatistics:
    """Statistics of windows of K effects and T commands each, about 0; windows of fewer commands
    have columns of 0.
    """

    information: np.ndarray  # shape (W, K + T, K + T)
    score: np.ndarray  # shape (W, K + T)
    commands: int  # T

    @staticmethod
    def of(
        problem: Problem,
        point: Point,
        windows: Sequence[Window],
        columns: Sequence[np.ndarray],
        rows: Sequence[int],
    ) -> "CommandStatistics":
        """Ask windows under a point's noise levels.

        Args:
            point: where the windows' residuals are.
            windows: whose initial states and latent forces are integrated out.
            columns: of each window's commands, shape (N, T).
            rows: numbers of the windows among the point's.
        """
        longest = max(columns_of.shape[1] for columns_of in columns)
        effect_count = len(point.theta)
        wide = [
            np.hstack(
                (
                    w.effects,
                    np.pad(
                        columns_of,
                        (
                            (0, len(w.residual) - len(columns_of)),
                            (0, longest - columns_of.shape[1]),
                        ),
                    ),
                )
            )
            for w, columns_of in zip(windows, columns)
        ]
        windows = [replace(w, effects=effects) for w, effects in zip(windows, wide)]
        grams = grams_of(
            windows,
            np.append(problem.priors.floor, np.ones(longest)),
            len(problem.model.channels),
        )
        grams = correlated_of(grams, windows, point.noise.correlation_time)
        noise = levels.only(point.noise, grams, rows)
        shares = stack.integrals(grams, noise, point.device).shares(grams, noise)
        information = np.array([columns_of.information for columns_of in shares])
        return CommandStatistics(
            information,
            np.array([columns_of.score for columns_of in shares])
            + information[:, :, :effect_count] @ point.theta,
            longest,
        )

    def gain(self, shares: np.ndarray, priors: Priors, active: Sequence[int]) -> np.ndarray:
        """Nats of these shares of dropped commands against none, beside a set of effects."""
        return np.array(
            [self._evidence(float(p), priors, active) for p in shares]
        ) - self._evidence(0.0, priors, active)

    def _evidence(self, share: float, priors: Priors, active: Sequence[int]) -> float:
        effects, commands = slice(0, -self.commands), slice(-self.commands, None)
        information = self.information[:, effects, effects].sum(0)
        score = self.score[:, effects].sum(0)
        value = 0.0
        if share > 0.0:
            variance, mean = share * (1.0 - share), np.full(self.commands, share)
            inner, unit = self.information[:, commands, commands], np.eye(self.commands)
            crossed = self.information[:, commands, effects]
            remaining = self.score[:, commands] - inner @ mean
            right = np.concatenate((remaining[..., None], crossed), axis=2)
            explained = np.linalg.solve(inner + unit / variance, right)
            explained = (right.transpose(0, 2, 1) @ explained).sum(0)
            mean_gain = mean @ (self.score[:, commands] + remaining).sum(0)
            log_det = np.linalg.slogdet(unit + variance * inner)[1].sum()
            value = 0.5 * float(mean_gain + explained[0, 0] - log_det)
            information = information - explained[1:, 1:]
            score = score - mean @ crossed.sum(0) - explained[1:, 0]
        return value + log_evidence(information, score, priors, list(active))


def verdict(
    problem: Problem, point: Point, active: Sequence[int], threshold: float
) -> Scatter | None:
    """Whether commands got lost, beside a set of effects or any that are still missing; None where
    none was, or a model cannot tell.

    ``threshold``: nats that a finding needs.
    """
    v = next(v for v in random_effects() if v.name == NAME)
    priors = problem.priors
    sizes = problem.sizes(point.theta)
    reach = REACH * v.prior_sd
    causes = np.flatnonzero(priors.visible & ~problem.switches)
    sets = active, causes[causes < len(problem.model.effects)].tolist()
    numbers = range(len(problem.kept))
    for rows, shares in ((few_of(numbers), reach[::STRIDE]), (numbers, reach)):
        columns = problem.model.without_commands(sizes, [problem.kept[w] for w in rows])
        if not columns:
            return None
        statistics = CommandStatistics.of(
            problem, point, [point.windows[w] for w in rows], columns, rows
        )
        nats = np.minimum(*(statistics.gain(shares, priors, named) for named in sets))
        if nats.max() <= 0.0:
            return None
    return judged(
        v, reach, nats, threshold, sum(columns_of.shape[1] for columns_of in columns), COMMAND
    )


def sized(problem: Problem, point: Point, scatter: Scatter) -> Scatter:
    """The verdict with the share of those commands of which a window tells by itself whether they
    came, with Jeffreys' interval.

    ``problem``: of a model with lost commands; ``point``: of it, with the noise levels that these
    leave; ``scatter``: the verdict before."""
    statistics = CommandStatistics.of(
        problem,
        point,
        [point.about.windows[i] for i in problem.kept],
        point.commands,
        range(len(problem.kept)),
    )
    information = statistics.information[:, -statistics.commands :, -statistics.commands :]
    score = statistics.score[:, -statistics.commands :]
    spread = np.linalg.inv(information + np.eye(statistics.commands) / EITHER**2)
    off = (spread @ (score - EITHER * information.sum(2))[..., None])[..., 0]  # from half way
    clear = np.sqrt(np.diagonal(spread, axis1=1, axis2=2)) < 0.5 * EITHER
    count = np.count_nonzero(clear)
    lost_commands = np.count_nonzero(clear & (off > 0.0))
    if not count:
        return scatter
    size, low, high = (
        float(x)
        for x in beta.ppf((0.5, 0.025, 0.975), lost_commands + 0.5, count - lost_commands + 0.5)
    )
    return replace(scatter, size=size, low=low, high=high)

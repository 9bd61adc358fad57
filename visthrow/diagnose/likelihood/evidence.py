"""Evidence for sets of effects, with floors: whatever is not named may still be there below its
floor.

In floors, an effect that is not named has the prior N(0, SPIKE^2), so that a floor is two
deviations; a named one has N(0, prior^2) within its bounds (the slab):

    log Z = -1/2 log |1 + D^1/2 I D^1/2| + 1/2 s' (I + D^-1)^-1 s + log of the prior's and
    posterior's mass within the bounds

with information I and scores s about theta = 0.

Eight constants take part in what is named and what is said of it; all stand here. Whatever else a
decision is compared with follows from them, from the catalogue's floors and from the 5 mm of
landing behind these. 34 worlds were judged alike with ``MODEL_ERROR_FLOOR`` at half and double,
``INEXACT`` at 0.2 and 0.45, ``UNKNOWN_RATIO`` at 2.5 and 4, ``LOST_SHARE`` at 0.1 and 0.25, one at
a time (``bench.diagnose.constants``). Other modules' constants say how far a search or a sum goes
on."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy import ndarray
from scipy.linalg import lapack
from scipy.special import log_ndtr, ndtri

from visthrow.common.errors import DiagnoseError
from visthrow.diagnose.likelihood.marginal import Statistics
from visthrow.diagnose.models.model_interface import Effect

POSSIBLE = 1.0 / 20.0
ALARM = 1.0 / 150.0
"""Odds below which a set is no longer possible, and share of worlds with nothing wrong in which
something is named.

Bayes factors above 20 are strong, above 150 very strong (Kass and Raftery 1995, section 3.2)."""

NORMAL_95 = float(ndtri(1.0 - 0.5 * POSSIBLE))  # deviations to either end of an interval
STRONG = -float(np.log(POSSIBLE))
VERY_STRONG = -float(np.log(ALARM))
"""Nats: what is less than strongly behind counts as possible; any cause must be very strong,
however few are in question. Where nothing is wrong, a Bayes factor exceeds 1 / ALARM in no more
than ALARM of worlds (Markov's inequality).
"""

SPIKE = 0.5
"""Deviation of an effect that is not named, in its floor: the floor is the limit of what may go
unnamed, two deviations from none, not its usual size.
"""

MODEL_ERROR_FLOOR = 0.1
"""Deviation that numerics and what an effect's form leaves out add to its estimate, in its floor.

With it 95 % intervals held 94 % of 85 sizes that were hidden in plants of other code than the
simulator's.
"""

INEXACT = 0.3
"""Part by which the form of anything may be off: of an effect from flight to flight, of another
kind of block, of a force against the thrust, of the misfit of a window that begins in a motion that
nobody knows, of a size that derivatives of elsewhere give, of an effect that another of its group
would replace.
"""

UNKNOWN_RATIO = 3.0
"""What is so many times the noise, or the quietest phase's gusts, is neither.

Of 18 worlds that names explained and 6 with nothing to explain, no phase was above 2.8 times.
"""

LOST_SHARE = 0.15
"""Share of windows that the simulation may lose; where more are so far off, something is missing.

Chosen below the share that one phase has, so that a force that acts in that alone is kept.
"""

FEWEST = 3
"""Flights, or parts of flights, that can disagree: of two that differ, neither is the odd one."""

Sets = Sequence[tuple[tuple[int, ...], float]]
"""Numbers of the effects of each possible set, and its nats behind the best."""

CALIBRATION_DRAWS = 4000


@dataclass(frozen=True)
class Priors:
    """Prior beliefs about each effect, in floors; arrays of shape (K,)."""

    floor: ndarray  # in the effects' units
    slab: ndarray  # deviation of a named effect
    # of a named effect; another kind of block is there as a whole, but for its form
    low: ndarray
    high: ndarray
    visible: ndarray  # bool: all its channels are there

    @staticmethod
    def of(effects: Sequence[Effect], channels: Sequence[str]) -> "Priors":
        """Read them off the catalogue.

        Raises DiagnoseError: a floor or prior is not above 0, or bounds do not hold 0.
        """
        for e in effects:
            low, high = e.bounds
            if not (e.floor > 0.0 and e.prior_sd > 0.0 and low <= 0.0 <= high):
                raise DiagnoseError(
                    f"effect '{e.name}' has floor {e.floor}, prior_sd {e.prior_sd}, bounds"
                    f" {e.bounds}; expected both above 0, and bounds about 0"
                )
        names = [e.name for e in effects]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise DiagnoseError(f"two effects share a name: {', '.join(twice)}")
        floor = np.array([e.floor for e in effects], dtype=float)
        bounds = np.array([e.bounds for e in effects], dtype=float).reshape(-1, 2)
        switch = np.array([bool(e.switch) for e in effects], dtype=bool)
        bounds[switch, 0] = (1.0 - INEXACT) * bounds[switch, 1]
        bounds /= floor[:, None]
        prior = np.array([e.prior_sd for e in effects], dtype=float) / floor
        slab = np.maximum(prior, UNKNOWN_RATIO * SPIKE)  # also of what was measured
        visible = np.array([set(e.channels) <= set(channels) for e in effects], dtype=bool)
        return Priors(floor, slab, bounds[:, 0], bounds[:, 1], visible)

    @cached_property
    def log_within(self) -> ndarray:
        """Return the log of each named effect's prior mass within its bounds, shape (K,)."""
        return _log_mass(np.zeros_like(self.slab), self.slab, self.low, self.high)

    def deviation(self, active: Sequence[int]) -> ndarray:
        """Prior deviations with these effects named, shape (K,)."""
        spread = np.full(len(self.floor), SPIKE)
        spread[list(active)] = self.slab[list(active)]
        return spread


def _log_mass(mean: ndarray, sd: ndarray, low: ndarray, high: ndarray) -> ndarray:
    """Logarithm of a normal distribution's mass within bounds, accurate far in the tails."""
    a = (low - mean) / sd
    b = (high - mean) / sd
    flip = a > 0.0  # use the tail that does not round to 1
    a, b = np.where(flip, -b, a), np.where(flip, -a, b)
    upper = log_ndtr(b)
    lower = log_ndtr(a)
    return upper + np.log1p(-np.exp(np.minimum(lower - upper, -1e-12)))


@dataclass(frozen=True)
class Posterior:
    """The statistics of flights, with what was believed of the effects before."""

    information: ndarray  # I, shape (K, K)
    score: ndarray  # s about theta = 0, shape (K,), or (n, K) for n draws at once
    priors: Priors

    @staticmethod
    def of(statistics: Statistics, priors: Priors) -> "Posterior":
        """Return what all flights say together."""
        information = statistics.information.sum(0)
        return Posterior(information, statistics.absolute.score.sum(0), priors)

    def _factor(self, deviation: ndarray) -> ndarray:
        """Lower Cholesky factor of 1 + D^1/2 I D^1/2; anything above the diagonal.

        Raises DiagnoseError: not positive definite, not finite.
        """
        scaled = self.information * np.outer(deviation, deviation)
        scaled.flat[:: len(scaled) + 1] += 1.0
        factor, failed = lapack.dpotrf(scaled, lower=1, clean=0)
        # LAPACK goes on with NaN, which reaches the last row
        if failed or not np.isfinite(np.trace(factor)):
            raise DiagnoseError(
                "the flights' information on the effects is not finite or not positive; the"
                " derivatives are broken"
            )
        return factor

    def covariance(self, active: Sequence[int]) -> ndarray:
        """Posterior covariance (I + D^-1)^-1 with these effects named, shape (K, K)."""
        deviation = self.priors.deviation(active)
        factor = self._factor(deviation)
        inverse = lapack.dpotrs(factor, np.eye(len(deviation)), lower=1)[0]
        return inverse * np.outer(deviation, deviation)

    def mean(self, active: Sequence[int]) -> ndarray:
        """Return the most probable size of every effect, those not named below their floors; shape
        (K,).
        """
        return self.covariance(active) @ self.score

    def log_evidence(self, active: Sequence[int]) -> float:
        """log Z of one set of named effects."""
        columns = list(active)
        deviation = self.priors.deviation(columns)
        factor = self._factor(deviation)
        half = self.score * deviation
        mean = lapack.dpotrs(factor, half, lower=1)[0]
        value = 0.5 * half @ mean - np.log(np.diag(factor)).sum()
        if columns:
            slab = deviation[columns]
            inverse = lapack.dpotrs(factor, np.eye(len(factor))[:, columns], lower=1)[0]
            spread = slab * np.sqrt(inverse[columns].diagonal())
            value += self._log_within(columns, slab * mean[columns], spread).sum()
        return float(value)

    def _log_within(self, sets: Sequence[int] | ndarray, mean: ndarray, sd: ndarray) -> ndarray:
        """Log of the posterior's mass within the bounds of some effects, less that of the prior."""
        priors = self.priors
        return _log_mass(mean, sd, priors.low[sets], priors.high[sets]) - priors.log_within[sets]

    def additions(self, active: Sequence[int]) -> ndarray:
        """Gain of log Z by naming one more effect, for each effect; -inf for those named already or
        not visible.

        A change of one prior is a rank-one update, so all candidates and all draws cost one
        factorisation. Returns nats, of the score's shape."""
        return self._naming(active, np.arange(len(self.priors.floor))[:, None])

    def pair_additions(self, active: Sequence[int]) -> ndarray:
        """Return the gain of log Z by naming each pair of effects: two that cancel show no gain
        alone.

        Returns nats, shape (K, K), symmetric; -inf for those named already or not visible, and on
        the diagonal."""
        size = len(self.score)
        rows, columns = np.triu_indices(size, 1)
        gain = np.full((size, size), -np.inf)
        gain[rows, columns] = self._naming(active, np.stack((rows, columns), axis=1))
        return np.maximum(gain, gain.T)

    def _naming(self, active: Sequence[int], sets: ndarray) -> ndarray:
        """Gain of log Z by naming several effects more, for P sets of them; ``sets``: their
        numbers, shape (P, m).
        """
        priors = self.priors
        sigma = self.covariance(active)
        mean = (self.score @ sigma)[..., sets]
        change = (priors.slab**-2.0 - SPIKE**-2.0)[sets]
        variance = sigma[sets[:, :, None], sets[:, None]]
        unit = np.eye(sets.shape[1])
        taken = np.linalg.inv(variance + unit / change[:, None])
        weighed = taken @ mean[..., None]
        wide_mean = mean - (variance @ weighed)[..., 0]
        # A name widens its prior and so the posterior. What comes out narrower is a set with a name
        # that is there already; it is left out below.
        wide = np.maximum(variance - variance @ taken @ variance, variance)
        wide_sd = np.sqrt(wide.diagonal(axis1=1, axis2=2))
        explained = (mean * weighed[..., 0]).sum(-1)
        log_det = np.linalg.slogdet(unit + change[..., None] * variance)[1]
        gain = -0.5 * (explained + log_det) - np.log(priors.slab[sets] / SPIKE).sum(1)
        gain = gain + self._log_within(sets, wide_mean, wide_sd).sum(-1)
        out = ~priors.visible
        out[list(active)] = True
        return np.where(out[sets].any(1), -np.inf, gain)

    def estimate(self, active: Sequence[int]) -> ndarray:
        """Most probable sizes of the named effects within their bounds, all others at 0; in floors,
        shape (K,).
        """
        from scipy.optimize import lsq_linear

        priors = self.priors
        columns = list(active)
        theta = np.zeros(len(self.score))
        if columns:
            normal = self.information[np.ix_(columns, columns)]
            factor = np.linalg.cholesky(normal + np.diag(priors.slab[columns] ** -2.0))
            right = np.linalg.solve(factor, self.score[columns])
            bounds = priors.low[columns], priors.high[columns]
            solution = lsq_linear(factor.T, right, bounds, method="bvls").x
            theta[columns] = np.clip(solution, *bounds)  # which the solver leaves by rounding
        return theta

    def averaged(self, j: int, sets: Sets) -> tuple[float, float]:
        """Return mean and deviation of an effect over the possible sets that hold it, all other
        effects free below their floors, in floors.
        """
        estimates = []
        for members, distance in sets:
            sigma = self.covariance(members)
            estimates.append((sigma[j] @ self.score, sigma[j, j], np.exp(-distance)))
        means, variances, weights = np.array(estimates).T
        mean = np.average(means, weights=weights)
        variance = np.average(variances + (means - mean) ** 2, weights=weights)
        return float(mean), float(np.sqrt(variance))

    def mean_sizes(self, active: Sequence[int], sets: Sets) -> ndarray:
        """Return the means of some effects as :meth:`averaged`, within their bounds, and 0 for all
        others; in floors, shape (K,).
        """
        theta = np.zeros(len(self.score))
        for j in active:
            homes = [(members, nats) for members, nats in sets if j in members]
            mean = self.averaged(j, homes)[0]
            theta[j] = np.clip(mean, self.priors.low[j], self.priors.high[j])
        return theta

    def certainty(self, theta: ndarray, active: Sequence[int]) -> ndarray:
        """Sizes of named effects in the half widths of 95 % intervals to which half a floor is
        added, in the order of ``active``.

        Above 1 it is more than what may go unnamed.
        """
        columns = list(active)
        variance = np.diag(self.covariance(columns))[columns]
        return np.abs(theta[columns]) / (NORMAL_95 * np.hypot(np.sqrt(variance), SPIKE))

    def certainly_nonzero(self, active: Sequence[int]) -> list[int]:
        """Return the named effects that are surely not 0 beside one another; the least certain is
        left out first.
        """
        remaining = list(active)
        while remaining:
            sure = self.certainty(self.estimate(remaining), remaining)
            if sure.min() > 1.0:
                break
            remaining.pop(np.argmin(sure))
        return remaining


def null_draws(information: ndarray, draws: int, rng: np.random.Generator) -> ndarray:
    """Scores of worlds in which nothing is wrong but what may go unnamed, every effect drawn from
    its spike, shape (draws, K).
    """
    values, vectors = np.linalg.eigh(information)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    shape = draws, len(information)
    unnamed = SPIKE * rng.standard_normal(shape)
    return rng.standard_normal(shape) @ root.T + unnamed @ information


def threshold(statistics: Statistics, priors: Priors, rng: np.random.Generator) -> float:
    """Return the nats that the best of all effects exceeds in a share ``ALARM`` of null worlds, at
    least ``VERY_STRONG``.

    The null worlds have these flights' information, noise as fitted, and of every effect what may
    go unnamed."""
    information = statistics.information.sum(0)
    if not priors.visible.any():
        raise DiagnoseError("none of the effects can be seen in the channels of these logs")
    null = Posterior(information, null_draws(information, CALIBRATION_DRAWS, rng), priors)
    best = null.additions(()).max(axis=1)
    return float(max(np.quantile(best, 1.0 - ALARM), VERY_STRONG))

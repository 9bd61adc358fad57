"""Detection limits: the sizes from which effects would be selected in the user's flights.

Effects are hidden in simulated statistics of the flights. The score of such a world is the sum of
the flights' residual scores with a random sign for each flight, of all effects at random sizes
within their floors, and of the hidden effect."""

from dataclasses import dataclass

import numpy as np
from numpy import ndarray

from visthrow.diagnose.likelihood.evidence import STRONG, Posterior
from visthrow.diagnose.select.result import Diagnosis

SIZES = np.geomspace(1.0, 64.0, 13)  # hidden sizes [floors]

DRAWS = 200
# fewer flights have too few combinations of signs; noise is then drawn from its fitted level
FEWEST_FLIGHTS = 6
NAMED = 0.9


@dataclass(frozen=True)
class Completeness:
    """The share of worlds in which a hidden effect is selected, by its size."""

    name: str
    unit: str
    sizes: ndarray  # hidden sizes [unit], shape (S,); the shares have the same shape
    exact: ndarray  # share in which the effect is selected
    up_to_class: ndarray  # share in which it is less than 3 nats behind the selected effect
    wrong: ndarray  # share in which another effect is selected and this one is further behind
    # size that is found, up to its class, with probability 0.9 [unit]; NaN if none within the
    # bounds is
    limit: float


@dataclass(frozen=True)
class Blind:
    """Detection limits of all effects in one set of flights."""

    curves: tuple[Completeness, ...]
    false_alarms: float  # share of worlds without a hidden effect in which an effect was selected
    worlds: int
    noise: str  # source of the noise, in words

    def __getitem__(self, name: str) -> Completeness:
        return next(c for c in self.curves if c.name == name)


def hide(diagnosis: Diagnosis, *, seed: int = 0, draws: int = DRAWS) -> Blind:
    """Hide each effect at increasing sizes in the flights' noise, and count how often it is
    selected.

    ``diagnosis``: of :func:`visthrow.diagnose.select.diagnose_flights.explain`; its selected
    effects are subtracted first; ``draws``: worlds for each effect, size and sign."""
    work = diagnosis.work
    rng = np.random.default_rng(seed)
    priors = work.problem.priors
    effects = work.problem.model.effects
    information = work.after.information
    score_of = work.after.statistics.score
    parametric = len(score_of) < FEWEST_FLIGHTS
    values, vectors = np.linalg.eigh(information)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    shape = draws, len(effects)

    def worlds() -> ndarray:
        small = rng.uniform(-1.0, 1.0, shape) @ information
        if parametric:
            return small + rng.standard_normal(shape) @ root.T
        return small + rng.choice((-1.0, 1.0), (draws, len(score_of))) @ score_of

    def find_named(score: ndarray) -> tuple[ndarray, ndarray]:
        gain = Posterior(information, score, priors).additions(())
        return gain, gain.max(axis=1) > diagnosis.threshold

    curves = []
    for j, effect in enumerate(effects):
        rows = []
        for size in SIZES if priors.visible[j] else ():
            hidden = [s for s in (-size, size) if priors.low[j] <= s <= priors.high[j]]
            if not hidden:
                break
            score = np.vstack([worlds() + s * information[j] for s in hidden])
            gain, named_effect = find_named(score)
            best = gain.argmax(axis=1) == j
            close = gain[:, j] > gain.max(axis=1) - STRONG
            hits = [np.mean(named_effect & answer) for answer in (best, close, ~close)]
            rows.append((size, *hits))
        size, exact, similar, wrong = np.array(rows, dtype=float).reshape(-1, 4).T
        limit = _limit(size, similar) * effect.floor if rows else np.nan
        shares = size * effect.floor, exact, similar, wrong
        curves.append(Completeness(effect.name, effect.unit, *shares, limit))
    _, alarms = find_named(np.vstack([worlds() for _ in range(10)]))
    source = "residuals of the flights, with a random sign for each flight"
    if parametric:
        source = "drawn from its fitted level"
    return Blind(tuple(curves), alarms.mean(), 10 * draws, source)


def _limit(size: ndarray, share: ndarray) -> float:
    """Return the size from which on the share stays at or above NAMED, interpolated in the
    logarithm of the size; NaN if the share at the largest size is below NAMED.
    """
    below = np.flatnonzero(share < NAMED)
    if not len(below):
        return size[0]
    last = below[-1]
    if last == len(size) - 1:
        return np.nan
    crossing = slice(last, last + 2)
    return np.exp(np.interp(NAMED, share[crossing], np.log(size[crossing])))

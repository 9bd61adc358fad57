"""Spread from flight to flight, as far as the flights allow it."""

import numpy as np
from numpy.random import default_rng

from visthrow.diagnose.likelihood.evidence import MODEL_ERROR_FLOOR, Posterior, Priors
from visthrow.diagnose.likelihood.marginal import Statistics
from visthrow.diagnose.select.candidates import between_flights, find_tolerance

SIZE, OTHER = 20.0, 0.3
"""Of the named effect and of one that is not named, in floors."""
KNOWN = 25.0
"""Information of a flight on either: a deviation of a fifth of a floor."""
TRIED = 200
LEAST = 0.9
"""Of 200 intervals of 95 % that must hold: fewer come of them in less than one of a thousand."""


def flights(shares: np.ndarray, rng: np.random.Generator) -> Statistics:
    """Statistics of flights with these sizes of the named effect."""
    information = np.tile(KNOWN * np.array([[1.0, 0.3], [0.3, 1.0]]), (len(shares), 1, 1))
    sizes = np.column_stack((shares, np.full(len(shares), OTHER)))
    noise = rng.multivariate_normal(np.zeros(2), information[0], len(shares))
    score = np.einsum("fij,fj->fi", information, sizes) + noise
    square = np.einsum("fi,fij,fj->f", score, np.linalg.inv(information), score)
    return Statistics(
        np.arange(len(shares)), information, score, square, np.ones(len(shares)), np.zeros(2)
    )


PRIORS = Priors(
    np.ones(2), np.full(2, 50.0), np.full(2, -500.0), np.full(2, 500.0), np.ones(2, dtype=bool)
)


def interval(statistics: Statistics) -> tuple[float, float]:
    """Estimate of the named effect and its deviation."""
    posterior = Posterior.of(statistics, PRIORS)
    spread = posterior.covariance([0])
    size = spread[0] @ posterior.score
    unlike, kept = between_flights(statistics, PRIORS, [0], np.array([size, 0.0]))
    more = unlike * kept[0] * find_tolerance(size) ** 2
    return size, np.sqrt(spread[0, 0] + MODEL_ERROR_FLOOR**2 + more)


def test_intervals_hold_where_flights_differ_by_what_the_prior_says():
    """Worlds of three to eight flights, each with its own deviation among them."""
    rng, held = default_rng(3), 0
    for _ in range(TRIED):
        deviation = abs(rng.standard_normal()) * find_tolerance(SIZE)
        size, sd = interval(
            flights(SIZE + deviation * rng.standard_normal(rng.integers(3, 9)), rng)
        )
        held += abs(size - SIZE) < 1.96 * sd
    assert held > LEAST * TRIED

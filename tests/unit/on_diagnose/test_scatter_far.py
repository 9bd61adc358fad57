"""What varies from flight to flight by more than a derivative reaches."""

from dataclasses import replace

import numpy as np

from tests.unit.on_diagnose.test_scatter import EFFECTS, LEAST, NAMES, PRIORS
from visthrow.config.effects import random_effects
from visthrow.diagnose.likelihood.marginal import Statistics
from visthrow.diagnose.select import verdicts
from visthrow.diagnose.select.candidates import random_shares, shared
from visthrow.diagnose.select.occam import Linear
from visthrow.diagnose.select.scatter import relinearised_per_flight

BENT = 0.1
"""A release early by a floor tells so much more of itself than its derivative says, and twice as
much by two.
"""
TRUTH = 0.012
"""Deviation of the release's lag [s]: 6 floors."""
INFORMATION = 30.0


def answer(lag):
    """What is seen of a release late by so many floors, per its derivative."""
    return lag + BENT * lag * np.maximum(-lag, 0.0)


def world(seed: int, count: int = 12):
    """Statistics of flights about no lag, and the same flights simulated with another."""
    rng, K = np.random.default_rng(seed), len(NAMES)
    lags = rng.normal(size=count) * TRUTH / PRIORS.floor[0]
    seen = answer(lags) + rng.normal(size=count) / np.sqrt(INFORMATION)
    information = np.tile(np.eye(K), (count, 1, 1))
    information[:, 0, 0] = INFORMATION
    score = np.zeros((count, K))
    score[:, 0] = INFORMATION * seen
    found = Statistics(
        np.arange(count),
        information,
        score,
        INFORMATION * seen**2,
        np.full(count, 500),
        np.zeros(K),
    )

    def again(theta):
        left = seen - answer(theta[0])
        there = replace(
            found,
            square=INFORMATION * left**2,
            score=INFORMATION * left[:, None] * np.eye(1, K),
            theta=theta,
        )
        return there if abs(theta[0]) < 40.0 else None

    return found, again


EFFECT = next(v for v in random_effects() if v.name == "lag_jitter")


def jitter(found, again):
    if again is not None:
        found = relinearised_per_flight(found, np.zeros(len(NAMES)), PRIORS, 0, again)
    offered = shared(EFFECTS) + random_shares(EFFECTS, PRIORS, found, ())
    share = next(c for c in offered if c.name == "lag_jitter")
    linear = Linear(found, PRIORS, offered, lambda _: 0.0)
    return verdicts.share_verdict(linear, share, frozenset(offered[:1]), {}, EFFECT, LEAST)


def test_flights_far_apart_are_told_by_simulations_where_they_lie():
    with_it = [jitter(*world(seed)) for seed in range(40)]
    without = [jitter(world(seed)[0], None) for seed in range(40)]
    assert all(s.found for s in with_it)
    inside, outside = (
        np.mean([s.low <= TRUTH <= s.high for s in told]) for told in (with_it, without)
    )
    assert inside > 0.85, inside  # 95 %, less three deviations of 40 draws
    assert outside < 0.7, (
        outside
    )  # the derivatives alone take early releases for still earlier ones
    assert abs(np.median([s.size for s in with_it]) / TRUTH - 1.0) < 0.15
    assert np.median([s.size for s in without]) > 1.15 * TRUTH


def test_a_simulation_that_fails_everywhere_leaves_the_derivatives():
    found, _ = world(0)
    assert jitter(found, lambda theta: None) == jitter(found, None)

"""Correlated measurement noise: the algebra against dense covariances, the estimate against planted
noise, and its effect on verdicts.
"""

from dataclasses import replace

import numpy as np
from numpy.random import default_rng
from numpy.testing import assert_allclose
from pytest import approx, mark
from scipy.signal import lfilter

from tests.synthetic_diagnosis import SyntheticModel, catalogue
from visthrow.diagnose.likelihood import marginal
from visthrow.diagnose.likelihood.correlation import (
    Correlation,
    components,
    correlations,
    with_correlations,
)
from visthrow.diagnose.likelihood.evidence import Priors
from visthrow.diagnose.select import diagnose_flights, point, result

RATE, TIME = 200, 0.03
SOME = 16  # effects


def noise(rng, count: int, colour: str) -> np.ndarray:
    """Noise of deviation 1, shape (count, 3)."""
    white = rng.normal(size=(count + 400, 3))
    a = np.exp(-1.0 / (RATE * TIME))
    first = lfilter([np.sqrt(1.0 - a * a)], [1.0, -a], white, axis=0)
    second = lfilter(
        [np.sqrt((1.0 - a * a) ** 3 / (1.0 + a * a))], [1.0, -2.0 * a, a * a], white, axis=0
    )
    return {"white": white, "first": first, "second": second}[colour][400:]


def fly_coloured(seed: int, colour: str, **options) -> SyntheticModel:
    """Flights whose sensors have noise of a colour."""
    model = SyntheticModel(
        effects=catalogue(SOME), seed=seed, noise=1e-6, rate=RATE, throws=2, **options
    )
    rng = default_rng([seed, 1])
    for i, window in enumerate(model._windows):
        noises = [noise(rng, len(window.residual) // 6, colour).ravel() for _ in range(2)]
        model._windows[i] = replace(
            window, residual=window.residual + window.sigma * np.concatenate(noises)
        )
    return model


def estimate(model: SyntheticModel) -> dict[int, Correlation]:
    priors = Priors.of(model.effects, model.channels)
    return correlations(model.windows({}), priors.slab * priors.floor, 2)


@mark.parametrize("order", [1, 2])
def test_inner_products_are_those_of_the_dense_covariance(order):
    window = fly_coloured(1, "white").windows({})[0]
    known = Correlation(0.02, 0.9, order, 1.7)
    (correlated,) = with_correlations([window], {1: known})
    dense = np.diag(window.sigma**2)
    for part in components(window, 1).T:
        lag = window.time[part][:, None] - window.time[part]
        dense[np.ix_(part, part)] = (1.7 * window.sigma[part[0]]) ** 2 * known.at_lag(lag)
    floors = np.ones(SOME)
    z, gram = marginal.columns(window, floors), marginal.gram_of(correlated, floors, 2)
    inverse = np.linalg.inv(dense)
    assert_allclose(
        gram.inner.sum(0), z.T @ inverse @ z, rtol=1e-6, atol=1e-9 * np.abs(gram.inner).max()
    )
    assert gram.square.sum() == approx(window.residual @ inverse @ window.residual)
    assert 2.0 * gram.log_sigma == approx(np.linalg.slogdet(dense)[1])
    other = default_rng(0).normal(size=len(window.residual)) * window.sigma
    again = marginal.with_residual(gram, correlated, other, floors)
    assert_allclose(
        again.cross.sum(0), z.T @ inverse @ other, rtol=1e-6, atol=1e-9 * np.abs(again.cross).max()
    )
    assert again.square.sum() == approx(other @ inverse @ other)


def test_white_noise_is_white():
    assert not estimate(fly_coloured(2, "white"))
    assert not estimate(fly_coloured(2, "white", truth={"effect_02": 60.0, "effect_04": 40.0})), (
        "causes are not noise"
    )


@mark.parametrize(("colour", "order"), [("first", 1), ("second", 2)])
def test_time_order_and_size_are_those_planted(colour, order):
    fits = estimate(fly_coloured(3, colour))
    assert set(fits) == {0, 1}
    for fitted in fits.values():
        assert fitted.order == order
        assert TIME / 2.0 < fitted.time < 2.0 * TIME
        assert fitted.share > 0.9
        assert 0.7 < fitted.scale < 1.4


def test_noise_that_is_correlated_is_no_cause(monkeypatch):
    """Taken for white, it yields false names or UNKNOWN."""
    assert diagnose_flights.explain(fly_coloured(7, "first")).overall == result.NO_EFFECT
    monkeypatch.setattr(point, "correlations", lambda *_: {})
    assert diagnose_flights.explain(fly_coloured(7, "first")).overall != result.NO_EFFECT

"""Sufficient statistics of windows against dense linear algebra, noise levels against
planted ones.
"""

from dataclasses import replace

import numpy as np
from numpy.random import default_rng
from numpy.testing import assert_allclose
from pytest import approx, fixture, mark, raises

from tests.synthetic_diagnosis import GUST, SyntheticModel, catalogue
from visthrow.common.errors import DiagnoseError
from visthrow.diagnose.likelihood import marginal
from visthrow.diagnose.likelihood import noise_levels as noise
from visthrow.diagnose.likelihood.evidence import Posterior, Priors
from visthrow.diagnose.likelihood.integrals import Integrals
from visthrow.diagnose.likelihood.integrals import fit_windows as fitted_windows
from visthrow.diagnose.models.model_interface import LATENT_BLOCKS

EFFECTS = catalogue(6)


def likelihood(gram, levels, window):
    """Logarithm of it, of one window by itself, but for the powers of 2 pi."""
    return -0.5 * single_window(gram, levels, window).square[0]


def single_window(gram, levels, window):
    """Statistics of a single window."""
    levels = replace(levels, share=levels.share[[window]])
    return Integrals([gram], levels).statistics([gram], np.zeros(0))


@fixture(scope="module")
def fitted():
    model = SyntheticModel(effects=EFFECTS, throws=4)
    windows, floors = model.windows({}), Priors.of(model.effects, model.channels).floor
    levels, grams = noise.fit(windows, [marginal.gram_of(w, floors, 2) for w in windows])
    return model, windows, floors, levels, grams


def dense(window, gram, levels, floors, at):
    """V and S of a window, written out."""
    shared = [levels.latent_sd.get((b, gram.phase), 0.0) for b in range(len(LATENT_BLOCKS))]
    by_block = shared * levels.share[at]
    deviation = np.concatenate((np.ones(gram.nuisances), by_block[gram.latent_block]))
    columns = marginal.columns(window, floors)
    states = columns[:, : gram.nuisances] * deviation[: gram.nuisances]
    latents = (
        columns[:, gram.nuisances : len(deviation)] @ gram.factor * deviation[gram.nuisances :]
    )
    sensor = (window.sigma * levels.scale[window.channel]) ** 2
    return np.diag(sensor) + states @ states.T + latents @ latents.T, columns[:, len(deviation) :]


def test_information_and_score_are_those_of_the_dense_covariance(fitted):
    _, windows, floors, levels, grams = fitted
    extended = [marginal.with_latent_effects(gram) for gram in grams]
    part = Integrals(extended, levels).statistics(extended, np.zeros(len(EFFECTS)))
    for at in (0, 7):
        v, s = dense(windows[at], grams[at], levels, floors, at)
        inverse = np.linalg.inv(v)
        columns = np.hstack((s, windows[at].latent @ grams[at].factor))
        information = columns.T @ inverse @ columns
        score = columns.T @ inverse @ windows[at].residual
        for effects in (slice(len(EFFECTS)), slice(len(EFFECTS), columns.shape[1])):
            whole = information[effects, effects]
            near = 1e-6 * np.abs(whole).max()
            assert_allclose(part.information[at, effects, effects], whole, rtol=1e-6, atol=near)
            assert_allclose(part.score[at, effects], score[effects], rtol=1e-6, atol=1e-4)


def test_likelihood_is_that_of_the_dense_covariance(fitted):
    """At any noise levels and any weights of the samples, so that models compare whose outliers are
    not the same.
    """
    _, windows, floors, levels, grams = fitted
    other = replace(
        levels,
        scale=1.3 * levels.scale,
        latent_sd={k: 2.0 * v for k, v in levels.latent_sd.items()},
    )
    spared = replace(
        windows[0],
        sigma=np.where(np.arange(len(windows[0].sigma)) % 7, 1.0, 3.0) * windows[0].sigma,
    )
    gram = marginal.correlate(marginal.gram_of(spared, floors, 2), spared, levels.correlation_time)
    for window, of, choice in (
        (windows[0], grams[0], levels),
        (windows[0], grams[0], other),
        (spared, gram, levels),
    ):
        v, _ = dense(window, of, choice, floors, 0)
        sign, log_det = np.linalg.slogdet(v)
        assert sign > 0
        dense_value = -0.5 * (log_det + window.residual @ np.linalg.solve(v, window.residual))
        assert likelihood(of, choice, 0) == approx(dense_value, abs=1e-3)


def test_broken_derivatives_are_reported_with_their_window(fitted):
    gram = fitted[4][3]
    with raises(
        DiagnoseError,
        match=f"flight {gram.flight}, phase {gram.phase}: the normal equations are singular",
    ):
        fitted_windows([fitted[4][0], replace(gram, inner=-1e6 * gram.inner)], fitted[3])


@mark.parametrize(("sensor", "gust"), [(1.0, 1.0), (2.0, 0.5)])
def test_noise_levels_are_found_again(sensor, gust):
    model = SyntheticModel(effects=EFFECTS, throws=8, noise=sensor, gust=gust, seed=3)
    windows = model.windows({})
    levels, _ = noise.fit(windows, [marginal.gram_of(w, np.ones(6), 2) for w in windows])
    assert_allclose(levels.scale, sensor, rtol=0.1)
    mean_gust = np.mean([levels.latent_sd[0, p] for p in ("flight", "hover", "throw")])
    assert mean_gust == approx(gust * GUST[0], rel=0.5)


def test_outliers_lose_their_weight_and_good_windows_are_left_alone(fitted):
    _, windows, floors, _, _ = fitted
    spoilt = windows[0].residual.copy()
    spoilt[[40, 201]] += 0.2
    given = [replace(windows[0], residual=spoilt), windows[1]]
    grams = [marginal.gram_of(w, floors, 2) for w in given]
    first, second = noise.without_outliers(given, grams)
    assert set(np.flatnonzero(first.sigma > windows[0].sigma)) == {40, 201}
    assert second is windows[1]


@fixture(scope="module")
def bad_window(fitted):
    """Number of the window, levels and grams."""
    _, windows, floors, _, _ = fitted
    bad = next(i for i, w in enumerate(windows) if w.phase == "throw")
    push = windows[bad].latent @ default_rng(0).normal(0.0, 1.0, windows[bad].latent.shape[1])
    spoilt = [
        replace(w, residual=w.residual + push) if i == bad else w for i, w in enumerate(windows)
    ]
    return bad, *noise.fit(spoilt, [marginal.gram_of(w, floors, 2) for w in spoilt])


def test_one_bad_window_does_not_raise_the_level_of_its_phase(fitted, bad_window):
    levels, (bad, again, _) = fitted[3], bad_window
    assert (again.share[bad, [0, 2]] > 4.0).all()
    assert (np.delete(again.share, bad, 0) < 2.0).all()
    assert again.latent_sd[0, "throw"] < 2.0 * levels.latent_sd[0, "throw"]


@mark.parametrize(
    "spoil",
    [
        lambda w: replace(w, residual=np.full_like(w.residual, np.nan)),
        lambda w: replace(w, sigma=np.zeros_like(w.sigma)),
        lambda w: replace(w, channel=w.channel + 2),
        lambda w: replace(w, time=w.time[:-1]),
        lambda w: replace(w, effects=w.effects[:, :-1]),
    ],
)
def test_broken_windows_are_named(fitted, spoil):
    _, windows, floors, _, _ = fitted
    with raises(DiagnoseError, match="window of flight 0"):
        marginal.gram_of(spoil(windows[0]), floors, 2)


def test_estimates_stay_within_their_bounds_to_the_last_digit():
    """A lower bound of 0 that rounding leaves would be a compliance below 0."""
    worst = 0.0
    for seed in range(40):
        rng = default_rng(seed)
        root = rng.normal(size=(7, 7)) * 10.0 ** rng.uniform(-3.0, 3.0, 7)
        information = root.T @ root + 1e-6 * np.eye(7)
        score = 3.0 * rng.normal(size=7) * np.sqrt(np.diag(information))
        low = np.where(rng.random(7) < 0.5, 0.0, -rng.uniform(0.0, 1.0, 7))
        high = rng.uniform(0.1, 2.0, 7)
        priors = Priors(np.ones(7), np.full(7, 1e6), low, high, np.ones(7, bool))
        theta = Posterior(information, score, priors).estimate(range(7))
        worst = max(worst, np.max(low - theta), np.max(theta - high))
    assert worst <= 0.0

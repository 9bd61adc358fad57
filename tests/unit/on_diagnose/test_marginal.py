"""Sufficient statistics of windows against dense linear algebra, noise levels against
planted ones.
"""

from dataclasses import replace

import numpy as np
import pytest

from tests.synthetic_diagnosis import GUST, SyntheticModel, catalogue
from visthrow.common.errors import DiagnoseError
from visthrow.diagnose.likelihood import marginal
from visthrow.diagnose.likelihood import noise_levels as noise
from visthrow.diagnose.likelihood.evidence import Priors
from visthrow.diagnose.likelihood.stack import BATCH, Stack, integrals, statistics
from visthrow.diagnose.models.model_interface import Window
from visthrow.logs.check.signals import highpass_sigma

EFFECTS = catalogue(6)


def likelihood(gram, levels, window):
    """Logarithm of it, of one window by itself, but for the powers of 2 pi."""
    return -0.5 * alone(gram, levels, window).square


def alone(gram, levels, window, latents=False):
    """What a window says by itself."""
    return (
        Stack([gram], windows=[window]).integrals(levels, latents=latents).shares([gram], levels)[0]
    )


@pytest.fixture(scope="module")
def fitted():
    model = SyntheticModel(effects=EFFECTS, throws=4)
    windows, floors = model.windows({}), Priors.of(model.effects, model.channels).floor
    levels, grams = noise.fit(windows, [marginal.gram_of(w, floors, 2) for w in windows])
    return model, windows, floors, levels, grams


def dense(window, gram, levels, floors, at):
    """V and S of a window, written out."""
    deviation = levels.deviation(gram, at)
    columns = marginal.columns(window, floors)
    states = columns[:, : gram.nuisances] * deviation[: gram.nuisances]
    latents = (
        columns[:, gram.nuisances : len(deviation)] @ gram.factor * deviation[gram.nuisances :]
    )
    sensor = (window.sigma * levels.scale[window.channel]) ** 2
    return np.diag(sensor) + states @ states.T + latents @ latents.T, columns[:, len(deviation) :]


def test_information_and_score_are_those_of_the_dense_covariance(fitted):
    _, windows, floors, levels, grams = fitted
    for at in (0, 7):
        v, s = dense(windows[at], grams[at], levels, floors, at)
        part = statistics(grams, levels)[at]
        inverse = np.linalg.inv(v)
        np.testing.assert_allclose(part.information, s.T @ inverse @ s, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(
            part.score, s.T @ inverse @ windows[at].residual, rtol=1e-6, atol=1e-6
        )
        g = windows[at].latent
        whole = g.T @ inverse @ g
        np.testing.assert_allclose(
            part.latent_information, whole, rtol=1e-5, atol=1e-4 * np.abs(whole).max()
        )
        np.testing.assert_allclose(
            part.latent_score, g.T @ inverse @ windows[at].residual, rtol=1e-5, atol=1e-3
        )


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
    gram = marginal.correlated(marginal.gram_of(spared, floors, 2), spared, levels.correlation_time)
    for window, of, choice in (
        (windows[0], grams[0], levels),
        (windows[0], grams[0], other),
        (spared, gram, levels),
    ):
        v, _ = dense(window, of, choice, floors, 0)
        sign, log_det = np.linalg.slogdet(v)
        assert sign > 0
        dense_value = -0.5 * (log_det + window.residual @ np.linalg.solve(v, window.residual))
        assert likelihood(of, choice, 0) == pytest.approx(dense_value, abs=1e-3)


def test_windows_side_by_side_are_what_they_are_alone(fitted):
    """Of different sizes, in more batches than one, in their order."""
    _, windows, floors, levels, grams = fitted
    lean = [
        replace(
            w,
            latent=w.latent[:, :-4],
            latent_block=w.latent_block[:-4],
            latent_axis=w.latent_axis[:-4],
            latent_time=w.latent_time[:-4],
        )
        for w in windows[::3]
    ]
    shorter = [
        marginal.correlated(marginal.gram_of(w, floors, 2), w, levels.correlation_time)
        for w in lean
    ]
    mixed = [*grams, *shorter]
    rows = [*range(len(grams)), *range(0, len(grams), 3)]
    values = [likelihood(gram, levels, w) for gram, w in zip(mixed, rows)]
    assert len(mixed) > BATCH
    stack = Stack(mixed, windows=rows)
    np.testing.assert_allclose(stack.values(levels), values, rtol=1e-8)
    np.testing.assert_allclose(stack.look(levels)[0], values, rtol=1e-8)
    for latents in (False, True):
        together = stack.integrals(levels, latents=latents).shares(mixed, levels)
        for share, gram, w in zip(together, mixed, rows, strict=True):
            single = alone(gram, levels, w, latents)
            size = np.abs(single.information).max()
            np.testing.assert_allclose(share.information, single.information, atol=1e-9 * size)
            np.testing.assert_allclose(share.score, single.score, atol=1e-9 * size)
            assert share.square == pytest.approx(single.square, rel=1e-9)


def test_other_residuals_leave_the_information(fitted):
    _, _, floors, levels, grams = fitted
    theta = np.linspace(-1.0, 1.0, len(floors))
    shares = integrals(grams, levels).shares(grams, levels)
    known = marginal.gather(grams, shares, np.zeros(len(floors)))
    other = [replace(g, cross=0.5 * g.cross, square=0.25 * g.square) for g in grams]
    shares = integrals(other, levels).shares(other, levels)
    plain, again = (
        marginal.gather(other, shares, theta),
        marginal.rescored(known, other, shares, theta),
    )
    for name in (
        "flights",
        "information",
        "score",
        "square",
        "samples",
        "theta",
        "absolute",
        "absolute_square",
    ):
        np.testing.assert_allclose(getattr(again, name), getattr(plain, name), rtol=1e-12)
    assert not np.allclose(again.score, known.score)


def test_broken_derivatives_are_told_with_their_window(fitted):
    gram = fitted[4][3]
    with pytest.raises(
        DiagnoseError,
        match=f"flight {gram.flight}, phase {gram.phase}: the normal equations are singular",
    ):
        Stack([fitted[4][0], replace(gram, inner=-1e6 * gram.inner)]).values(fitted[3])


def test_a_single_huge_state_does_not_leak_into_the_effects(fitted):
    """Initial states are vague: a shift of 0.1 m changes the score by rounding alone."""
    _, windows, floors, levels, grams = fitted
    shifted = windows[0].residual + windows[0].nuisance @ np.full(12, 0.1)
    plain, moved = (
        alone(g, levels, 0)
        for g in (grams[0], marginal.with_residual(grams[0], windows[0], floors, shifted))
    )
    own = np.sqrt(np.diag(plain.information))
    assert np.max(np.abs(moved.score - plain.score) / own) < 0.1


def test_gradients_of_the_likelihood_are_its_differences(fitted):
    _, _, _, levels, grams = fitted
    levels = replace(
        levels, share=levels.share * np.random.default_rng(0).uniform(0.7, 1.4, levels.share.shape)
    )
    layout = noise._Layout.of(grams, levels)
    x = layout.pack(levels)
    stack = Stack(grams)
    _, slope, _ = noise._likelihood(stack, levels, layout)
    step, first = 1e-3, len(layout.keys)

    def value(i: int, h: float) -> float:
        moved = x.copy()
        moved[i] += h
        return noise._likelihood(stack, layout.unpack(moved, levels), layout)[0]

    for i in [*range(first), first, first + 7, len(x) - 2, len(x) - 1]:
        assert (value(i, step) - value(i, -step)) / (2 * step) == pytest.approx(
            slope[i], rel=1e-3, abs=0.1
        )


@pytest.mark.parametrize(("sensor", "gust"), [(1.0, 1.0), (2.0, 0.5)])
def test_noise_levels_are_found_again(sensor, gust):
    model = SyntheticModel(effects=EFFECTS, throws=8, noise=sensor, gust=gust, seed=3)
    windows = model.windows({})
    levels, _ = noise.fit(windows, [marginal.gram_of(w, np.ones(6), 2) for w in windows])
    np.testing.assert_allclose(levels.scale, sensor, rtol=0.1)
    found = np.mean([levels.latent_sd[0, p] for p in ("flight", "hover", "throw")])
    assert found == pytest.approx(gust * GUST[0], rel=0.5)


def test_highpass_sigma_sees_noise_and_neither_motion_nor_outliers():
    rng = np.random.default_rng(0)
    t = np.arange(2000) / 200.0
    signal = np.sin(3.0 * t)[:, None] + rng.normal(0.0, 5e-4, (2000, 2))
    signal[::97] += 0.05
    np.testing.assert_allclose(highpass_sigma(signal), 5e-4, rtol=0.1)


@pytest.mark.parametrize("device", ["cpu", "cpu:0"])
def test_outliers_lose_their_weight_and_good_windows_are_left_alone(fitted, device):
    """Whether each window is looked at by itself or all at once, as on a GPU."""
    _, windows, floors, _, _ = fitted
    spoilt = windows[0].residual.copy()
    spoilt[[40, 201]] += 0.2
    given = [replace(windows[0], residual=spoilt), windows[1]]
    first, second = noise.without_outliers(
        given, [marginal.gram_of(w, floors, 2) for w in given], device
    )
    assert set(np.flatnonzero(first.sigma > windows[0].sigma)) == {40, 201}
    assert second is windows[1]


@pytest.fixture(scope="module")
def bad_window(fitted):
    """Number of the window, levels and grams."""
    _, windows, floors, _, _ = fitted
    bad = next(i for i, w in enumerate(windows) if w.phase == "throw")
    push = windows[bad].latent @ np.random.default_rng(0).normal(
        0.0, 1.0, windows[bad].latent.shape[1]
    )
    spoilt = [
        replace(w, residual=w.residual + push) if i == bad else w for i, w in enumerate(windows)
    ]
    return bad, *noise.fit(spoilt, [marginal.gram_of(w, floors, 2) for w in spoilt])


def test_one_bad_window_does_not_raise_the_level_of_its_phase(fitted, bad_window):
    levels, (bad, again, _) = fitted[3], bad_window
    assert (again.share[bad, [0, 2]] > 4.0).all()
    assert (np.delete(again.share, bad, axis=0) < 2.0).all()
    assert again.latent_sd[0, "throw"] < 2.0 * levels.latent_sd[0, "throw"]


def test_levels_do_not_depend_on_where_their_search_starts(bad_window):
    """Two models may only differ by what they explain, not by how far the levels of their bad
    windows were sought.
    """
    _, found, grams = bad_window

    def value(levels) -> float:
        return levels.log_prior + sum(likelihood(gram, levels, w) for w, gram in enumerate(grams))

    less = np.where(found.share == 1.0, 1.0, 0.7 * found.share)
    starts = [replace(found, share=share) for share in (less, np.ones_like(found.share))]
    again = [value(noise.maximised(grams, start, "cpu")[0]) for start in starts]
    np.testing.assert_allclose(again, value(found), atol=10.0 * noise.ENOUGH_NATS)


def test_rounding_of_huge_derivatives_does_not_spoil_the_curvature(fitted):
    """Columns of 1e5 deviations once took -50 degrees of freedom from three samples, and the
    levels' step had no solution.
    """
    _, _, _, levels, grams = fitted
    gram, deviation = grams[0], levels.deviation(grams[0], 0)
    size = len(deviation)
    largest = np.linalg.eigvalsh(gram.inner[0][:size, :size] * np.outer(deviation, deviation)).max()
    square = 0.1 * gram.inner[0] / largest
    weight = levels.scale**-2.0
    spoilt = replace(gram, inner=np.stack((square / weight[0], -2.0 * square / weight[1])))
    _, _, curvature = Stack([spoilt]).look(levels)
    assert np.abs(curvature).max() <= 2.0 * max(gram.count.max(), gram.latents)


@pytest.mark.parametrize(
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
    with pytest.raises(DiagnoseError, match="window of flight 0"):
        marginal.gram_of(spoil(windows[0]), floors, 2)


def test_a_model_without_latent_forces_works():
    rng = np.random.default_rng(0)
    n = 50
    s, x = rng.normal(size=(n, 2)), np.ones((n, 1))
    window = Window(
        0,
        "swing",
        np.arange(n) / 50.0,
        np.zeros(n, dtype=int),
        s @ [0.3, 0.0] + rng.normal(size=n) * 0.1,
        np.full(n, 0.1),
        s,
        x,
        np.ones(1),
        latent=np.zeros((n, 0)),
    )
    levels, grams = noise.fit([window], [marginal.gram_of(window, np.ones(2), 1)])
    part = alone(grams[0], levels, 0)
    assert np.linalg.solve(part.information, part.score) == pytest.approx([0.3, 0.0], abs=0.05)


def test_rounding_leaves_no_negative_information(fitted):
    """Two effects that are one but for rounding: a wide prior would turn the negative eigenvalue
    into evidence.
    """
    *_, levels, grams = fitted
    part = alone(grams[0], levels, 0)
    nearly = np.array([[1.0, 1.0 + 1e-7], [1.0 + 1e-7, 1.0]])
    found = marginal.gather(
        grams[:1], [replace(part, information=1e6 * nearly, score=np.zeros(2))], np.zeros(2)
    )
    assert np.linalg.eigvalsh(1e6 * nearly).min() < 0.0
    assert np.linalg.eigvalsh(found.information.sum(0)).min() >= 0.0


def test_an_effect_that_the_initial_state_explains_but_for_rounding_says_nothing(fitted):
    """The difference of two numbers of 1e13 is rounding of either sign: beside an effect that is
    seen it made an eigenvalue of -1e-4, and the diagnosis ended.
    """
    *_, levels, grams = fitted
    part, size = alone(grams[0], levels, 0), 2
    squares = grams[0].inner[:, : grams[0].nuisances + grams[0].latents + size].copy()
    squares = squares[:, :, : squares.shape[1]]
    squares[:, -1, -1] = 1e13
    gram = replace(grams[0], inner=squares, cross=grams[0].cross[:, : squares.shape[1]])
    left = np.array([[1e6, 10.0], [10.0, 1e-6]])
    assert np.linalg.eigvalsh(left).min() < 0.0
    found = marginal.gather(
        [gram], [replace(part, information=left, score=np.array([5.0, 7.0]))], np.zeros(size)
    )
    np.testing.assert_array_equal(found.information[0], [[1e6, 0.0], [0.0, 0.0]])
    np.testing.assert_array_equal(found.score[0], [5.0, 0.0])
    again = marginal.rescored(
        found, [gram], [replace(part, score=np.array([6.0, 7.0]))], np.zeros(2)
    )
    np.testing.assert_array_equal(again.score[0], [6.0, 0.0])


def test_information_that_is_negative_beyond_rounding_is_an_error(fitted):
    *_, levels, grams = fitted
    part = alone(grams[0], levels, 0)
    wrong = 1e6 * np.array([[1.0, 1.01], [1.01, 1.0]])
    with pytest.raises(DiagnoseError, match=r"eigenvalue -1\.0e-02 relative to its diagonal"):
        marginal.gather(
            grams[:1], [replace(part, information=wrong, score=np.zeros(2))], np.zeros(2)
        )

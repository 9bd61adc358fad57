"""Intervals against closed forms and by their coverage on made-up throws."""

import numpy as np
from numpy.random import default_rng
from pytest import approx, raises
from scipy import stats

from visthrow.common import statistics as st

TRIALS = 300
COVERAGE = 0.045
"""Allowed distance of the coverage from 95 % over :data:`TRIALS` trials: four standard deviations,
and the bootstrap's own bias.
"""

CLOSED = 0.06
"""Of an interval's width: noise of the bootstrap's quantiles at 20,000 draws is 2 %, the rest is
the sample's skew.
"""


def test_interval_of_a_mean_is_the_closed_form():
    """Of many normal throws: mean +- 1.96 standard errors."""
    x = default_rng(1).normal(0.03, 0.01, 400)
    interval = st.mean(x, draws=20000)
    half = 1.96 * x.std() / np.sqrt(len(x))
    assert interval.value == approx(x.mean())
    assert interval.low == approx(x.mean() - half, abs=CLOSED * half)
    assert interval.high == approx(x.mean() + half, abs=CLOSED * half)


def test_two_levels_carry_the_scatter_of_the_runs():
    """Variance of the bootstrap mean:

    (variance of run means + mean of throw variances / N) / runs, as drawn.
    """
    rng = default_rng(2)
    groups = [rng.normal(m, 0.01, 50) for m in (0.02, 0.03, 0.05, 0.06)]
    samples = st._resample(groups, default_rng(0), 40000)
    means = np.array([g.mean() for g in groups])
    expected = (means.var() + np.mean([g.var() for g in groups]) / 50) / 4
    assert samples.var() == approx(expected, rel=0.04)
    assert samples.mean() == approx(means.mean(), abs=1e-4)


def covered(make, truth: float) -> float:
    rng = default_rng(3)
    return np.mean([truth in make(rng) for _ in range(TRIALS)])


def test_coverage_of_a_ratio_and_a_difference():
    share = covered(
        lambda rng: st.ratio(rng.rayleigh(0.06, 80), rng.rayleigh(0.02, 80), draws=800), 3.0
    )
    assert abs(share - 0.95) < COVERAGE
    gap = 0.01 * np.sqrt(np.pi / 2)
    share = covered(
        lambda rng: st.difference(rng.rayleigh(0.03, 80), rng.rayleigh(0.02, 80), draws=800), gap
    )
    assert abs(share - 0.95) < COVERAGE


def test_pairs_remove_what_both_share():
    rng = default_rng(5)
    shared = rng.normal(0.0, 0.1, 200)
    a, b = shared + rng.normal(0.01, 0.005, 200), shared + rng.normal(0.0, 0.005, 200)
    a[3] = np.nan
    pair, alone = st.compare_pairs(a, b), st.difference(a[np.isfinite(a)], b)
    assert 0.01 in pair
    assert (pair.high - pair.low) < 0.2 * (alone.high - alone.low)


def test_correlation_against_fisher():
    """Interval of a correlation of normal pairs: tanh(atanh r +- 1.96 / sqrt(n - 3))."""
    rng = default_rng(6)
    x = rng.normal(size=500)
    y = 0.8 * x + 0.6 * rng.normal(size=500)
    interval = st.correlation(x, y)
    assert interval.value == approx(stats.pearsonr(x, y).statistic)
    ends = np.tanh(np.arctanh(interval.value) + np.array([-1.96, 1.96]) / np.sqrt(497))
    assert [interval.low, interval.high] == approx(ends, abs=0.008)
    with raises(ValueError, match="three or more pairs"):
        st.correlation(x[:2], y[:2])


def test_bias_splits_the_mean_square():
    rng = default_rng(7)
    miss = rng.normal([-0.05, 0.0], [0.02, 0.01], (300, 2))
    miss[:, 1] -= miss[:, 1].mean()
    bias = st.bias(miss)
    assert bias.offset**2 + bias.scatter**2 == approx((miss**2).sum(1).mean())
    assert bias.scatter == approx(np.sqrt(miss.var(0).sum()))
    assert -0.05 in bias.along
    assert bias.direction == "undershoots"
    assert st.bias(miss * [-1.0, 1.0] + [0.0, -0.02]).direction == "overshoots, right"
    assert st.bias(rng.normal(0.0, 0.02, (300, 2))).share < 0.05


def test_an_empty_average_is_refused():
    with raises(ValueError, match="expected finite numbers"):
        st.mean([np.zeros(0)])
    with raises(ValueError, match="expected finite numbers"):
        st.mean(np.array([1.0, np.nan]))
    assert st.mean(np.array([0.02])).low == 0.02
    assert st.Interval(1.0, 0.5, 2.0).text(1, sign=True) == "+1.0 [+0.5, +2.0]"

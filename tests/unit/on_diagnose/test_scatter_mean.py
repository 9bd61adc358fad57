"""What all flights share of an effect is no scatter: it is named, with its size, whether the effect
varies beside it or not.
"""

from dataclasses import replace

import numpy as np
from numpy.random import default_rng
from numpy.testing import assert_allclose
from pytest import mark

from tests.synthetic_diagnosis import SyntheticModel, catalogue
from tests.unit.on_diagnose.test_scatter import NAMES, PRIORS, chosen_of, flights
from visthrow.diagnose.select import result, search
from visthrow.diagnose.select.scatter import FLIGHT, Varies, freed

EFFECTS = tuple(replace(e, name="cmd_delay") if i == 4 else e for i, e in enumerate(catalogue(12)))
FLOOR = EFFECTS[4].floor


class Drawn(SyntheticModel):
    """Flights each of which has its own size of one effect, in floors."""

    sizes = ()

    def __post_init__(self):
        super().__post_init__()
        self._windows = [
            replace(
                w,
                residual=w.residual + self._answer(w.effects, {"cmd_delay": self.sizes[w.flight]}),
            )
            for w in self._windows
        ]


def drawn(sizes, **options) -> SyntheticModel:
    return type("Own", (Drawn,), {"sizes": tuple(sizes)})(
        effects=EFFECTS, throws=len(sizes) - 1, free=1, **options
    )


def deviation_of(mean: float, deviation: float, seed: int) -> float:
    """Return the deviation that is found of a release that is late by so much in all flights and by
    so much more or less in each [s]; 0 where it does not vary.
    """
    found = flights(default_rng(seed), release_lag=deviation)
    common = np.zeros(len(NAMES))
    common[0] = mean / PRIORS.floor[0]
    moved = found.score + found.information @ common
    return chosen_of(replace(found, score=moved))[1].get("lag_jitter", 0.0)


def jitter(diagnosis):
    return next(s for s in diagnosis.scatter if s.name == "cmd_jitter")


def test_a_deviation_is_about_the_mean():
    found = np.array([deviation_of(0.080, 0.012, seed) for seed in range(12)])
    assert np.mean(found > 0.0) > 0.9
    assert abs(np.median(found) / 0.012 - 1.0) < 0.3


def test_what_flights_have_of_their_own_is_integrated_out():
    found, K, j, size = flights(default_rng(3), count=1), len(NAMES), 2, 1.7
    left, own, score = (
        freed(found, Varies((), {(j, FLIGHT): size})),
        found.information[0],
        found.score[0],
    )
    theta = default_rng(4).normal(size=K)

    def misfit(x):
        there = theta + np.eye(K)[j] * x[:, None]
        return -2.0 * there @ score + np.einsum("xi,ij,xj->x", there, own, there)

    x = np.linspace(-12.0 * size, 12.0 * size, 20001)
    density = (
        np.exp(-0.5 * (misfit(x) - misfit(np.zeros(1))) - 0.5 * (x / size) ** 2)
        / np.sqrt(2.0 * np.pi)
        / size
    )
    whole = found.square[0] + misfit(np.zeros(1))[0] - 2.0 * np.log(density.sum() * (x[1] - x[0]))
    told = left.square[0] - 2.0 * theta @ left.score[0] + theta @ left.information[0] @ theta
    assert_allclose(told, whole, rtol=1e-9)


# Less than what flights may differ by, and more.
@mark.parametrize(("seed", "deviation"), [(1, 4.0), (2, 9.0)])
def test_an_effect_that_varies_about_a_mean_is_named_and_varies(seed, deviation):
    sizes = 14.0 + deviation * default_rng(seed).permutation(np.linspace(-1.7, 1.7, 16))
    diagnosis = search.explain(drawn(sizes, seed=seed), laws=False)
    assert diagnosis.overall == result.KNOWN
    assert diagnosis.named == ("cmd_delay",)
    found, varies = diagnosis["cmd_delay"], jitter(diagnosis)
    assert found.low < 14.0 * FLOOR < found.high
    assert (
        found.sd > deviation * FLOOR / np.sqrt(16) * 0.8
    )  # no mean is known better than its flights scatter
    assert varies.found
    assert varies.low < deviation * FLOOR < varies.high


def test_an_effect_that_varies_about_nothing_is_not_named():
    sizes = 6.0 * default_rng(5).permutation(np.linspace(-1.7, 1.7, 12))
    diagnosis = search.explain(drawn(sizes, seed=5), laws=False)
    assert not diagnosis.theta
    assert jitter(diagnosis).found
    mean = jitter(diagnosis).mean["cmd_delay"]
    assert abs(mean - sizes.mean() * FLOOR) < 3.0 * 6.0 * FLOOR / np.sqrt(12)
    assert mean != 0.0
    assert diagnosis.expected == {"cmd_delay": mean}

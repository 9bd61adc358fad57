"""Error rates of the search over many random worlds: false alarms, completeness, coverage.

Minutes, hence slow.
"""

import numpy as np
from pytest import mark
from scipy.stats import binom

from tests.synthetic_diagnosis import SyntheticModel, catalogue
from visthrow.diagnose.select import result, search

pytestmark = mark.slow

EFFECTS = catalogue(20)
NULLS, SINGLES, PAIRS = 100, 30, 20
SURE = 0.01
"""Probability below which a count speaks against the rate that is promised."""


def worlds(count: int, hidden: int, floors: float, seed: int):
    """Random worlds with noise and gusts from half to twice their usual level."""
    rng = np.random.default_rng(seed)
    for i in range(count):
        names = rng.choice([e.name for e in EFFECTS], hidden, replace=False)
        truth = {
            str(name): float(rng.choice((-1.0, 1.0)) * floors * rng.uniform(0.9, 1.1))
            for name in names
        }
        yield (
            truth,
            SyntheticModel(
                effects=EFFECTS,
                truth=truth,
                seed=int(rng.integers(10**6)),
                noise=rng.choice([0.5, 1.0, 2.0]),
                gust=rng.choice([0.5, 1.0, 2.0]),
                curvature=0.1,
                fresh=i,
            ),
        )


def test_null_worlds_raise_no_false_alarm():
    """At most as many as a rate of one per cent allows."""
    alarms = [
        d
        for _, model in worlds(NULLS, 0, 0.0, 1)
        if (d := search.explain(model)).overall != result.NO_EFFECT
    ]
    assert binom.sf(len(alarms) - 1, NULLS, 0.01) > SURE, [a.reasons for a in alarms]


@mark.parametrize(("floors", "found"), [(6.0, 0.75), (10.0, 0.92), (15.0, 0.97)])
def test_single_effects_are_found_and_named_rightly(floors, found):
    right = wrong = 0
    for truth, model in worlds(SINGLES, 1, floors, int(floors)):
        named = set(search.explain(model, laws=False).named)
        right += named == set(truth)
        wrong += bool(named - set(truth))
    assert binom.cdf(right, SINGLES, found) > SURE
    assert binom.sf(wrong - 1, SINGLES, 0.02) > SURE


def test_pairs_are_found_and_intervals_cover():
    right, inside = 0, []
    for truth, model in worlds(PAIRS, 2, 12.0, 3):
        diagnosis = search.explain(model, laws=False)
        right += set(diagnosis.named) == set(truth)
        for name, size in truth.items():
            f = diagnosis[name]
            if f.verdict == result.FOUND:
                inside.append(f.low <= size * f.floor <= f.high)
    assert binom.cdf(right, PAIRS, 0.9) > SURE
    assert binom.cdf(sum(inside), len(inside), 0.95) > SURE

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
NULLS, WORLDS = 100, 30
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
    found = [search.explain(model).overall for _, model in worlds(NULLS, 0, 0.0, 1)]
    alarms = sum(overall != result.NO_EFFECT for overall in found)
    assert binom.sf(alarms - 1, NULLS, 0.01) > SURE


@mark.parametrize(
    ("hidden", "floors", "found"),
    [(1, 6.0, 0.75), (1, 10.0, 0.92), (1, 15.0, 0.97), (2, 12.0, 0.9)],
)
def test_effects_are_named_rightly_and_intervals_cover(hidden, floors, found):
    right, wrong, inside = 0, 0, []
    for truth, model in worlds(WORLDS, hidden, floors, int(floors)):
        diagnosis = search.explain(model, laws=False)
        named = set(diagnosis.named)
        right += named == set(truth)
        wrong += bool(named - set(truth))
        for name in named & set(truth):
            finding = diagnosis[name]
            inside.append(finding.low <= truth[name] * finding.floor <= finding.high)
    assert binom.cdf(right, WORLDS, found) > SURE
    assert binom.sf(wrong - 1, WORLDS, 0.02) > SURE
    assert binom.cdf(sum(inside), len(inside), 0.95) > SURE

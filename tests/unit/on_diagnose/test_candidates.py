"""Candidates whose derivatives at the model's own values fall short of what they explain: they are
looked at where they lead.
"""

import numpy as np
from pytest import approx

from tests.synthetic_diagnosis import SyntheticModel, catalogue
from visthrow.diagnose.select import result, search

EFFECTS = catalogue(12)
NAME, SIZE = "effect_03", 10.0  # in floors
LUCK, SHOWN = 0.3, 0.2
"""What better initial states explain, in noise; what an effect does there, in what its derivative
says.
"""
BUMP = 0.3
"""Misfit a floor's distance from where initial states were fitted, in noise."""


class Whipping(SyntheticModel):
    """Initial states that are fitted at one size of the effect explain little at another."""

    def __post_init__(self):
        super().__post_init__()
        self.at = 0.0

    def windows(self, theta):
        self.at = theta.get(NAME, 0.0)
        return super().windows(theta)

    def residuals(self, theta, about=None):
        floor = EFFECTS[3].floor
        far = BUMP * (theta.get(NAME, 0.0) - self.at) / floor
        rough = np.random.default_rng(3)
        return [
            r + far * w.sigma * rough.choice((-1.0, 1.0), len(r))
            for r, w in zip(super().residuals(theta), self._windows)
        ]


def explained(size: float):
    return search.explain(Whipping(effects=EFFECTS, truth={NAME: size}, seed=5), laws=False)


def test_a_candidate_that_promises_more_than_it_keeps_is_looked_at_where_it_leads():
    diagnosis = explained(SIZE)
    assert diagnosis.named == (NAME,)
    assert diagnosis[NAME].estimate == approx(SIZE * EFFECTS[3].floor, rel=0.1)
    assert diagnosis.overall == result.KNOWN

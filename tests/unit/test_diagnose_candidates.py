"""Candidates whose derivatives at the model's own values fall short of what they explain: they are looked at where they lead."""

from dataclasses import replace

import numpy as np
import pytest

from tests.synthetic_diagnosis import SyntheticModel, catalogue
from visthrow.diagnose import result, search

EFFECTS = catalogue(12)
NAME, SIZE = "effect_03", 10.0  # in floors


class Whipping(SyntheticModel):
    """Initial states that are fitted at one size of the effect explain nothing at another; and from 0 the effect looks small."""

    bump = 0.0  # misfit a floor's distance from where initial states were fitted, in noise
    shrunk = 1.0  # of the derivatives at 0

    def __post_init__(self):
        super().__post_init__()
        self.at = 0.0

    def windows(self, theta):
        self.at = theta.get(NAME, 0.0)
        found = super().windows(theta)
        return found if self.at else [self._weak(w) for w in found]

    def residuals(self, theta):
        floor = EFFECTS[3].floor
        far = self.bump * (theta.get(NAME, 0.0) - self.at) / floor
        rough = np.random.default_rng(3)
        return [r + far * w.sigma * rough.choice((-1.0, 1.0), len(r)) for r, w in zip(super().residuals(theta), self._windows)]

    def _weak(self, window):
        effects = window.effects.copy()
        effects[:, 3] *= self.shrunk
        return replace(window, effects=effects)


def explained(bump: float, shrunk: float = 1.0, size: float = SIZE):
    model = type("Model", (Whipping,), {"bump": bump, "shrunk": shrunk})(effects=EFFECTS, truth={NAME: size}, seed=4)
    return search.explain(model, laws=False)


def test_a_candidate_that_promises_more_than_it_keeps_is_looked_at_where_it_leads():
    diagnosis = explained(bump=0.3)
    assert diagnosis.named == (NAME,)
    assert diagnosis[NAME].estimate == pytest.approx(SIZE * EFFECTS[3].floor, rel=0.1)
    assert diagnosis.overall == result.KNOWN


def test_what_whips_where_nothing_is_hidden_is_not_named():
    assert explained(bump=0.3, size=0.0).overall == result.NO_EFFECT

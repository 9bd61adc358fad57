"""Models that differ from their derivatives: candidates are evaluated by simulation, and windows
that the simulation does not follow are left out.
"""

from dataclasses import replace

import numpy as np
from numpy.random import default_rng
from pytest import approx, mark

from tests.synthetic_diagnosis import (
    EFFECTS,
    SyntheticModel,
    catalogue,
    explain_without_laws,
    linearise_flights,
)
from visthrow.diagnose.models.model_interface import Window
from visthrow.diagnose.select import diagnose_flights, result
from visthrow.diagnose.select.point import untracked_windows

NAME, SIZE = "effect_03", 10.0  # in floors
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
        rough = default_rng(3)
        return [
            r + far * w.sigma * rough.choice((-1.0, 1.0), len(r))
            for r, w in zip(super().residuals(theta), self._windows)
        ]


def test_a_candidate_that_promises_more_than_it_keeps_is_looked_at_where_it_leads():
    diagnosis = explain_without_laws(Whipping(truth={NAME: SIZE}, seed=5))
    assert diagnosis.named == (NAME,)
    assert diagnosis[NAME].estimate == approx(SIZE * EFFECTS[3].floor, rel=0.1)
    assert diagnosis.overall == result.KNOWN


class Levered(SyntheticModel):
    """A floor of one effect does what three floors of another do, and something of its
    own besides.
    """

    by, lever = 1, 3.0

    def _share(self, w):
        return self.lever * w.effects[:, 3] * EFFECTS[3].floor / EFFECTS[self.by].floor

    def windows(self, theta):
        mask = np.arange(len(EFFECTS)) == self.by
        pairs = zip(super().windows(theta), self.residuals(theta))
        return [
            replace(w, residual=r, effects=w.effects + self._share(w)[:, None] * mask)
            for w, r in pairs
        ]

    def residuals(self, theta, about=None):
        e = EFFECTS[self.by]
        left = self.truth.get(e.name, 0.0) * e.floor - theta.get(e.name, 0.0)
        return [r + left * self._share(w) for r, w in zip(super().residuals(theta), self._windows)]


def test_sizes_and_intervals_hold_whatever_else_is_below_its_floor():
    off = []
    for seed in range(3):
        truth = {NAME: 2.0 * SIZE, EFFECTS[Levered.by].name: 0.9}
        diagnosis = explain_without_laws(Levered(truth=truth, seed=seed, throws=8))
        assert diagnosis.named == (NAME,)
        size, finding = 2.0 * SIZE * EFFECTS[3].floor, diagnosis[NAME]
        off.append((finding.estimate - size) / finding.sd)
        assert diagnosis.theta[NAME] == finding.estimate
        assert diagnosis.covariance[0][0] >= finding.sd**2
    assert abs(np.mean(off)) < 1.0, off


class Sideways(SyntheticModel):
    """A large effect_01 moves what effect_04 moves as well; its derivative at 0 does not say so."""

    def _answer(self, effects: np.ndarray, sizes: dict[str, float]) -> np.ndarray:
        j = self._at["effect_04"]
        size = sizes.get("effect_01", 0.0)
        aside = effects[:, j] * self.effects[j].floor * size**2 / 20.0
        return super()._answer(effects, sizes) + aside

    def windows(self, theta: dict[str, float]) -> list[Window]:
        first, second = self._at["effect_01"], self._at["effect_04"]
        floors = self.effects[second].floor / self.effects[first].floor
        size = self._sizes(theta).get("effect_01", 0.0)
        windows = super().windows(theta)
        for window in windows:
            window.effects[:, first] += window.effects[:, second] * floors * size / 10.0
        return windows


def test_of_causes_of_which_only_one_exists_that_one_is_named():
    """The simulated set holds a cause near 0; without it the other has hardly been listed."""
    model = Sideways(effects=catalogue(20), truth={"effect_01": 40.0}, throws=6, free=2)
    assert explain_without_laws(model).named == ("effect_01",)


BAD = 10
"""Number of the window that is spoiled."""
ROUGH = 1.0
"""Noise that is added there, in its own."""


class Spoiled(SyntheticModel):
    """One window moves at random; with ``beyond`` only where the first effect is larger than that
    [floors].
    """

    shaken, rough, beyond = True, ROUGH, -1.0

    def _spoil(self, theta, residuals):
        if abs(theta.get("effect_00", 0.0)) / EFFECTS[0].floor <= self.beyond:
            return residuals
        noise = np.random.default_rng(1).standard_normal(len(residuals[BAD]))
        noise *= self.rough * self._windows[BAD].sigma
        return [r + noise if i == BAD else r for i, r in enumerate(residuals)]

    def windows(self, theta):
        inherited = super().windows(theta)
        return [replace(w, shaken=self.shaken and i == BAD) for i, w in enumerate(inherited)]

    def residuals(self, theta, about=None):
        return self._spoil(theta, super().residuals(theta, about))


@mark.parametrize(
    ("shaken", "rough", "expected"),
    [(True, 0.0, []), (True, ROUGH, [BAD]), (False, ROUGH, []), (False, 3.0, [BAD])],
)
def test_less_misfit_is_taken_from_a_window_after_slack(shaken, rough, expected):
    model = Spoiled(throws=8, seed=4)
    model.shaken, model.rough = shaken, rough
    assert untracked_windows(linearise_flights(model)) == expected


def test_a_window_that_is_lost_where_the_cause_is_is_left_out_and_the_search_goes_on():
    lines = []
    model = Spoiled(truth={"effect_00": 15.0}, throws=8, seed=4)
    model.rough, model.beyond = 4.0, 5.0
    diagnosis = diagnose_flights.explain(model, laws=False, progress=lines.append)
    assert sum("are left out, which the simulation does not follow" in line for line in lines) == 1
    assert diagnosis.overall == result.KNOWN
    assert diagnosis.named == ("effect_00",)
    count = len(model.windows({}))
    assert diagnosis.windows == count - 1
    assert diagnosis.reasons[-1].startswith(f"1 of {count} windows are left out")

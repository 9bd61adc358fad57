"""Windows that the simulation does not follow: which are left out, when, and what they would have
been taken for.
"""

from dataclasses import replace

import numpy as np
from pytest import mark

from tests.synthetic_diagnosis import EFFECTS, SyntheticModel
from visthrow.diagnose.select import result, search
from visthrow.diagnose.select.point import Problem, linearise, untracked_windows

BAD = 10
"""Number of the window that is spoiled."""
ROUGH = 1.0
"""Noise that is added there, in its own."""


class Spoiled(SyntheticModel):
    """One window moves as nobody can know; with ``beyond`` only where the first effect is larger
    than that [floors].
    """

    shaken, rough, beyond = True, ROUGH, -1.0

    def _spoilt(self, theta, residuals):
        if abs(theta.get("effect_00", 0.0)) / EFFECTS[0].floor <= self.beyond:
            return residuals
        noise = (
            np.random.default_rng(1).standard_normal(len(residuals[BAD]))
            * self.rough
            * self._windows[BAD].sigma
        )
        return [r + noise if i == BAD else r for i, r in enumerate(residuals)]

    def windows(self, theta):
        found = super().windows(theta)
        return [replace(w, shaken=self.shaken and i == BAD) for i, w in enumerate(found)]

    def residuals(self, theta, about=None):
        return self._spoilt(theta, super().residuals(theta, about))


def lost_of(model) -> list[int]:
    windows = model.windows({})
    problem = Problem(model, tuple(range(len(windows))))
    return untracked_windows(linearise(problem, np.zeros(len(model.effects)), windows=windows))


@mark.parametrize(
    ("shaken", "rough", "expected"),
    [(True, 0.0, []), (True, ROUGH, [BAD]), (False, ROUGH, []), (False, 3.0, [BAD])],
)
def test_less_misfit_is_taken_from_a_window_after_slack(shaken, rough, expected):
    model = Spoiled(throws=8, seed=4)
    model.shaken, model.rough = shaken, rough
    assert lost_of(model) == expected


def test_a_window_that_is_lost_where_the_cause_is_is_left_out_and_the_search_goes_on():
    said = []
    model = Spoiled(truth={"effect_00": 15.0}, throws=8, seed=4)
    model.rough, model.beyond = 4.0, 5.0
    diagnosis = search.explain(model, laws=False, progress=said.append)
    assert sum("are left out, which the simulation does not follow" in line for line in said) == 1
    assert diagnosis.overall == result.KNOWN
    assert diagnosis.named == ("effect_00",)
    count = len(model.windows({}))
    assert diagnosis.windows == count - 1
    assert diagnosis.reasons[-1].startswith(f"1 of {count} windows are left out")

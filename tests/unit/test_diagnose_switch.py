"""Another kind of block is there or not: no step of a fit turns one into the other."""

from dataclasses import replace

import numpy as np

from tests.synthetic_diagnosis import SyntheticModel, catalogue
from visthrow.diagnose.catalogue import ALL
from visthrow.diagnose.evidence import Priors
from visthrow.diagnose.point import Problem, fitted, linearise

EFFECTS = tuple(replace(e, switch=i == 3) for i, e in enumerate(catalogue(6)))


def test_a_fit_leaves_switches_where_they_are_and_moves_the_others():
    model = SyntheticModel(effects=EFFECTS, truth={"effect_03": 10.0, "effect_01": 8.0}, seed=4)
    problem = Problem(model, Priors.of(EFFECTS, tuple(model.channels)), tuple(range(len(model.windows({})))))
    for at in (0.0, 7.0):
        point = linearise(problem, np.where(np.arange(6) == 3, at, 0.0))
        found = fitted(problem, point, [1, 3])
        assert found.theta[3] == at
        assert abs(found.theta[1]) > 2.0


def test_the_catalogue_says_which_effects_are_switches():
    assert {name for name, e in ALL.items() if e.effect.switch} == {name for name, e in ALL.items() if e.switch is not None}
    assert ALL["controller_kind"].effect.switch

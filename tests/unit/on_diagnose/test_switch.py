"""Another kind of block is there or not: no step of a fit turns one into the other."""

from dataclasses import replace

import numpy as np

from tests.synthetic_diagnosis import SyntheticModel, catalogue, explain_without_laws
from visthrow.diagnose.select.point import Problem, fit, linearise

EFFECTS = tuple(replace(e, switch=i == 3) for i, e in enumerate(catalogue(6)))


def test_a_fit_leaves_switches_where_they_are_and_moves_the_others():
    model = SyntheticModel(effects=EFFECTS, truth={"effect_03": 10.0, "effect_01": 8.0}, seed=4)
    problem = Problem(model, tuple(range(len(model.windows({})))))
    for at in (0.0, 7.0):
        point = linearise(problem, np.where(np.arange(6) == 3, at, 0.0))
        refitted = fit(point, [1, 3])
        assert refitted.theta[3] == at
        assert abs(refitted.theta[1]) > 2.0


class Promising(SyntheticModel):
    """Another kind of block that explains the flights by its derivative, and not once it is
    simulated.
    """

    def residuals(self, theta, about=None):
        off = np.random.default_rng(5)
        on = theta.get("effect_03", 0.0) != 0.0
        return [
            r + on * 2.0 * w.sigma * off.normal(size=len(r))
            for r, w in zip(super().residuals(theta), self._windows)
        ]


def test_another_kind_of_block_must_explain_the_flights_itself():
    """Its derivative where it is off promises some hundred nats; with it on, the flights are
    explained worse than without.
    """
    floor = EFFECTS[3].floor
    truth = {"effect_03": 1.0 / floor}
    assert explain_without_laws(SyntheticModel(effects=EFFECTS, truth=truth, seed=4)).named == (
        "effect_03",
    )
    assert not explain_without_laws(Promising(effects=EFFECTS, truth=truth, seed=4)).named

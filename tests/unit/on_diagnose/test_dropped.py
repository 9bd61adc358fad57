"""Commands that got lost: what each would have changed, and that they are found and told beside
what else there is.
"""

from dataclasses import replace
from functools import cache

import numpy as np

from tests.flown import fly, setting_with
from tests.plants import paper_plant
from tests.synthetic_diagnosis import SyntheticModel
from visthrow.diagnose.select import lost_commands as dropped
from visthrow.diagnose.select import search
from visthrow.diagnose.select.point import Problem, linearise
from visthrow.diagnose.throw.throw_model import ThrowModel

SHARE = 0.12
ONLY = ("cmd_delay", "com_x", "rate_gain", "wind_x", "payload_drag")


@cache
def model_of(lost: float, throws: int = 2, **theta: float) -> ThrowModel:
    return ThrowModel(
        fly(setting_with(theta), seed=4, free=1, throws=throws, seconds=3.0, lost=lost),
        paper_plant(),
        only=ONLY,
    )


def told(diagnosis):
    return [s for s in diagnosis.scatter if s.found]


def test_lost_commands_are_found_beside_a_cause():
    diagnosis = search.explain(model_of(SHARE, com_x=0.003))
    assert (diagnosis.overall, diagnosis.named, [s.name for s in told(diagnosis)]) == (
        "KNOWN",
        ("com_x",),
        [dropped.NAME],
    )
    assert abs(diagnosis.theta["com_x"] - 0.003) < 3e-4
    found = told(diagnosis)[0]
    assert found.low < SHARE < found.high
    assert found.nats > 50.0


class Lossy(SyntheticModel):
    """A model of which each window has eight commands, two of which did not come."""

    def windows(self, theta):
        return [
            replace(w, residual=w.residual + columns[:, :2].sum(1))
            for w, columns in zip(super().windows(theta), self.without_commands(theta))
        ]

    def without_commands(self, theta, windows=None):
        rng = np.random.default_rng(0)
        drawn = [
            3.0 * w.sigma[:, None] * rng.normal(size=(len(w.residual), 8)) for w in self._windows
        ]
        return drawn if windows is None else [drawn[i] for i in windows]


def command_verdict(model):
    windows = model.windows({})
    problem = Problem.of(model, windows, range(len(windows)))
    point = linearise(problem, np.zeros(len(model.effects)), windows=windows)
    return dropped.verdict(problem, point, (), 5.0)


def test_lost_commands_are_found_where_a_model_has_commands():
    verdict = command_verdict(Lossy())
    assert verdict.found
    assert verdict.low < 0.25 < verdict.high
    assert command_verdict(SyntheticModel()) is None

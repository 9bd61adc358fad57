"""Kinds of blocks that a model lacks: their evidence compares two fits, no transient."""

import numpy as np
from pytest import approx, mark, param

from bench.diagnose.sealed import flight_log, model_of
from bench.worlds.world import Recipe, fly_recipe, record_flights
from tests.configs import load_experiment
from visthrow.diagnose.throw.throw_model import ThrowModel
from visthrow.task import plant_of

LEFT = 0.1
"""Part of the misfit, in its square, that may be left once the other kind of block has its column:
noise, gusts, initial states.
"""


@mark.parametrize(
    ("lacks", "name"),
    [
        param("vehicle.motor.kind='instant'", "motor_lag", marks=mark.slow),
        ("vehicle.controller.kind='geometric'", "controller_kind"),
    ],
)
def test_a_missing_block_is_worth_its_whole_size(lacks, name):
    """The plant has the block, the model lacks it: the column at theta = 0 explains the residuals
    with a theta near 1.
    """
    recipe = Recipe(31, "rod", {}, free=0, throws=2, held=0)
    logs = [flight_log(r) for r in record_flights(recipe, fly_recipe(recipe))]
    plant = plant_of(load_experiment("state", [*model_of(recipe), lacks]))
    model = ThrowModel(logs, plant, only=[name])
    throws = [w for w in model.windows({}) if w.phase == "throw"]
    misfit = left = 0.0
    for w in throws:
        free = np.hstack((w.nuisance * w.nuisance_sd, w.effects)) / w.sigma[:, None]
        size = np.linalg.lstsq(free, w.residual / w.sigma, rcond=None)[0]
        without = np.linalg.lstsq(free[:, :-1], w.residual / w.sigma, rcond=None)[0]
        misfit += float(np.sum((w.residual / w.sigma - free[:, :-1] @ without) ** 2))
        left += float(np.sum((w.residual / w.sigma - free @ size) ** 2))
        assert size[-1] == approx(1.0, abs=0.1)
    assert left < LEFT * misfit

"""Small sealed worlds: nothing, one effect or a law hidden in a plant of another hand, drawn as the test runs; seeds are printed.

Two or three short flights and throws a world, effects of many floors: what the banks of :mod:`tests.diagnose.sealed` measure on
whole flights is guarded here. The default run holds three worlds, the slow one a dozen and more.
"""

import os
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from tests.diagnose.cases import logs_of
from tests.diagnose.sealed import LAWS, judge, model_of
from tests.worlds.world import Recipe, draw
from visthrow import config
from visthrow.diagnose.reporting import report
from visthrow.diagnose.select import search
from visthrow.diagnose.throw.throw_model import ThrowModel
from visthrow.task import Experiment, plant_of

SMALL = dict(free=2, free_seconds=2.0, throws=4)
FLOORS = 30.0
NAMES = ("rope_length", "cmd_delay", "motor_tau", "com_x", "com_y", "wind_x", "frame_tilt_y", "mount_x", "rate_gain", "thrust_gain")
"""Effects that a few seconds show."""
RIGHT = 0.9
"""Share of small worlds that end rightly."""
SURE = 0.02
"""Probability below which a count speaks against that share."""


def worlds(count: int, plants: tuple[str, ...]) -> list[Recipe]:
    """A null, a law and single effects, in turn, from a seed of the system."""
    first = int.from_bytes(os.urandom(4), "little")
    print(f"first seed {first}")
    out = []
    for i in range(count):
        kind, plant = i % 4, (plants[i % len(plants)],)
        recipe = draw(first + 10 * i, int(kind > 0), FLOORS, names=NAMES, plants=plant, **SMALL)
        if kind == 3 and plant != ("chain",):
            name = str(np.random.default_rng(recipe.seed).choice(list(LAWS)))
            recipe = replace(recipe, effects={name: 2.0 * LAWS[name]})
        print(recipe.plant, "truth", recipe.digest())
        out.append(recipe)
    return out


def verdict_of(recipe: Recipe) -> dict:
    """The whole catalogue asked about a world, in this process: kernels are shared."""
    experiment = config.load(Experiment, config.find("train", "state"), model_of(recipe))
    model = ThrowModel(logs_of(recipe), plant_of(experiment), sensing=experiment.sensing)
    law = any(name in LAWS for name in recipe.effects)
    return report.to_json(search.explain(model, laws=law))


def right(recipe: Recipe) -> bool:
    """Up to class the hidden effect and no other; of a law and of nothing no name."""
    verdict = verdict_of(recipe)
    said = judge(recipe, verdict)
    print(recipe.plant, recipe.effects, said["overall"], said["named"])
    if any(name in LAWS for name in recipe.effects):
        return said["unknown"] and not said["wrong"]
    return said["class"] and (bool(recipe.effects) or said["overall"] == "NO EFFECT")


def enough(recipes: list[Recipe]) -> None:
    """Fail where so few right answers have a probability below ``SURE``."""
    count = sum(right(recipe) for recipe in recipes)
    assert binom.cdf(count, len(recipes), RIGHT) > SURE, f"{count} of {len(recipes)}"


def test_two_small_worlds():
    """A null on the string and one effect on the rod: both wrong is no accident."""
    enough(worlds(2, ("string", "rod")))


@pytest.mark.slow
def test_a_dozen_small_worlds():
    enough(worlds(12, ("rod", "string", "chain")))


@pytest.mark.slow
def test_exchanged_names_would_be_noticed(monkeypatch):
    """Mutation: names of two effects are exchanged in the catalogue; worlds of another hand notice, the simulator's would not."""
    from visthrow.config.effects import catalogue

    one, other = catalogue()["com_x"], catalogue()["com_y"]
    monkeypatch.setitem(catalogue(), "com_x", replace(one, changes=other.changes))
    monkeypatch.setitem(catalogue(), "com_y", replace(other, changes=one.changes))
    assert not right(Recipe(4, "rod", {"com_x": 3e-3}, FLOORS, **SMALL))


@pytest.mark.slow
def test_unexchanged_names_are_right():
    """The guard of the test above."""
    assert right(Recipe(4, "rod", {"com_x": 3e-3}, FLOORS, **SMALL))

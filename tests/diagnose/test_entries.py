"""Entries of the catalogue that the banks do not draw: hidden in plants that share no code with the
package, and found.
"""

import dataclasses

import numpy as np
import pytest

from bench.diagnose.sealed import flight_log, model_of
from bench.worlds.world import Recipe, fly_recipe, recorded
from visthrow import config
from visthrow.diagnose.reporting import gain
from visthrow.diagnose.select import search
from visthrow.diagnose.throw.throw_model import ThrowModel
from visthrow.task import Experiment, plant_of

NEAR = [
    "rope_length",
    "payload_drag",
    "payload_offset",
    "release_lag",
    "wind_x",
    "wind_y",
    "kick_z",
]
"""Effects that the hidden ones could be taken for."""


def explained(recipe: Recipe, own: list[str]):
    """Diagnosis of a world with the hidden effect's entry, if it has one, and those near it; and
    what the world knew.
    """
    records = recorded(recipe, fly_recipe(recipe))
    plant = plant_of(config.load(Experiment, config.find("train", "state"), model_of(recipe)))
    model = ThrowModel([flight_log(r) for r in records], plant, only=[*own, *NEAR])
    return search.explain(model, laws=False), records


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plant", "name", "size"),
    [
        ("rod", "payload_side", 1.5e-3),
        ("string", "payload_lift", -1.5e-3),
        ("string", "rope_elastic", 2e-3),
    ],
)
def test_a_hidden_entry_is_named(plant, name, size):
    diagnosis, _ = explained(
        Recipe(21, plant, {name: size}, free=1, free_seconds=6.0, throws=6, held=0), [name]
    )
    assert diagnosis.named == (name,)
    assert diagnosis[name].low <= size <= diagnosis[name].high


@pytest.mark.slow
def test_a_release_that_varies_is_told_as_such():
    diagnosis, _ = explained(
        Recipe(22, "rod", {"lag_jitter": 0.015}, free=0, throws=10, held=0), []
    )
    jitter = next(s for s in diagnosis.scatter if s.name == "lag_jitter")
    assert jitter.found
    assert jitter.low <= 0.015 <= jitter.high
    assert not diagnosis.theta


@pytest.mark.slow
def test_held_out_landings_come_near_the_truth():
    recipe = Recipe(23, "rod", {"release_lag": 0.03}, free=0, throws=6, held=0)
    diagnosis, records = explained(recipe, [])
    truth = np.array([r["truth_landing"] for r in records])
    model = diagnosis.work.problem.model
    seen = model.landings(recipe.effects)
    assert np.linalg.norm((seen.measured - truth)[:, :2], axis=1).max() < 5e-3
    landing = gain.measure(dataclasses.replace(diagnosis)).landing
    assert diagnosis.named == ("release_lag",)
    assert landing.held_out
    assert landing.released_after < 0.3 * landing.released_before
    assert (
        abs(landing.released_after - seen.released_errors.mean()) < 3e-3
    )  # as with the truth itself
    assert landing.moved["release_lag"] > 0.05

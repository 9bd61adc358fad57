"""Plants drawn from what a diagnosis left uncertain; see :class:`visthrow.task.DiagnosedParams`."""

import numpy as np

from sim.effects.effect import apply
from sim.effects.setting import Setting, generalised, specialised
from sim.params import PlantParams
from visthrow.common.errors import ConfigError
from visthrow.config.effects import chosen
from visthrow.task import Experiment, plant_of


def drawn_plants(experiment: Experiment, seed: int) -> list[PlantParams]:
    """Return ``diagnosed.plants`` plants of an experiment; the plant itself where that is 1 or nothing is uncertain.

    A draw that an effect's physical bounds forbid is put on the bound.

    Raises:
        ConfigError: an effect that the catalogue does not hold, or a covariance that is none.
    """
    d = experiment.diagnosed
    if d.plants == 1 or not d.effects:
        return [plant_of(experiment)]
    covariance = np.array(d.covariance)
    values, vectors = np.linalg.eigh(covariance)
    if not np.allclose(covariance, covariance.T) or values.min() < -1e-9 * values.max():
        raise ConfigError("diagnosed.covariance is no covariance: it is not symmetric, or has a negative eigenvalue")
    normal = np.random.default_rng(seed).standard_normal((d.plants, len(d.effects)))
    draws = normal * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    base = generalised(Setting(plant_of(experiment), experiment.sensing))
    effects = {name: effect.bounded(base) for name, effect in chosen(d.effects).items()}
    plants = []
    for draw in draws:
        theta = {name: float(np.clip(x, *effects[name].bounds)) for name, x in zip(d.effects, draw)}
        plants.append(specialised(apply(effects, base, theta).plant, plant_of(experiment)))
    return plants

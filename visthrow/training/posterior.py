"""Plants drawn from what a diagnosis left uncertain; see :class:`visthrow.task.DiagnosedParams`."""

import numpy as np

from sim.params import PlantParams
from visthrow.task import Experiment, plant_of


def drawn_plants(experiment: Experiment, seed: int) -> list[PlantParams]:
    """``diagnosed.plants`` plants of an experiment; the plant itself where that is 1 or nothing is uncertain.

    A draw that an effect's physical bounds forbid is put on the bound.

    Raises:
        DiagnoseError: an effect that the catalogue does not hold.
        ConfigError: a covariance that is none.
    """
    d = experiment.diagnosed
    if d.plants == 1 or not d.effects:
        return [plant_of(experiment)]
    from visthrow.common.errors import ConfigError
    from visthrow.diagnose.catalogue import ALL, Setting, apply
    from visthrow.diagnose.throw.opened import closed, opened

    covariance = np.array(d.covariance)
    values, vectors = np.linalg.eigh(covariance)
    if not np.allclose(covariance, covariance.T) or values.min() < -1e-9 * values.max():
        raise ConfigError("diagnosed.covariance is no covariance: it is not symmetric, or has a negative eigenvalue")
    normal = np.random.default_rng(seed).standard_normal((d.plants, len(d.effects)))
    draws = normal * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    base = opened(Setting(plant_of(experiment), experiment.sensing))
    bounded = {name: e.bounded(base) for name, e in ALL.items()}
    plants = []
    for draw in draws:
        theta = {n: float(np.clip(x, *bounded[n].effect.bounds)) if n in bounded else x for n, x in zip(d.effects, draw)}
        plants.append(closed(apply(bounded, base, theta).plant, plant_of(experiment)))
    return plants

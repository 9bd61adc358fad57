"""The catalogue of effects: the files of ``configs/effects``, read once. Training and diagnosis both apply it, training to plants
drawn from what a diagnosis left uncertain.

Its classes are those of :mod:`sim.effects.effect`, which is imported when the catalogue is asked for: configurations are read on
board too, where no simulator is installed.
"""

from collections.abc import Iterable
from functools import cache
from typing import Any

from visthrow import config
from visthrow.common.errors import ConfigError, suggest
from visthrow.config import kinds

FILES = ("thrust", "body", "air", "rope", "sensing", "camera", "numerics", "structure", "random")
"""Files of ``configs/effects`` in the order of the catalogue, which is that of a diagnosis' columns."""


@cache
def _tables() -> tuple[Any, ...]:
    schema = kinds.schema_of("effects")
    return tuple(config.load(schema, config.find("effects", name)) for name in FILES)


@cache
def catalogue() -> dict[str, Any]:
    """Return every effect, a ``SettingEffect``, by its name.

    Raises:
        ConfigError: A file does not fill its schema.
    """
    return {name: effect for table in _tables() for name, effect in table.effects.items()}


@cache
def random_effects() -> tuple[Any, ...]:
    """Return what may differ from flight to flight, each a ``RandomEffect``."""
    return tuple(effect for table in _tables() for effect in table.random_effects.values())


def chosen(names: Iterable[str]) -> dict[str, Any]:
    """Return the effects of these names.

    Raises:
        ConfigError: The catalogue does not hold one of them.
    """
    known = catalogue()
    for name in names:
        if name not in known:
            raise ConfigError(f"no effect '{name}'; {suggest(name, known)}")
    return {name: known[name] for name in names}


def drawn_plants(diagnosed: Any, plant: Any, sensing: Any, seed: int) -> list[Any]:
    """Return ``diagnosed.plants`` plants about a plant; the plant itself where that is 1 or nothing is uncertain.

    A draw that an effect's physical bounds forbid is put on the bound.

    Args:
        diagnosed: see :class:`visthrow.task.DiagnosedParams`.
        plant, sensing: of the experiment, a ``PlantParams`` and a ``SensingParams``.
        seed: of the draws.

    Raises:
        ConfigError: An effect that the catalogue does not hold, or a covariance that is none.
    """
    if diagnosed.plants == 1 or not diagnosed.effects:
        return [plant]
    import numpy as np

    from sim.effects.effect import apply
    from sim.effects.setting import Setting, generalised, specialised

    covariance = np.array(diagnosed.covariance)
    values, vectors = np.linalg.eigh(covariance)
    if not np.allclose(covariance, covariance.T) or values.min() < -1e-9 * values.max():
        raise ConfigError("diagnosed.covariance is no covariance: it is not symmetric, or has a negative eigenvalue")
    normal = np.random.default_rng(seed).standard_normal((diagnosed.plants, len(diagnosed.effects)))
    base = generalised(Setting(plant, sensing))
    effects = {name: effect.bounded(base) for name, effect in chosen(diagnosed.effects).items()}
    plants = []
    for draw in normal * np.sqrt(np.maximum(values, 0.0)) @ vectors.T:
        theta = {name: float(np.clip(x, *effects[name].bounds)) for name, x in zip(diagnosed.effects, draw)}
        plants.append(specialised(apply(effects, base, theta).plant, plant))
    return plants

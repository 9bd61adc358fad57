"""The catalogue of effects: the files of ``configs/effects``, read once.

Diagnosis uses it, and training, for plants drawn from a diagnosis's posterior.

Its classes are those of :mod:`sim.effects.effect`, which is imported only when the catalogue is
read, because configurations are also loaded on board, where no simulator is installed."""

from collections.abc import Iterable
from functools import cache
from typing import Any

from visthrow import config
from visthrow.common.errors import ConfigError, expect_known
from visthrow.config import kinds

FILES = ("thrust", "body", "air", "rope", "sensing", "camera", "numerics", "structure", "random")
"""Files of ``configs/effects`` in the order of the catalogue and of a diagnosis's columns."""


@cache
def _tables() -> tuple[Any, ...]:
    schema = kinds.schema_of("effects")
    return tuple(config.load(schema, config.find("effects", name)) for name in FILES)


@cache
def catalogue() -> dict[str, Any]:
    """Return name -> effect, a ``SettingEffect``."""
    return {name: effect for table in _tables() for name, effect in table.effects.items()}


@cache
def random_effects() -> tuple[Any, ...]:
    """Return the effects that may differ between flights, each a ``RandomEffect``."""
    return tuple(effect for table in _tables() for effect in table.random_effects.values())


def choose_effects(names: Iterable[str]) -> dict[str, Any]:
    """Return the effects of these names in the order of the catalogue.

    Raises ConfigError: the catalogue does not have an effect of this name.
    """
    names = list(names)
    effects = catalogue()
    expect_known(names, effects, "no effect '{}'", ConfigError)
    return {name: effect for name, effect in effects.items() if name in names}

"""The catalogue of effects: the files of ``configs/effects``, read once.

Training and diagnosis both apply it, training to plants drawn from what a diagnosis left uncertain.

Its classes are those of :mod:`sim.effects.effect`, which is imported when the catalogue is first
read: configurations are read on board too, where no simulator is installed."""

from collections.abc import Iterable
from functools import cache
from typing import Any

from visthrow import config
from visthrow.common.errors import ConfigError, expect_known
from visthrow.config import kinds

FILES = ("thrust", "body", "air", "rope", "sensing", "camera", "numerics", "structure", "random")
"""Files of ``configs/effects`` in the order of the catalogue, which is that of a diagnosis'
columns.
"""


@cache
def _tables() -> tuple[Any, ...]:
    schema = kinds.schema_of("effects")
    return tuple(config.load(schema, config.find("effects", name)) for name in FILES)


@cache
def catalogue() -> dict[str, Any]:
    """Return every effect, a ``SettingEffect``, by its name."""
    return {name: effect for table in _tables() for name, effect in table.effects.items()}


@cache
def random_effects() -> tuple[Any, ...]:
    """Return what may differ from flight to flight, each a ``RandomEffect``."""
    return tuple(effect for table in _tables() for effect in table.random_effects.values())


def choose_effects(names: Iterable[str]) -> dict[str, Any]:
    """Return the effects of these names in the order of the catalogue; ConfigError for one that it
    does not hold.
    """
    names = list(names)
    effects = catalogue()
    expect_known(names, effects, "no effect '{}'", ConfigError)
    return {name: effect for name, effect in effects.items() if name in names}

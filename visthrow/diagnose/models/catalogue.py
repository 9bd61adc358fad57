"""Catalogues of models: tables of effects from ``configs/model_effects`` or a user's file, scaled
by a model's parameters.
"""

import math
from dataclasses import dataclass, field, replace
from functools import cache
from operator import attrgetter
from typing import Any

from sim.effects.effect import Effect
from visthrow import config

# share of a prior deviation by which a size on its bound may exceed it after rounding
ROUNDED = 1e-6


@dataclass(frozen=True)
class ModelEffect(Effect):
    """An effect of a model. A channel in braces stands for the value of that parameter, such as
    ``{position}``.
    """

    # "bounds", "prior_sd" or "floor" -> parameters by which it is multiplied, such as "mass * arm"
    times: dict[str, str] = field(default_factory=dict)
    lowest: str = ""  # parameter whose negative is the lower bound
    needs: str = ""  # parameter without which the effect does not exist
    # parameters of the simulator to which theta is added, such as "airs.wind_w.0"; "-" subtracts
    changes: tuple[str, ...] = ()

    def for_params(self, params: Any) -> "ModelEffect":
        """Return the effect scaled by a model's parameters."""

        def scale(field_name: str) -> float:
            """Return the factor of a field."""
            factors = filter(None, self.times.get(field_name, "").split(" * "))
            product: float = math.prod(attrgetter(factor)(params) for factor in factors)
            return product

        low, high = (bound * scale("bounds") for bound in self.bounds)
        if self.lowest:
            low = -attrgetter(self.lowest)(params)
        return replace(
            self,
            bounds=(low, high),
            prior_sd=self.prior_sd * scale("prior_sd"),
            floor=self.floor * scale("floor"),
            channels=tuple(name.format_map(vars(params)) for name in self.channels),
        )


@dataclass(frozen=True)
class ModelEffects:
    """The content of a file of ``configs/model_effects``."""

    effects: dict[str, ModelEffect]


@cache
def _tables(model: str) -> ModelEffects:
    return config.load(ModelEffects, config.find("model_effects", model))


def effects_of(model: str, params: Any) -> list[ModelEffect]:
    """Return the effects of a model in the order of its file."""
    return [
        e.for_params(params)
        for e in _tables(model).effects.values()
        if not e.needs or getattr(params, e.needs) is not None
    ]


def beyond_bounds(effect: Effect, size: float) -> str:
    """Return a message if a size lies outside an effect's bounds, else an empty text."""
    low, high = effect.bounds
    rounded = ROUNDED * effect.prior_sd
    if low - rounded <= size <= high + rounded:
        return ""
    return f"{effect.name} = {size:.4g} {effect.unit}; expected from {low + 0.0:g} to {high:g}"

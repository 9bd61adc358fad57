"""Catalogues of models: the files of ``configs/model_effects``, and those of others, in the numbers
that a model's parameters give.
"""

import math
from dataclasses import dataclass, field, replace
from functools import cache
from operator import attrgetter
from typing import Any

from sim.effects.effect import Effect
from visthrow import config

# of a prior deviation, by which a size at its bound may lie outside once it was written down
ROUNDED = 1e-6


@dataclass(frozen=True)
class ModelEffect(Effect):
    """An effect of a setup's model; a channel in braces is that which a parameter of this name
    names, as ``{position}``.
    """

    # bounds, prior_sd, floor -> parameters that they are multiples of, as "mass * arm"
    times: dict[str, str] = field(default_factory=dict)
    # parameter of which theta takes no more than there is, in place of the lower bound
    lowest: str = ""
    needs: str = ""  # parameter that a setup may lack, and the effect with it
    # numbers of the simulator that theta is added to, as "airs.wind_w.0", or with "-" taken from
    changes: tuple[str, ...] = ()

    def for_params(self, params: Any) -> "ModelEffect":
        """Return the effect in the parameters' numbers."""

        def scale(field_name: str) -> float:
            """Return what a field is a multiple of."""
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
    """A file of ``configs/model_effects``."""

    effects: dict[str, ModelEffect]


@cache
def _tables(model: str) -> ModelEffects:
    return config.load(ModelEffects, config.find("model_effects", model))


def effects_of(model: str, params: Any) -> list[ModelEffect]:
    """Return the effects of a setup's model in the order of its file."""
    return [
        e.for_params(params)
        for e in _tables(model).effects.values()
        if not e.needs or getattr(params, e.needs) is not None
    ]


def beyond_bounds(effect: Effect, size: float) -> str:
    """Return in words that a size lies outside an effect's bounds; empty where it does not."""
    low, high = effect.bounds
    rounded = ROUNDED * effect.prior_sd
    if low - rounded <= size <= high + rounded:
        return ""
    return f"{effect.name} = {size:.4g} {effect.unit}; expected from {low + 0.0:g} to {high:g}"

"""Measurements on the ground, by a scale, a tape or a barometer, which narrow priors of effects."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visthrow.common.errors import DiagnoseError, expect_known
from visthrow.common.toml_text import tables_beside
from visthrow.diagnose.models.model_interface import Effect

# largest error of a measured value, in the measurement's standard deviations
CERTAIN_DEVIATIONS = 3.0


@dataclass(frozen=True)
class Measurement:
    """A measurement on the ground."""

    name: str  # instruction
    effect: str  # effect whose size it determines
    sd: float  # standard deviation of the measured value, in the effect's unit
    seconds: float  # time that it takes
    file = ""  # a measurement has no reference to fly

    @property
    def purpose(self) -> str:
        """Return the purpose in words."""
        return f"settles {self.effect}"

    def limits(self) -> str:
        """Return the limits beyond which to abort: none."""
        return ""


RIGHT = 1e-3  # standard deviation of a value that is stated to be exact, in floors

MEASUREMENTS = tuple(Measurement(name, **row) for name, row in tables_beside(__file__).items())


def narrow(effects: Sequence[Effect], measured: Mapping[str, float]) -> tuple[Effect, ...]:
    """Return the catalogue with narrower priors for effects whose configured values were measured.

    ``measured``: effect -> standard deviation of the measurement behind the configured value, in
    the effect's unit; 0 states that the configured value is exact, such as ``wind_x=0`` in a hall.
    Raises DiagnoseError: no effect of that name, or a standard deviation below 0."""
    expect_known(
        measured,
        [e.name for e in effects],
        "--measured: no effect '{}' among those considered, which --only may limit",
        DiagnoseError,
    )
    for name, sd in measured.items():
        if not sd >= 0.0:
            raise DiagnoseError(
                f"{name} measured with a standard deviation of {sd}; expected 0 or more"
            )
    changed = []
    for effect in effects:
        sd = measured.get(effect.name, np.inf) or RIGHT * effect.floor
        farthest = CERTAIN_DEVIATIONS * sd
        low, high = effect.bounds
        bounds = (max(low, -farthest), min(high, farthest))
        changed.append(replace(effect, bounds=bounds, prior_sd=min(effect.prior_sd, sd)))
    return tuple(changed)


def parse(items: Sequence[str]) -> dict[str, float]:
    """Parse ``NAME=DEVIATION`` of the command line, several separated by commas.

    Raises DiagnoseError: an item has another form."""
    out = {}
    for item in ",".join(items).split(",") if items else ():
        name, _, sd = item.partition("=")
        try:
            out[name.strip()] = float(sd)
        except ValueError as error:
            raise DiagnoseError(
                f"--measured {item}; expected NAME=DEVIATION, such as mass_quad=0.0003"
            ) from error
    return out

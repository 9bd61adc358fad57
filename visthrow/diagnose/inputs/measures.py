"""What a scale, a tape or a barometer settles that no flight does: measured values narrow the
catalogue.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visthrow.common.errors import DiagnoseError, expect_known
from visthrow.common.toml_text import tables_beside
from visthrow.diagnose.models.model_interface import Effect

# deviations of a measurement beyond which the configured value cannot be off
CERTAIN_DEVIATIONS = 3.0


@dataclass(frozen=True)
class Measurement:
    """One measurement on the ground."""

    name: str  # what to do
    effect: str  # that it settles
    sd: float  # of the measured value, in the effect's unit
    seconds: float
    file = ""  # no reference is flown

    @property
    def purpose(self) -> str:
        """Return what it is for, in words."""
        return f"settles {self.effect}"

    def limits(self) -> str:
        """Return when to abort: never."""
        return ""


RIGHT = 1e-3  # deviation of a value that is stated to be right, in what is negligible

MEASUREMENTS = tuple(Measurement(name, **row) for name, row in tables_beside(__file__).items())


def narrow(effects: Sequence[Effect], measured: Mapping[str, float]) -> tuple[Effect, ...]:
    """The catalogue where some configured values were measured.

    ``measured``: effect -> deviation of the measurement that the configuration's value comes from,
    in its unit.
    A deviation of 0 says that the configured value is right, such as ``wind_x=0`` in a hall. Raises
    DiagnoseError: no effect of that name, or a deviation below 0."""
    expect_known(
        measured,
        [e.name for e in effects],
        "--measured: no effect '{}' among those considered, which --only may limit",
        DiagnoseError,
    )
    for name, sd in measured.items():
        if not sd >= 0.0:
            raise DiagnoseError(f"{name} measured with a deviation of {sd}; expected 0 or more")
    changed = []
    for effect in effects:
        sd = measured.get(effect.name, np.inf) or RIGHT * effect.floor
        farthest = CERTAIN_DEVIATIONS * sd
        low, high = effect.bounds
        bounds = (max(low, -farthest), min(high, farthest))
        changed.append(replace(effect, bounds=bounds, prior_sd=min(effect.prior_sd, sd)))
    return tuple(changed)


def parse(items: Sequence[str]) -> dict[str, float]:
    """Read ``NAME=DEVIATION`` of the command line, several by commas.

    Raises DiagnoseError: something else."""
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

"""The rate controller of a vehicle's own firmware, put into the configuration: a TOML on top of another, from a blackbox's settings."""

import dataclasses
from pathlib import Path

from sim.effects.firmware import calibrated_voltage, controller_of, left_out
from sim.params import GRAVITY
from visthrow.common.errors import DiagnoseError
from visthrow.common.toml_text import dumps
from visthrow.diagnose.extend.patch import differences
from visthrow.logs.readers.blackbox.decoder import read_blackbox
from visthrow.task import Experiment, plant_of


def text(path: str | Path, base: str, experiment: Experiment, hover: float, delay: float | None = None) -> str:
    """A configuration that flies the firmware's controller.

    Args:
        path: of the blackbox, whose header tells the settings.
        base: name of the configuration below. experiment: what it says.
        hover: share of throttle in hover, 0 to 1, with the payload.
        delay: from a command to the mixer [s]; None: as the configuration has it.

    Raises DiagnoseError: settings are missing; LogError: no blackbox.
    """
    settings, plant = read_blackbox(path)[0].header, plant_of(experiment)
    weight = 0.25 * plant.total_mass * GRAVITY
    try:
        voltage = calibrated_voltage(plant.vehicle, settings, weight, hover)
        controller = controller_of(plant.vehicle, settings, weight, voltage)
    except ValueError as error:
        raise DiagnoseError(f"{path}: {error}") from error
    changed = differences(dataclasses.asdict(plant.vehicle.controller), dataclasses.asdict(controller))
    lines = [f"# Controller by the settings of {settings.get('Firmware revision', 'a firmware').strip()} in {Path(path).name}."]
    lines += [f"# Not in the block: {words}." for words in left_out(settings)]
    vehicle = {"controller": changed} | ({} if delay is None else {"queue": {"delay": delay}})
    return "\n".join([*lines, dumps({"base": base, "vehicle": vehicle})])

"""Writing a diagnosis as configuration: a TOML file based on the diagnosed configuration, for
training and the next diagnosis.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from sim.effects.effect import apply
from sim.effects.firmware import calibrated_voltage, controller_of, missing_features
from sim.effects.setting import Setting, generalise, specialise
from sim.kernels.laws import check_laws
from sim.params import GRAVITY, LawParams
from visthrow import config
from visthrow.common.errors import DiagnoseError
from visthrow.common.toml_text import dumps
from visthrow.config.effects import catalogue, choose_effects
from visthrow.diagnose.apply.saved_diagnosis import SavedDiagnosis
from visthrow.diagnose.inputs.fit import list_covariance
from visthrow.diagnose.inputs.setup import Setup
from visthrow.diagnose.models.catalogue import effects_of
from visthrow.diagnose.models.law_terms import term_of
from visthrow.diagnose.models.model_interface import Sizes
from visthrow.logs.readers.blackbox.decoder import read_blackbox
from visthrow.task import Experiment, load_experiment, plant_of


def extend(experiment: Experiment, theta: Sizes) -> Experiment:
    """Return the experiment with these effects in its plant and sensors.

    Raises ConfigError: an effect that the catalogue does not hold.
    """
    base = generalise(Setting(plant_of(experiment), experiment.sensing, camera=experiment.camera))
    sizes = apply(choose_effects(theta), base, theta)
    plant = specialise(sizes.plant, plant_of(experiment))
    return replace(
        experiment,
        vehicle=plant.vehicle,
        rope=plant.rope,
        release=plant.release,
        air=plant.air,
        sensing=sizes.sensing,
        camera=sizes.camera,
    )


def differences(before: Any, after: Any) -> dict[str, Any]:
    """Return the nested entries of ``after`` that differ from ``before``."""
    out = {}
    for key, value in after.items():
        old = before.get(key)
        if isinstance(value, dict):
            inner = differences(old or {}, value)
            out |= {key: inner} if inner else {}
        elif value != old:
            out[key] = value
    return out


def text(
    base: str,
    experiment: Experiment,
    theta: Sizes,
    covariance: Sequence[Sequence[float]],
    plants: int,
    provenance: Sequence[str],
    laws: Sequence[LawParams] = (),
) -> str:
    """Return the text of the extended configuration.

    Args:
        base: path of the diagnosed configuration, as written behind ``base =``.
        experiment: that configuration, with the overrides of the diagnosis.
        theta: sizes of the effects that were found.
        covariance: of these sizes.
        plants: number of plants that training draws from the joint posterior.
        laws: terms outside the catalogue, added to those of the configuration.
    """
    effects = [catalogue()[name] for name in theta]
    covariance = np.reshape(covariance, (len(theta), len(theta)))
    # the joint posterior holds only effects on the plant's numbers: none on sensors, on the
    # replay's step or on the choice of blocks
    of_plant = []
    for i, effect in enumerate(effects):
        paths = [key.path for key in effect.changes]
        if paths and all(path.startswith("plant.") for path in paths):
            of_plant.append(i)
    varied = replace(
        experiment.diagnosed,
        effects=tuple(effects[i].name for i in of_plant),
        covariance=tuple(map(tuple, covariance[np.ix_(of_plant, of_plant)].tolist())),
        plants=plants,
    )
    every_law = (*experiment.laws, *laws)
    check_laws(every_law)
    after = replace(extend(experiment, theta), diagnosed=varied, laws=every_law)
    changed = differences(config.to_dict(load_experiment(base)), config.to_dict(after))
    words = defaultdict(list)
    for effect, sd in zip(effects, np.sqrt(np.diag(covariance))):
        size = f"{effect.name} {theta[effect.name]:+.4g} +- {sd:.2g} {effect.unit}"
        for key in effect.changes:
            words[key.path.removeprefix("plant.")].append(size)
    switched = [e.name for e in effects if e.switch]
    return _file(base, provenance, changed, words, switched)


def _file(
    base: str,
    comments: Sequence[str],
    changed: Mapping[str, Any],
    words: Mapping[str, Sequence[str]],
    others: Sequence[str] = (),
) -> str:
    """Return the text of a TOML file based on another: comments, then the changed entries.

    ``words``: path of an entry -> its comments; ``others``: comments on entries without such.
    """
    lines = [*(f"# {line}" for line in comments), dumps({"base": base}).strip(), ""]
    section = ""
    for line in dumps(changed).splitlines():
        section = line.strip("[]") if line.startswith("[") else section
        name, equals, _ = line.partition(" = ")
        comment = words.get(f"{section}.{name}", [])
        if equals and not comment:
            comment = {"diagnosed": ["of the diagnosis above"], "laws": []}.get(section, others)
        lines.append(f"{line}  # {'; '.join(comment)}" if comment else line)
    return "\n".join(lines).rstrip() + "\n"


def without_transient(
    theta: Sizes, covariance: np.ndarray
) -> tuple[dict[str, float], np.ndarray, list[str]]:
    """Leave out transient effects, which belong to the diagnosed flights and not to the vehicle.

    Returns the other sizes, their covariance, and the names of the effects left out.
    """
    sizes = {name: size for name, size in theta.items() if not catalogue()[name].transient}
    rows = [i for i, name in enumerate(theta) if name in sizes]
    return sizes, covariance[np.ix_(rows, rows)], [name for name in theta if name not in sizes]


def with_firmware(
    path: str | Path, base: str, experiment: Experiment, hover: float, delay: float | None
) -> str:
    """Return the text of a configuration with the firmware's rate controller.

    Args:
        path: of the blackbox, whose header holds the settings.
        base: name of the configuration on which the file is based.
        experiment: that configuration.
        hover: throttle in hover with the payload, 0 to 1.
        delay: from a command to the mixer [s]; None: that of the configuration.

    Raises DiagnoseError: settings are missing; LogError: the file is no blackbox.
    """
    settings = read_blackbox(path)[0].header
    plant = plant_of(experiment)
    weight = 0.25 * plant.total_mass * GRAVITY
    try:
        voltage = calibrated_voltage(plant.vehicle, settings, weight, hover)
        controller = controller_of(plant.vehicle, settings, weight, voltage)
    except ValueError as error:
        raise DiagnoseError(f"{path}: {error}") from error
    changed = differences(asdict(plant.vehicle.controller), asdict(controller))
    comments = [
        f"Controller by the settings of {settings.get('Firmware revision', 'a firmware').strip()}"
        f" in {Path(path).name}."
    ]
    comments += [f"Not in the block: {words}." for words in missing_features(settings)]
    vehicle = {"controller": changed} | ({} if delay is None else {"queue": {"delay": delay}})
    return _file(base, comments, {"vehicle": vehicle}, {})


def of_setup(
    base: str,
    setup: Setup,
    saved: SavedDiagnosis,
    provenance: Sequence[str],
    rank: int,
) -> str:
    """Return the text of a setup of any model but the throw, extended by the sizes and laws that a
    diagnosis of it found.

    Args:
        base: path of the diagnosed setup, as written behind ``base =``.
        setup: that setup.
        saved: the diagnosis.
        provenance: comments on the origin of the diagnosis.
        rank: of the explanation whose laws are written, from 1; 0 for none.

    Raises DiagnoseError: the file holds no diagnosis, one of another model, or no explanation of
    this rank.
    """
    theta, covariance = saved.sizes
    if saved.model != setup.model:
        raise DiagnoseError(
            f"{saved.path}: a diagnosis of the model '{saved.model}'; the model of {base} is"
            f" {setup.model or 'none'}"
        )
    effects = {e.name: e for e in effects_of(setup.model, getattr(setup, setup.model))}
    after = {name: setup.effects.get(name, 0.0) + size for name, size in theta.items()}
    saved.refuse_strange(after, effects)
    changed: dict[str, Any] = {}
    words = {}
    comments = [*provenance, *list_covariance(list(theta), covariance)]
    if laws := saved.laws(rank):
        changed["laws"] = [asdict(law) for law in (*setup.laws, *laws)]
        rows = [x.get("covariance") or [x["sd"] ** 2] for x in saved.explanation(rank)]
        comments += list_covariance([term_of(law).formula for law in laws], rows)
    if theta:
        changed["effects"] = {name: float(f"{size:.9g}") for name, size in after.items()}
    for (name, size), sd in zip(theta.items(), np.sqrt(np.diag(covariance))):
        words[f"effects.{name}"] = [f"{size:+.4g} +- {sd:.2g} {effects[name].unit}"]
    return _file(base, comments, changed, words)

"""A diagnosis put into the configuration: a TOML on top of the diagnosed one, that training and the
next diagnosis read.
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


def extended(experiment: Experiment, theta: Sizes) -> Experiment:
    """The experiment whose plant and sensors have these effects.

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
    """Nested entries of ``after`` that differ from ``before``."""
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
    """The TOML file.

    Args:
        base: path of the diagnosed configuration, as ``base =`` is to name it.
        experiment: that configuration, with the overrides of the diagnosis.
        plants: to draw in training from the joint posterior.
        laws: terms outside the catalogue, to stand beside those that the configuration has.
    """
    effects = [catalogue()[name] for name in theta]
    covariance = np.reshape(covariance, (len(theta), len(theta)))
    # the joint posterior of the plant's own numbers: not of the sensors, the replay's step or which
    # blocks there are
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
    after = replace(extended(experiment, theta), diagnosed=varied, laws=every_law)
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
    """Return a file on top of another: comments, and what changes with words by the path of an
    entry, ``others`` on what has none.
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
    """Leave out effects that belong to the diagnosed flights and not to the vehicle.

    Returns the other sizes, their covariance, and the names that were left out.
    """
    sizes = {name: size for name, size in theta.items() if not catalogue()[name].transient}
    rows = [i for i, name in enumerate(theta) if name in sizes]
    return sizes, covariance[np.ix_(rows, rows)], [name for name in theta if name not in sizes]


def with_firmware(
    path: str | Path, base: str, experiment: Experiment, hover: float, delay: float | None
) -> str:
    """A configuration that flies the firmware's controller.

    Args:
        path: of the blackbox, whose header tells the settings.
        base: name of the configuration below. experiment: what it says.
        hover: share of throttle in hover, 0 to 1, with the payload.
        delay: from a command to the mixer [s]; None: as the configuration has it.

    Raises DiagnoseError: settings are missing; LogError: no blackbox.
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
    """The TOML file of a setup of another model than the throw, extended by the sizes and laws that
    a diagnosis of it found.

    Raises DiagnoseError: no diagnosis, one of another model, or one without such an explanation.

    Args:
        base: path of the diagnosed setup, as ``base =`` is to name it.
        setup: that setup.
        saved: the diagnosis.
        provenance: lines on where it comes from.
        rank: of the explanation whose laws are written, from 1; 0 for none.
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

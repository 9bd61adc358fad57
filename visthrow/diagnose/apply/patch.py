"""A diagnosis put into the configuration: a TOML on top of the diagnosed one, that training and the
next diagnosis read.
"""

import dataclasses
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sim.effects.effect import Effect, apply
from sim.effects.firmware import calibrated_voltage, controller_of, left_out
from sim.effects.setting import Setting, generalised, specialised
from sim.kernels.laws import check_laws
from sim.params import GRAVITY, LawParams
from visthrow import config
from visthrow.common.errors import DiagnoseError, suggest
from visthrow.common.toml_text import dumps
from visthrow.config.effects import catalogue, chosen
from visthrow.diagnose.inputs.model_arguments import THROW
from visthrow.diagnose.inputs.setup import Setup
from visthrow.diagnose.models.catalogue import beyond_bounds, effects_of
from visthrow.diagnose.models.law_terms import term_of
from visthrow.logs.readers.blackbox.decoder import read_blackbox
from visthrow.task import Experiment, load_experiment, plant_of


def extended(experiment: Experiment, theta: Mapping[str, float]) -> Experiment:
    """The experiment whose plant and sensors have these effects.

    Raises ConfigError: an effect that the catalogue does not hold.
    """
    base = generalised(Setting(plant_of(experiment), experiment.sensing, camera=experiment.camera))
    sizes = apply(chosen(theta), base, theta)
    plant = specialised(sizes.plant, plant_of(experiment))
    return dataclasses.replace(
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
    theta: Mapping[str, float],
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
    varied = dataclasses.replace(
        experiment.diagnosed,
        effects=tuple(effects[i].name for i in of_plant),
        covariance=tuple(map(tuple, covariance[np.ix_(of_plant, of_plant)].tolist())),
        plants=plants,
    )
    every_law = (*experiment.laws, *laws)
    check_laws(every_law)
    after = dataclasses.replace(extended(experiment, theta), diagnosed=varied, laws=every_law)
    changed = differences(config.to_dict(load_experiment(base)), config.to_dict(after))
    words = defaultdict(list)
    for effect, sd in zip(effects, np.sqrt(np.diag(covariance))):
        size = f"{effect.name} {theta[effect.name]:+.4g} +- {sd:.2g} {effect.unit}"
        for key in effect.changes:
            words[key.path.removeprefix("plant.")].append(size)
    switched = [e.name for e in effects if e.switch]
    lines = _head(base, provenance) + _commented(changed, words, switched)
    return "\n".join(lines).rstrip() + "\n"


def _head(base: str, comments: Sequence[str]) -> list[str]:
    """Return the first lines of a file on top of another."""
    return [*(f"# {line}" for line in comments), dumps({"base": base}).strip(), ""]


def _commented(
    changed: Mapping[str, Any], words: Mapping[str, Sequence[str]], others: Sequence[str] = ()
) -> list[str]:
    """Return the lines of what changes with comments: words by the path of an entry, ``others`` on
    what has none.
    """
    lines = []
    section = ""
    for line in dumps(changed).splitlines():
        section = line.strip("[]") if line.startswith("[") else section
        name, equals, _ = line.partition(" = ")
        comment = words.get(f"{section}.{name}", [])
        if equals and not comment:
            comment = {"diagnosed": ["of the diagnosis above"], "laws": []}.get(section, others)
        lines.append(f"{line}  # {'; '.join(comment)}" if comment else line)
    return lines


def with_scatter(
    theta: Mapping[str, float], covariance: Sequence[Sequence[float]], report: Mapping[str, Any]
) -> tuple[dict[str, float], np.ndarray]:
    """Sizes and covariance of a flight that nobody has flown yet: what varies from flight to flight
    has the mean of those that were flown, and their scatter, to which that of days adds.
    """
    sizes = dict(theta)
    variance = dict.fromkeys(theta, 0.0)
    for row in report.get("scatter") or []:
        means = row.get("mean", {})
        for name in row["of"] if row["found"] else ():
            sizes.setdefault(name, float(means.get(name, 0.0)))
            variance[name] = variance.get(name, 0.0) + float(row["size"]) ** 2
    whole = np.diag(list(variance.values()))
    count = len(theta)
    whole[:count, :count] += np.reshape(covariance, (count, count))
    return sizes, whole


def without_transient(
    theta: Mapping[str, float], covariance: np.ndarray
) -> tuple[dict[str, float], np.ndarray, list[str]]:
    """Leave out effects that belong to the diagnosed flights and not to the vehicle.

    Returns the other sizes, their covariance, and the names that were left out.
    """
    transient = [name for name in theta if catalogue()[name].transient]
    sizes = {name: size for name, size in theta.items() if name not in transient}
    rows = [i for i, name in enumerate(theta) if name in sizes]
    return sizes, covariance[np.ix_(rows, rows)], transient


def laws_of(report: Mapping[str, Any], path: str, rank: int) -> list[LawParams]:
    """All laws of the explanation of this rank, from 1, in ``explain``'s JSON; none for 0.

    Raises DiagnoseError: it holds fewer, or one that no grammar has.
    """
    laws = []
    for x in _explanation(report, path, rank):
        factors = tuple(x["factors"])
        try:
            laws.append(LawParams(x["block"], factors, x["vector"], float(x["coefficient"])))
        except ValueError as error:
            raise DiagnoseError(f"{path}: {error}") from None
    return laws


def _explanation(report: Mapping[str, Any], path: str, rank: int) -> list[dict[str, Any]]:
    """Return the laws of the explanation of this rank, from 1, as ``explain`` wrote them."""
    explanations = report.get("explanations") or [[law] for law in report.get("laws") or []]
    if rank > len(explanations):
        choices = f"expected a number up to {len(explanations)}"
        if not explanations:
            reasons = "; ".join(report.get("reasons") or ["none"])
            choices = (
                "it holds none: a formula is a law only where flights that are left out repeat its"
                f" coefficient. Reasons of its verdict: {reasons}"
            )
        raise DiagnoseError(f"{path}: --laws asks for number {rank} of its laws; {choices}")
    return explanations[rank - 1] if rank else []


def read(report: Mapping[str, Any], path: str) -> tuple[dict[str, float], list[list[float]]]:
    """Sizes and covariance from the JSON that ``explain`` wrote.

    Raises DiagnoseError: something is missing.
    """
    try:
        theta = {str(name): float(size) for name, size in report["theta"].items()}
        covariance = [[float(x) for x in row] for row in report["covariance"]]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else error
        raise DiagnoseError(
            f"{path}: no diagnosis that `visthrow diagnose explain` wrote: {reason}"
        ) from error
    if len(covariance) != len(theta) or any(len(row) != len(theta) for row in covariance):
        raise DiagnoseError(
            f"{path}: {len(theta)} effects and a covariance of {len(covariance)} rows; expected one"
            " each"
        )
    return theta, covariance


def with_firmware(
    path: str | Path, base: str, experiment: Experiment, hover: float, delay: float | None = None
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
    changed = differences(
        dataclasses.asdict(plant.vehicle.controller), dataclasses.asdict(controller)
    )
    lines = [
        f"# Controller by the settings of {settings.get('Firmware revision', 'a firmware').strip()}"
        f" in {Path(path).name}."
    ]
    lines += [f"# Not in the block: {words}." for words in left_out(settings)]
    vehicle = {"controller": changed} | ({} if delay is None else {"queue": {"delay": delay}})
    return "\n".join([*lines, dumps({"base": base, "vehicle": vehicle})])


def of_setup(
    base: str,
    setup: Setup,
    report: Mapping[str, Any],
    path: str,
    provenance: Sequence[str],
    rank: int = 0,
) -> str:
    """The TOML file of a setup of another model than the throw, extended by the sizes and laws that
    a diagnosis of it found.

    Raises DiagnoseError: no diagnosis, one of another model, or one without such an explanation.

    Args:
        base: path of the diagnosed setup, as ``base =`` is to name it.
        setup: that setup.
        report: of the diagnosis. path: of its file.
        provenance: lines on where it comes from.
        rank: of the explanation whose laws are written, from 1; 0 for none.
    """
    theta, covariance = with_scatter(*read(report, path), report)
    model = report.get("model", THROW)
    if model != setup.model:
        raise DiagnoseError(
            f"{path}: a diagnosis of the model '{model}'; the model of {base} is"
            f" {setup.model or 'none'}"
        )
    effects = {e.name: e for e in effects_of(setup.model, getattr(setup, setup.model))}
    after = {name: setup.effects.get(name, 0.0) + size for name, size in theta.items()}
    refuse_strange(report, path, after, effects, setup.model)
    changed: dict[str, Any] = {}
    words = {}
    comments = [*provenance, *_rows_of(list(theta), covariance)]
    if laws := laws_of(report, path, rank):
        changed["laws"] = [dataclasses.asdict(law) for law in (*setup.laws, *laws)]
        terms = _explanation(report, path, rank)
        rows = [x.get("covariance") or [x["sd"] ** 2] for x in terms]
        comments += _rows_of([term_of(law).formula for law in laws], rows)
    if theta:
        changed["effects"] = {name: float(f"{size:.9g}") for name, size in after.items()}
    for (name, size), sd in zip(theta.items(), np.sqrt(np.diag(covariance))):
        words[f"effects.{name}"] = [f"{size:+.4g} +- {sd:.2g} {effects[name].unit}"]
    return "\n".join([*_head(base, comments), *_commented(changed, words)]) + "\n"


def _rows_of(names: Sequence[str], covariance: Iterable[Sequence[float]]) -> list[str]:
    """Return the comments that hold a covariance."""
    rows = [f"  {'  '.join(f'{x: .3e}' for x in row)}" for row in covariance]
    return [f"covariance of {', '.join(names)}:", *rows] if names else []


def refuse_strange(
    report: Mapping[str, Any],
    path: str,
    theta: Mapping[str, float],
    effects: Mapping[str, Effect],
    model_name: str,
) -> None:
    """Refuse effects that are none of a model's, though they may bear the same name, and sizes that
    it cannot have.

    Raises DiagnoseError: an effect or its unit is none of the model's; a size lies outside its
    bounds.

    Args:
        report: of the diagnosis. path: of its file.
        theta: sizes that the model would have.
        effects: its effects.
        model_name: its name.
    """
    strange = [name for name in theta if name not in effects]
    if strange:
        raise DiagnoseError(
            f"{path}: {', '.join(strange)} are no effects of the {model_name};"
            f" {suggest(strange[0], effects)}"
        )
    units = {f["name"]: f["unit"] for f in report.get("findings") or [] if "unit" in f}
    for name, size in theta.items():
        effect = effects[name]
        if units.get(name, effect.unit) != effect.unit:
            raise DiagnoseError(
                f"{path}: {name} in '{units[name]}'; the {model_name}'s {name} is in"
                f" '{effect.unit}': of another model"
            )
        if beyond := beyond_bounds(effect, size):
            raise DiagnoseError(f"{path}: {beyond} in the {model_name}")

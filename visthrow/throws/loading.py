"""Load a policy together with the experiment in which it is flown."""

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from sim.params import AirParams, change_values
from visthrow import config
from visthrow.common.errors import ConfigError, MismatchError, PolicyError, suggest
from visthrow.onboard.policy import Policy, find_policy, flatten
from visthrow.task import Experiment, contract_of, load_experiment
from visthrow.task.fleet import specialise

Kind = TypeVar("Kind", bound=Experiment)


@dataclass(frozen=True)
class Loaded:
    """A policy, its name, and the experiment (plant, camera, task) in which it is flown."""

    name: str
    policy: Policy
    experiment: Experiment
    # allowed deviations from the contract: dotted key -> value in flight
    departures: dict[str, Any] = field(default_factory=dict)


def load_policy(
    name: str | Path,
    config_name: str | None = None,
    overrides: Iterable[str] = (),
    allow: Collection[str] = (),
) -> Loaded:
    """Load a policy and the experiment of its training, or another experiment that satisfies its
    contract.

    Raises PolicyError: no such policy, or it does not contain its config and none was given;
    MismatchError: the config violates the policy's contract; the message names every difference;
    ConfigError: an invalid config or override, or a part that no contract has.

    Args:
        name: name of a shipped policy, or a file.
        config_name: config of ``configs/train`` to fly in; default the policy's own, with the
            changes under which it is flown.
        overrides: ``key=value`` changes of this config.
        allow: parts of the contract that may be violated; see
            :meth:`visthrow.onboard.policy.Policy.require`.
    """
    path = find_policy(name)
    policy = _add_air_and_laws(Policy.load(path))
    if config_name is not None:
        rule = policy.contract.get("camera", {}).get("invalid_reads")
        # a property of the program, not of the camera
        trained = [] if rule is None else [f"camera.noise.invalid_reads={rule}"]
        experiment = load_experiment(config_name, [*trained, *overrides])
    else:
        experiment = training_experiment(policy, path, overrides)
    contract_here = contract_of(experiment)
    for part in allow:
        _check_part(part, (policy.contract, contract_here, contract_of(experiment, whole=True)))
    try:
        widened = _list_allowed(policy, experiment)
        departures = policy.require(contract_here, allow=(*allow, *widened))
        departures = {
            key: value for key, value in departures.items() if key.split("[")[0] not in widened
        }
    except MismatchError as error:
        # a shell would expand brackets
        whole = dict.fromkeys(key.split("[")[0] for key in error.keys)
        allowing = " ".join(f"--allow {key}" for key in whole)
        raise MismatchError(
            f"{error}\nto throw anyway (fly and compare accept it): {allowing}", error.keys
        ) from None
    if experiment.fleet is not None:  # fly one vehicle, that of the config
        policy, experiment = specialise(policy, change_values(experiment, {"fleet.count": 0}))
    return Loaded(
        path.stem if path.stem != "policy" else path.resolve().parent.name,
        policy,
        experiment,
        departures,
    )


def _add_air_and_laws(policy: Policy) -> Policy:
    """Return the policy with the air and the laws of its training in its contract; in older files
    only the config states them.
    """
    trained = policy.made_by.get("config")
    if not isinstance(trained, dict):
        return policy
    calm = config.to_dict(AirParams())
    air = {key: value for key, value in trained.get("air", {}).items() if value != calm.get(key)}
    stated = {"air": air, "laws": trained.get("laws")}
    acting = {key: value for key, value in stated.items() if value}
    return replace(policy, contract=acting | policy.contract)


def _check_part(part: str, contracts: Iterable[dict[str, Any]]) -> None:
    """Raise ConfigError if a part that may be violated is in no contract."""
    keys = {key for contract in contracts for key in flatten(contract)}
    groups = {key[: mark.start()] for key in keys for mark in re.finditer(r"[.\[]|$", key)}
    if part not in groups:
        sections = sorted(name for name in groups if "." not in name)
        raise ConfigError(
            f"allow '{part}': not in a contract, which has {', '.join(sections)} and their entries;"
            f" {suggest(part, groups)}"
        )


def training_experiment(
    policy: Policy,
    path: str | Path,
    overrides: Iterable[str],
    kind: type[Kind] = Experiment,  # type: ignore[assignment]
) -> Kind:
    """Return the experiment of a policy's training, with the changes under which it is flown and
    further ``overrides``; ``kind`` is its schema.

    Raises PolicyError: the policy does not contain its config.
    """
    trained = policy.made_by.get("config")
    if not isinstance(trained, dict):
        raise PolicyError(
            f"{path} does not hold the configuration it was trained with; name one with --config"
        )
    # Learning parameters are the current ones: they do not affect flight, and an older policy may
    # lack some of them.
    layout = policy.contract.get("observation", {}).get("layout", "state")
    learning = config.to_dict(load_experiment(layout).ppo)
    return config.load_dict(
        kind,
        {**trained, "ppo": learning},
        [*trained.get("flown", ()), *overrides],
        name=f"{path} (the config it was trained with)",
    )


def _list_allowed(policy: Policy, experiment: Experiment) -> tuple[str, ...]:
    """Return keys of the contract that may differ because training covered the difference: the
    latencies, if they are within the range of the training.
    """
    observation = experiment.task.observation
    trained = policy.contract.get("observation", {})
    low, high = trained.get("latency", (0.0, 0.0))
    jitter = trained.get("latency_jitter", 0.0)
    covered = (
        low - jitter <= observation.latency[0] - observation.latency_jitter
        and observation.oldest <= high + jitter
    )
    return ("observation.latency", "observation.latency_jitter") if covered else ()


def unique_names(loaded: list[Loaded]) -> list[str]:
    """Return a name for each policy; equal names are numbered."""
    names = [item.name for item in loaded]
    return [name if names.count(name) == 1 else f"{name} {i + 1}" for i, name in enumerate(names)]

"""The exported policy: a small network, the conditions of its training, and its provenance.

Onboard-safe: torch, numpy and json only. The file is an ``.npz`` without pickle:
``layer<i>_weight`` and ``layer<i>_bias`` (float32), optionally ``normalizer_mean``,
``normalizer_std``, ``normalizer_eps``, and ``header``, JSON text with ``format_version``,
``activation``, ``contract`` and ``made_by``. The file of a policy with a memory also holds its
estimator, ``estimator_<field>``, and has format version 2.

``contract`` is a nested dictionary of all conditions that a flight of the policy must share with
its training: camera, mount, action limits, release lag, vehicle, observation layout.
``contract["observation"]["dimension"]`` and ``contract["action"]["dimension"]``, if present, must
match the network. ``made_by`` records config, commit, command, seed and figures; nothing depends on
it.
"""

import json
import math
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from visthrow.common.errors import MismatchError, PolicyError, expect_known, suggest
from visthrow.common.storage import from_json_array, json_array, loadz, savez
from visthrow.common.toml_text import tables_beside
from visthrow.onboard.estimator import Estimator
from visthrow.onboard.shipped import find_policy as find_policy

FORMAT_VERSIONS = (1, 2)
"""Versions without and with an estimator."""

NORMALIZER = ("normalizer_mean", "normalizer_std", "normalizer_eps")
ESTIMATOR = "estimator_"
"""Names of the normaliser's entries in the file, and prefix of the estimator's."""

RELATIVE_TOLERANCE = 1e-9
"""Relative difference up to which two numbers of a contract are equal; it covers rounding by a
conversion to text or of units.
"""

RSL_RL_EPS = 1e-2
"""Constant that rsl_rl 5.5's EmpiricalNormalization adds to the standard deviation; it is not part
of its state.
"""

ACTIVATIONS: dict[str, dict[str, str]] = tables_beside(__file__, "activations.toml")
"""Activation by rsl_rl's name -> its names in torch, ONNX and C."""


@dataclass(frozen=True)
class Policy:
    """A multi-layer perceptron ``obs (E, D) -> action (E, A)`` with an optional fixed normaliser
    of its input.

    With an estimator the perceptron's input is the estimate (E, S) instead of the observation, and
    the policy has a memory. Raises PolicyError: shapes are inconsistent or contradict the contract,
    a number is not finite, or the activation is unknown."""

    weights: tuple[Tensor, ...]  # (out, in) each
    biases: tuple[Tensor, ...]  # (out,) each
    activation: str  # between the layers; the last one is linear
    contract: dict[str, Any]
    made_by: dict[str, Any] = field(default_factory=dict)
    mean: Tensor | None = None  # (D,), of the observation
    std: Tensor | None = None  # (D,)
    eps: float = 0.0  # added to std
    estimator: Estimator | None = None

    def __post_init__(self) -> None:
        expect_known([self.activation], ACTIVATIONS, "activation '{}'", PolicyError)
        _check_shapes(self)
        for part, dimension in (("observation", self.obs_dim), ("action", self.action_dim)):
            section = self.contract.get(part)
            stated = section.get("dimension") if isinstance(section, Mapping) else None
            if stated not in (None, dimension):
                raise PolicyError(
                    f"the contract states {part} dimension {stated}, the network has {dimension}"
                )

    @property
    def obs_dim(self) -> int:
        """Return the number D of observations."""
        if self.estimator is None:
            return self.weights[0].shape[1]
        return self.estimator.obs_dim

    @property
    def action_dim(self) -> int:
        """Return the number A of actions."""
        return self.weights[-1].shape[0]

    @property
    def total_mass(self) -> float:
        """Return the mass of vehicle, rope and payload in the contract [kg]."""
        rope = self.contract["rope"]
        return float(
            self.contract["vehicle"]["body"]["mass"] + (rope["rope_mass"] + rope["payload_mass"])
        )

    @torch.no_grad()
    def act(self, obs: Tensor) -> Tensor:
        """Return the deterministic action. Raises PolicyError: the last axis does not have length
        D.

        Args:
            obs: Observations as in training, shape (E, D); converted to the policy's dtype.

        Returns:
            Normalised actions, unclipped, shape (E, A).
        """
        if self.estimator is not None:
            raise PolicyError(
                "this policy has a memory; expected a call of step or actor rather than act"
            )
        return self.decide(self._check_shape(obs))

    def begin(self, count: int) -> Tensor:
        """Return the memory at the start of a throw, shape (E, H); H is 0 for a policy without
        memory.
        """
        if self.estimator is None:
            width = 0
        else:
            width = self.estimator.memory
        weight = self.weights[0]
        return torch.zeros(count, width, device=weight.device, dtype=weight.dtype)

    @torch.no_grad()
    def step(self, obs: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the action of :meth:`act`, shape (E, A), and the memory for the next step, shape
        (E, H).

        Raises PolicyError: the last axis of the observations does not have length D.
        """
        fitted = self._check_shape(obs)
        if self.estimator is not None:
            fitted, memory = self.estimator.step(fitted, memory)
        return self.decide(fitted), memory

    def actor(self, count: int) -> Callable[[Tensor], Tensor]:
        """Return a function of the observations of successive steps, shape (E, D), which keeps the
        memory, if any, between calls.
        """
        if self.estimator is None:
            return self.act
        memory = self.begin(count)

        def act(obs: Tensor) -> Tensor:
            nonlocal memory
            action, memory = self.step(obs, memory)
            return action

        return act

    def _check_shape(self, obs: Tensor) -> Tensor:
        if obs.shape[-1] != self.obs_dim:
            raise PolicyError(
                f"got observations of shape {tuple(obs.shape)}; this policy expects (E,"
                f" {self.obs_dim})"
            )
        return obs.to(self.weights[0].dtype)

    def decide(self, x: Tensor) -> Tensor:
        """Return the action of the perceptron, shape (E, A), for its input, shape (E, S);
        differentiable.
        """
        if self.mean is not None and self.std is not None:
            x = (x - self.mean) / (self.std + self.eps)
        activation = getattr(F, ACTIVATIONS[self.activation]["torch"])
        for weight, bias in zip(self.weights[:-1], self.biases[:-1]):
            x = activation(F.linear(x, weight, bias))
        return F.linear(x, self.weights[-1], self.biases[-1])

    def tensors(self) -> dict[str, Tensor]:
        """Return all tensors by their names in the file."""
        named: dict[str, Tensor] = {}
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases)):
            named |= {f"layer{i}_weight": weight, f"layer{i}_bias": bias}
        if self.mean is not None and self.std is not None:
            eps = torch.tensor(self.eps, dtype=torch.float64)
            named |= dict(zip(NORMALIZER, (self.mean, self.std, eps)))
        if self.estimator is not None:
            parts = self.estimator.parts()
            named |= {f"{ESTIMATOR}{name}": part for name, part in parts.items()}
        return named

    def to(self, device: str | torch.device) -> "Policy":
        """Return the policy with its tensors on another device."""
        moved = {name: tensor.to(device) for name, tensor in self.tensors().items()}
        return replace(self, **_fields_of(moved))

    def require(
        self,
        contract_now: Mapping[str, Any],
        sections: Collection[str] | None = None,
        allow: Collection[str] = (),
    ) -> dict[str, Any]:
        """Refuse a flight under conditions that differ from those of the training.

        Raises MismatchError: conditions differ; the message names each such key with both values.

        Args:
            contract_now: The present conditions, in the form of a contract.
            sections: Top-level keys to compare; all if None.
            allow: Keys of tables or values that may differ, such as
                ``("vehicle", "observation.latency")``.

        Returns:
            Allowed differences: dotted key -> the present value, None if there is none.
        """
        trained = flatten(self.contract, sections)
        current = flatten(contract_now, sections)
        keys = sorted(trained.keys() | current.keys())
        pairs = [(trained.get(key, _ABSENT), current.get(key, _ABSENT)) for key in keys]
        differing = [key for key, pair in zip(keys, pairs) if not _is_same(*pair)]
        allowed = [
            key
            for key in differing
            if any(re.match(rf"{re.escape(name)}(?![^.\[])", key) for name in allow)
        ]
        if refused := tuple(key for key in differing if key not in allowed):
            lines = (
                f"  {key}: trained with {_show(trained, key)}, here {_show(current, key)}"
                for key in refused
            )
            raise MismatchError(
                "the policy was trained under other conditions:\n" + "\n".join(lines), refused
            )
        return {key: current.get(key) for key in allowed}

    def save(self, path: str | Path) -> None:
        """Write the policy file, whole or not at all.

        Raises PolicyError: contract or made_by cannot be written as JSON; StorageError: the file
        cannot be written."""
        header = {
            "format_version": FORMAT_VERSIONS[self.estimator is not None],
            "activation": self.activation,
        }
        header |= {"contract": self.contract, "made_by": self.made_by}
        try:
            arrays = {"header": json_array(header)}
        except (TypeError, ValueError) as error:
            raise PolicyError(f"contract or made_by cannot be written as JSON: {error}") from error
        arrays |= {name: tensor.cpu().numpy() for name, tensor in self.tensors().items()}
        savez(path, arrays)

    @staticmethod
    def load(path: str | Path, device: str | torch.device = "cpu") -> "Policy":
        """Read a policy file.

        Raises PolicyError: the file is missing, truncated, incomplete, inconsistent, or of another
        version."""
        arrays = loadz(path, PolicyError, "a policy file written by `visthrow train`")
        try:
            header = _header(arrays)
            tensors = {
                name: torch.from_numpy(array).to(device)
                for name, array in arrays.items()
                if name.startswith(("layer", *NORMALIZER, ESTIMATOR))
            }
            return Policy(**_fields_of(tensors), **header)
        except PolicyError as error:
            raise PolicyError(f"{path}: {error}") from error

    @staticmethod
    def from_actor_state(
        state: Mapping[str, Tensor],
        activation: str,
        contract: dict[str, Any],
        made_by: dict[str, Any] | None = None,
    ) -> "Policy":
        """Build the policy from the state of an rsl_rl 5.5 ``MLPModel`` actor with a Gaussian
        whose spread is a parameter.

        Raises PolicyError: the state belongs to another model class or contradicts the contract.

        Args:
            state: ``actor.state_dict()``: ``mlp.<i>.weight``, ``mlp.<i>.bias``,
                ``obs_normalizer._mean`` and ``._std``; the spread under ``distribution.`` does not
                affect the deterministic action.
            activation: The actor's hidden activation by rsl_rl's name.
            contract: Conditions of the training.
            made_by: Provenance.
        """
        prefixes = ("mlp.", "obs_normalizer.", "distribution.")
        foreign = sorted(key for key in state if not key.startswith(prefixes))
        weights = [key for key in state if key.startswith("mlp.") and key.endswith(".weight")]
        index = sorted(int(key.split(".")[1]) for key in weights)
        if foreign or not index:
            received = ", ".join(foreign) or "no mlp.<i>.weight"
            expected = "mlp.<i>.weight, mlp.<i>.bias, obs_normalizer._mean, obs_normalizer._std"
            raise PolicyError(
                f"got {received}; expected the state of an rsl_rl MLPModel: {expected}"
            )

        def take(key: str) -> Tensor:
            return state[key].detach().to("cpu", torch.float32).clone()

        normalizer: dict[str, Any] = {}
        if "obs_normalizer._mean" in state:
            normalizer = {n: take(f"obs_normalizer._{n}").reshape(-1) for n in ("mean", "std")}
            normalizer["eps"] = RSL_RL_EPS
        return Policy(
            tuple(take(f"mlp.{i}.weight") for i in index),
            tuple(take(f"mlp.{i}.bias") for i in index),
            activation.lower(),
            json.loads(json.dumps(contract)),
            json.loads(json.dumps(made_by or {})),
            **normalizer,
        )


def name_activation(policy: Policy, language: str, kind: str) -> str:
    """Return the name of a policy's activation in another language.

    Raises PolicyError: the language has none.
    """
    names = {name: table[language] for name, table in ACTIVATIONS.items() if language in table}
    if policy.activation not in names:
        raise PolicyError(
            f"activation '{policy.activation}' has no {kind}; expected one of {sorted(names)}"
        )
    return names[policy.activation]


_ABSENT = object()


def _check_shapes(policy: Policy) -> None:
    std = policy.std
    weights = policy.weights
    if not weights or len(weights) != len(policy.biases):
        raise PolicyError(
            f"got {len(weights)} weights and {len(policy.biases)} biases; expected one of each for"
            " each layer"
        )
    width = weights[0].shape[-1]
    if policy.estimator is not None and len(policy.estimator.output_bias) != width:
        raise PolicyError(
            f"the estimator outputs {len(policy.estimator.output_bias)} numbers; expected {width},"
            " the inputs of the first layer"
        )
    named = [("normalizer mean", policy.mean), ("normalizer std", std)]
    if (policy.mean is None) != (std is None):
        raise PolicyError("a normaliser needs both mean and std; one is missing")
    for name, tensor in named:
        if tensor is not None and tensor.shape != (width,):
            raise PolicyError(
                f"{name} has shape {tuple(tensor.shape)}; the first layer takes ({width},)"
            )
    for i, (weight, bias) in enumerate(zip(weights, policy.biases)):
        if weight.ndim != 2 or weight.shape[1] != width or bias.shape != weight.shape[:1]:
            received = f"weight {tuple(weight.shape)} and bias {tuple(bias.shape)}"
            raise PolicyError(f"layer {i} has {received}; expected (n, {width}) and (n,)")
        width = weight.shape[0]
        named += [(f"layer {i} weight", weight), (f"layer {i} bias", bias)]
    for name, tensor in named:
        if tensor is not None and not bool(torch.isfinite(tensor).all()):
            raise PolicyError(f"{name} holds numbers that are not finite")
    if std is not None and not bool((std + policy.eps > 0.0).all()):
        raise PolicyError(
            "normalizer std + eps must be above 0; the smallest is"
            f" {float((std + policy.eps).min())}"
        )


def _fields_of(tensors: Mapping[str, Tensor]) -> dict[str, Any]:
    """Return the fields of a policy from :meth:`Policy.tensors`.

    Raises PolicyError: a tensor is missing.
    """
    count = sum(name.startswith("layer") and name.endswith("_weight") for name in tensors)
    fields: dict[str, Any] = {
        "weights": tuple(_entry(tensors, f"layer{i}_weight") for i in range(count)),
        "biases": tuple(_entry(tensors, f"layer{i}_bias") for i in range(count)),
    }
    if NORMALIZER[0] in tensors:
        mean, std, eps = (_entry(tensors, name) for name in NORMALIZER)
        fields |= {"mean": mean, "std": std, "eps": float(eps)}
    parts = {
        name.removeprefix(ESTIMATOR): part
        for name, part in tensors.items()
        if name.startswith(ESTIMATOR)
    }
    if parts:
        fields["estimator"] = Estimator.from_parts(parts)
    return fields


def _entry(entries: Mapping[str, Any], name: str) -> Any:
    if name not in entries:
        raise PolicyError(f"no entry '{name}'; {suggest(name, entries)}")
    return entries[name]


def _header(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return activation, contract and made_by of a policy file."""
    try:
        header: dict[str, Any] = from_json_array(_entry(arrays, "header"))
        version = header["format_version"]
    except (ValueError, KeyError, TypeError) as error:
        raise PolicyError(f"its header is not readable: {error!r}") from error
    if version not in FORMAT_VERSIONS:
        readable = " and ".join(map(str, FORMAT_VERSIONS))
        raise PolicyError(f"format version {version}; this program reads versions {readable}")
    estimates = any(name.startswith(ESTIMATOR) for name in arrays)
    if version != FORMAT_VERSIONS[estimates]:
        raise PolicyError(
            f"format version {version}, but {'an' if estimates else 'no'} estimator; expected one"
            f" only in version {FORMAT_VERSIONS[1]}"
        )
    schema = {"activation": str, "contract": dict, "made_by": dict}
    for key, kind in schema.items():
        if not isinstance(header.get(key), kind):
            raise PolicyError(
                f"not a policy: header entry '{key}' is {header.get(key)!r}; expected a"
                f" {kind.__name__}"
            )
    return {key: header[key] for key in schema}


def flatten(tree: Mapping[str, Any], sections: Collection[str] | None = None) -> dict[str, Any]:
    """Flatten nested dictionaries and lists to dotted keys; an empty one remains as a value."""
    flat: dict[str, Any] = {}

    def walk(value: Any, path: str) -> None:
        if isinstance(value, Mapping) and value:
            for key, item in value.items():
                walk(item, f"{path}.{key}" if path else str(key))
        elif isinstance(value, list | tuple) and value:
            for i, item in enumerate(value):
                walk(item, f"{path}[{i}]")
        else:
            flat[path] = list(value) if isinstance(value, tuple) else value

    walk({key: item for key, item in tree.items() if sections is None or key in sections}, "")
    flat.pop("", None)
    return flat


def _is_same(a: Any, b: Any) -> bool:
    if isinstance(a, bool) or isinstance(b, bool):
        return a is b
    if isinstance(a, int | float) and isinstance(b, int | float):
        return math.isclose(a, b, rel_tol=RELATIVE_TOLERANCE)
    return type(a) is type(b) and a == b


def _show(flat: dict[str, Any], key: str) -> str:
    return repr(flat[key]) if key in flat else "nothing"

"""Estimate a state policy's observation by a recurrent network from partial observations.

Onboard-safe.

One step takes an observation o and the memory h of the earlier steps:

    x = elu(W o' + b), o' normalised             encoder, of one layer or more
    h = GRU(x, h)                                Cho et al., EMNLP 2014, as in torch.nn.GRUCell
    s = o[kept] + C h + c                        estimate; 0 instead of o where nothing is kept

Entries that are measured directly are thus passed on with a correction. Others (a goal seen by a
rotated camera, the current pose instead of that of 30 ms ago) are inferred from all measurements so
far."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import chain

import torch
import torch.nn.functional as F
from torch import Tensor

from visthrow.common.errors import PolicyError, suggest


@dataclass(frozen=True)
class Estimator:
    """Weights of the estimator, for D entries of the observation, N of the encoder, H of the memory
    and S of the estimate. Raises `PolicyError`: inconsistent shapes, or a number that is not
    finite.
    """

    mean: Tensor  # (D,), subtracted from the observation
    std: Tensor  # (D,), divisor of the observation
    encoder_weight: Tensor  # (N, D)
    encoder_bias: Tensor  # (N,)
    input_weight: Tensor  # (3 H, N), reset, update and candidate gate
    input_bias: Tensor  # (3 H,)
    memory_weight: Tensor  # (3 H, H)
    memory_bias: Tensor  # (3 H,)
    output_weight: Tensor  # (S, H)
    output_bias: Tensor  # (S,)
    kept: Tensor  # (S,), entry of the observation that each estimate corrects, D for none; int64
    # weights (N', N) and biases (N',) of the encoder's further layers; the last one's output is the
    # memory's input
    inner: tuple[tuple[Tensor, Tensor], ...] = ()

    def __post_init__(self) -> None:
        width = self.encoder_weight.shape[1]
        hidden = len(self.encoder_bias)
        memory = self.output_weight.shape[1]
        count = self.output_weight.shape[0]
        expected: dict[str, tuple[int, ...]] = {
            "mean": (width,),
            "std": (width,),
            "encoder_weight": (hidden, width),
        }
        for i, (_, bias) in enumerate(self.inner):
            expected |= {f"inner{i}_weight": (len(bias), hidden), f"inner{i}_bias": (len(bias),)}
            hidden = len(bias)
        expected |= {
            "input_weight": (3 * memory, hidden),
            "input_bias": (3 * memory,),
            "memory_weight": (3 * memory, memory),
            "memory_bias": (3 * memory,),
            "output_bias": (count,),
            "kept": (count,),
        }
        parts = self.parts()
        for name, shape in expected.items():
            actual = tuple(parts[name].shape)
            if actual != shape:
                raise PolicyError(f"estimator: {name} has shape {actual}; expected {shape}")
        for name, part in parts.items():
            if not bool(torch.isfinite(part).all()):
                raise PolicyError(f"estimator: {name} holds numbers that are not finite")
        if not bool(((self.kept >= 0) & (self.kept <= width)).all()) or not bool(
            (self.std > 0.0).all()
        ):
            raise PolicyError(
                f"estimator; expected entries of 0 to {width} in kept and numbers above 0 in std"
            )

    def parts(self) -> dict[str, Tensor]:
        """Return all tensors by name; those of further layers are ``inner0_weight`` and so on."""
        named = {field.name: getattr(self, field.name) for field in fields(self)[:-1]}
        for i, (weight, bias) in enumerate(self.inner):
            named |= {f"inner{i}_weight": weight, f"inner{i}_bias": bias}
        return named

    @classmethod
    def from_parts(cls, parts: Mapping[str, Tensor]) -> "Estimator":
        """Build an estimator from :meth:`parts`. Raises PolicyError: one is missing."""
        names = [field.name for field in fields(cls)[:-1]]
        count = sum(name.startswith("inner") and name.endswith("_weight") for name in parts)
        pairs = [(f"inner{i}_weight", f"inner{i}_bias") for i in range(count)]
        for name in (*names, *chain.from_iterable(pairs)):
            if name not in parts:
                raise PolicyError(f"estimator: no part '{name}'; {suggest(name, parts)}")
        inner = tuple((parts[weight], parts[bias]) for weight, bias in pairs)
        return cls(**{name: parts[name] for name in names}, inner=inner)

    @property
    def obs_dim(self) -> int:
        """Return the width D of the observation."""
        return self.encoder_weight.shape[1]

    @property
    def memory(self) -> int:
        """Return the width H of the memory."""
        return self.output_weight.shape[1]

    def step(self, obs: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the estimate, shape (E, S), and the new memory, shape (E, H), for an observation,
        shape (E, D), and the memory.
        """
        x = F.elu(F.linear((obs - self.mean) / self.std, self.encoder_weight, self.encoder_bias))
        for weight, bias in self.inner:
            x = F.elu(F.linear(x, weight, bias))
        memory = torch.gru_cell(
            x, memory, self.input_weight, self.memory_weight, self.input_bias, self.memory_bias
        )
        correction = F.linear(memory, self.output_weight, self.output_bias)
        return F.pad(obs, (0, 1))[:, self.kept] + correction, memory

"""A recurrent estimate of what a policy looks at, from observations that tell it only in part.

Onboard-safe.

One step takes an observation o and the memory h of the steps before:

    x = elu(W o' + b), o' normalised             encoder, of one layer or more
    h = GRU(x, h)                                Cho et al., EMNLP 2014, as in torch.nn.GRUCell
    s = o[kept] + C h + c                        estimate; 0 in place of o where nothing is kept

so that what is measured directly passes, corrected, and what is not (a goal behind a turned lens, a
pose of now rather than of 30 ms ago) is inferred from all that was seen."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import chain

import torch
import torch.nn.functional as F
from torch import Tensor

from visthrow.common.errors import PolicyError, suggest


@dataclass(frozen=True)
class Estimator:
    """Weights of the estimate, with D the observation's numbers, N the encoder's, H the memory's
    and S the estimate's; raises `PolicyError` for shapes that do not fit each other, or a number
    that is not finite.
    """

    mean: Tensor  # (D,), of the observation
    std: Tensor  # (D,), what the observation is divided by
    encoder_weight: Tensor  # (N, D)
    encoder_bias: Tensor  # (N,)
    input_weight: Tensor  # (3 H, N), reset, update and candidate gate
    input_bias: Tensor  # (3 H,)
    memory_weight: Tensor  # (3 H, H)
    memory_bias: Tensor  # (3 H,)
    output_weight: Tensor  # (S, H)
    output_bias: Tensor  # (S,)
    kept: Tensor  # (S,), entry of the observation that each estimate corrects, D for none; int64
    # weights (N', N) and biases (N',) of the encoder's further layers, the last of which the memory
    # takes
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
        """Return all tensors by name, those of further layers as ``inner0_weight`` and so on."""
        named = {field.name: getattr(self, field.name) for field in fields(self)[:-1]}
        for i, (weight, bias) in enumerate(self.inner):
            named |= {f"inner{i}_weight": weight, f"inner{i}_bias": bias}
        return named

    @classmethod
    def from_parts(cls, parts: Mapping[str, Tensor]) -> "Estimator":
        """Build from what :meth:`parts` gave. Raises PolicyError: one is missing."""
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
        """Width of the observation D."""
        return self.encoder_weight.shape[1]

    @property
    def memory(self) -> int:
        """Width of the memory H."""
        return self.output_weight.shape[1]

    def step(self, obs: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Estimate, shape (E, S), and new memory, shape (E, H), from an observation, shape (E, D),
        and the memory.
        """
        x = F.elu(F.linear((obs - self.mean) / self.std, self.encoder_weight, self.encoder_bias))
        for weight, bias in self.inner:
            x = F.elu(F.linear(x, weight, bias))
        memory = torch.gru_cell(
            x, memory, self.input_weight, self.memory_weight, self.input_bias, self.memory_bias
        )
        correction = F.linear(memory, self.output_weight, self.output_bias)
        return F.pad(obs, (0, 1))[:, self.kept] + correction, memory

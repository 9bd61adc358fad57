"""A recurrent estimate of what a policy looks at, from observations that tell it only in part.

Onboard-safe.

One step takes an observation o and the memory h of the steps before:

    x = elu(W o' + b), o' normalised             encoder, of one layer or two
    h = GRU(x, h)                                Cho et al., EMNLP 2014, as in torch.nn.GRUCell
    s = o[kept] + C h + c                        estimate; 0 in place of o where nothing is kept

so that what is measured directly passes, corrected, and what is not (a goal behind a turned lens, a
pose of now rather than of 30 ms ago) is inferred from all that was seen."""

from dataclasses import dataclass, fields

import torch
import torch.nn.functional as F
from torch import Tensor

from visthrow.common.errors import PolicyError


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
    inner_weight: Tensor | None = None  # (N, N), of the encoder's second layer, where it has one
    inner_bias: Tensor | None = None  # (N,)

    def __post_init__(self) -> None:
        hidden, width = self.encoder_weight.shape[0], self.encoder_weight.shape[1]
        memory, count = self.output_weight.shape[1], self.output_weight.shape[0]
        expected = {
            "mean": (width,),
            "std": (width,),
            "encoder_bias": (hidden,),
            "input_weight": (3 * memory, hidden),
            "input_bias": (3 * memory,),
            "memory_weight": (3 * memory, memory),
            "memory_bias": (3 * memory,),
            "output_bias": (count,),
            "kept": (count,),
        }
        if self.inner_weight is not None or self.inner_bias is not None:
            expected |= {"inner_weight": (hidden, hidden), "inner_bias": (hidden,)}
        parts = self.parts()
        for name, shape in expected.items():
            came = tuple(parts[name].shape) if name in parts else None
            if came != shape:
                raise PolicyError(f"estimator: {name} has shape {came}; expected {shape}")
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
        """Return the tensors that there are, by their fields' names."""
        every = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: part for name, part in every.items() if part is not None}

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
        if self.inner_weight is not None:
            x = F.elu(F.linear(x, self.inner_weight, self.inner_bias))
        memory = torch.gru_cell(
            x, memory, self.input_weight, self.memory_weight, self.input_bias, self.memory_bias
        )
        return (
            F.pad(obs, (0, 1))[:, self.kept]
            + F.linear(memory, self.output_weight, self.output_bias),
            memory,
        )

    def to(self, device: str | torch.device) -> "Estimator":
        """The estimator with its tensors on another device."""
        return Estimator(**{name: part.to(device) for name, part in self.parts().items()})
